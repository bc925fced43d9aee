"""How the pictures of a diagnosis look: 6×4 inches, colours that the colour-blind tell apart."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

SIZE = (6.0, 4.0)  # inches
MAX_PANELS = 12
# Okabe and Ito's colours (https://jfly.uni-koeln.de/color), told apart by the colour-blind, too.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#000000")
LINES = ("-", "--", ":", "-.", (0, (8, 2, 1, 2, 1, 2)), (0, (3, 3)))
MARKERS = ("o", "s", "^", "D", "v", "P")
GREY = "#6b6b6b"
SETTINGS: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": "#222222",
    "ytick.labelcolor": "#222222",
    "legend.frameon": False,
    "lines.markersize": 4,
}


@contextmanager
def settings() -> Iterator[None]:
    """Matplotlib's settings for these pictures, put back afterwards."""
    with matplotlib.rc_context(SETTINGS):
        yield


def n_columns(count: int) -> int:
    """
    :param count: of panels
    """
    return 4 if count > 4 else min(count, 2)


def panels(figure: Figure, count: int, sharey: bool = False) -> list[Axes]:
    """
    :return: so many axes, in rows of at most four
    """
    columns = n_columns(count)
    rows = -(-count // columns)
    axes = figure.subplots(rows, columns, squeeze=False, sharey=sharey).flatten().tolist()
    for unused in axes[count:]:
        unused.remove()
    return axes[:count]
