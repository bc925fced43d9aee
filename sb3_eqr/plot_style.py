"""The style of all plots of this package. Curves differ in line style and marker as well as in colour."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import matplotlib

# Okabe and Ito's colours (https://jfly.uni-koeln.de/color), which colour-blind readers can distinguish, too.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#000000", "#56b4e9")
LINES = ("-", "--", ":", "-.", (0, (8, 2, 1, 2, 1, 2)), (0, (3, 3)))
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*", "h")
INK, GREY = "#222222", "#6b6b6b"
SETTINGS: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#e4e4e4",
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "legend.handlelength": 3.2,
    "lines.markersize": 4,
}


class Look(NamedTuple):
    """How a curve is drawn."""

    color: str
    line: Any
    marker: str


def looks(names: Sequence[str]) -> dict[str, Look]:
    """
    :param names: names of the curves, in order
    :return: name -> how to draw the curve. The cycles differ in length, so the first 66 curves differ even without colours
    """
    return {
        name: Look(COLORS[i % len(COLORS)], LINES[i % len(LINES)], MARKERS[i % len(MARKERS)]) for i, name in enumerate(names)
    }


def styled() -> AbstractContextManager[None]:
    """Apply Matplotlib's settings for these plots, and restore the previous ones afterwards."""
    return matplotlib.rc_context(SETTINGS)
