"""What a package must stand: tests that kill it, feed it wrong and hostile input, and take its disk away."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Finding:
    """
    A row of the table.

    :param test: what was done
    :param must: what must come out
    :param found: what came out
    :param holds: whether it is what must
    :param details: what fell short, a line each
    """

    test: str
    must: str
    found: str
    holds: bool
    details: tuple[str, ...] = ()
