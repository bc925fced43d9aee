"""One way to refuse a number: what was expected, what was found."""

from typing import Any

import numpy as np


def check_number(name: str, value: Any, low: float, high: float = np.inf, whole: bool = False) -> None:
    """
    :param name: of the argument
    :param value: what was given
    :param low: smallest legal value
    :param high: largest legal value
    :param whole: whether it must be an integer
    :raises ValueError: if it is no finite number in that range
    """
    kinds = (int, np.integer) if whole else (int, float, np.integer, np.floating)
    if not isinstance(value, kinds) or not (np.isfinite(value) and low <= value <= high):
        kind = "a whole number" if whole else "a finite number"
        legal = f" of at least {low}" if high == np.inf else f" in [{low}, {high}]"
        legal = "" if (low, high) == (-np.inf, np.inf) else legal
        raise ValueError(f"{name}: expected {kind}{legal}, found {value!r}")


def check_finite(what: str, values: np.ndarray | dict[str, np.ndarray] | None, step: int) -> None:
    """
    :param what: the name of the values, for the message
    :param values: from the environment; integers are always finite
    :param step: number of environment steps so far, for the message
    :raises ValueError: if one is NaN or infinite
    """
    for key, array in values.items() if isinstance(values, dict) else [("", values)]:
        array = np.asarray(array)
        if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
            raise ValueError(
                f"step {step}: expected finite {what}s from the environment, found {array[~np.isfinite(array)].flat[0]} "
                f"in the {what}{f' {key!r}' if key else ''}. It was not stored and the model is as before. "
                "Mend the environment; SB3's VecCheckNan tells which action led there."
            )
