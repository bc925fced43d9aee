"""The size and the panels of the pictures of a diagnosis."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

SIZE = (6.0, 4.0)  # inches
MAX_PANELS = 12


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
