"""Cost against size as a picture: a panel per sweep."""

import pathlib
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sb3_eqr.benchmark.figures import GREY, INK, looks, settings, to_png
from sb3_eqr.benchmark.speed.tables import Sweep
from sb3_eqr.common.save_util import atomic_write

PANEL = (3.6, 2.9)  # inches
COLUMNS = 3
LABELS = {  # sweep -> title of the panel, what is below it
    "stored_transitions": ("Replay, a batch", "stored transitions"),
    "n_envs": ("Several environments", "environments"),
    "M": ("Gradient step", "M, depth of the rollout"),
    "K": ("Gradient step beyond its floor", "K, blocks of SE(2)"),
    "group": ("Gradient step beyond its floor", "group of the 12 blocks"),
}


def plot_sweeps(sweeps: list[Sweep], file: str | pathlib.Path) -> None:
    """
    :param sweeps: a panel each
    :param file: PNG
    """
    with settings():
        rows = -(-len(sweeps) // COLUMNS)
        figure = Figure(figsize=(PANEL[0] * COLUMNS, PANEL[1] * rows), layout="constrained")
        axes = figure.subplots(rows, COLUMNS, squeeze=False).flatten().tolist()
        for unused in axes[len(sweeps) :]:
            unused.set_visible(False)
        for letter, ax, sweep in zip("abcdefgh", axes, sweeps, strict=False):
            title, below = LABELS[sweep.name]
            _draw(ax, sweep)
            ax.set_title(f"({letter}) {title}", loc="left", color=INK)
            ax.set(xlabel=below, ylabel="milliseconds")
    with atomic_write(file, "png") as opened:
        opened.write(to_png(figure))


def _draw(ax: Axes, sweep: Sweep) -> None:
    """Costs as measured, and in grey what they would be if they grew as their arithmetic does."""
    named = isinstance(sweep.sizes[0], str)
    places: list[Any] = list(range(len(sweep.sizes))) if named else sweep.sizes
    highest = 0.0
    for (what, costs), look in zip(sweep.costs.items(), looks(list(sweep.costs)).values(), strict=True):
        work = sweep.arithmetic[what]
        allowed = [costs[0] * done / work[0] for done in work]
        ax.plot(places, allowed, "_" if named else ":", color=GREY, markersize=18, zorder=1)
        label = what.replace("ms_", "").replace("_ms", "").replace("_", " ")
        ax.plot(places, costs, look.marker, linestyle="none" if named else look.line, color=look.color, label=label)
        highest = max(highest, min(max(allowed), 2 * max(costs)), max(costs))
    ax.plot([], [], "_" if named else ":", color=GREY, label="as the arithmetic grows")
    ax.set_ylim(0, 1.65 * highest)  # room for the legend
    ax.yaxis.set_major_locator(MaxNLocator(5))
    ax.legend(loc="upper left", fontsize=8.5, handlelength=2.4)
    if named:
        ax.set_xticks(places, sweep.sizes)
        ax.margins(x=0.15)
    elif sweep.sizes[0] > 0:
        ax.set_xscale("log")
        ax.set_xticks(places, [f"{size:,}" for size in sweep.sizes])
        ax.minorticks_off()
    else:
        ax.set_xticks(places)
