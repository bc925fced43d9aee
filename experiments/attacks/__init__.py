"""Stress tests of the package: they kill it, pass wrong and hostile input, and fill its disk."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Finding:
    """
    A row of the table.

    :param test: what was done
    :param must: required result
    :param found: actual result
    :param holds: whether the requirement is met
    :param details: failures, a line each
    """

    test: str
    must: str
    found: str
    holds: bool
    details: tuple[str, ...] = ()
