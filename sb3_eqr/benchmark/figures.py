"""
The figures of a report: counterparts of Figures 4 to 7 of the EqR paper, and curves along training.

Each function draws one figure with ``columns`` panels beside each other: two or more for paper, one for a phone. What belongs
to an agent looks the same in all of them, and differs in more than its colour.
"""

import io
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

DPI = 200
PANEL = 3.7  # inches, width of a panel; at one panel a phone shows the letters about as large as its text
BAND = 0.14  # opacity of intervals around curves
INK, GREY = "#222222", "#6b6b6b"
HEADINGS = {"IQM": "Interquartile mean", "optimality gap": "Optimality gap", "median": "Median", "mean": "Mean"}
SETTINGS: Any = {
    "font.family": "STIXGeneral",  # comes with matplotlib
    "mathtext.fontset": "stix",
    "font.size": 10.5,
    "axes.titlesize": 11.5,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "legend.handlelength": 3.2,
    "lines.linewidth": 1.5,
    "lines.markersize": 5,
    "hatch.linewidth": 0.5,
}


class Look(NamedTuple):
    """How an agent is drawn."""

    color: str
    line: tuple[float, tuple[float, ...]]  # lengths of strokes and gaps
    marker: str
    hatch: str


# Okabe and Ito's colours (https://jfly.uni-koeln.de/color), from dark to light, told apart by the colour-blind, too
COLORS = ("#000000", "#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
LINES = ((0, ()), (0, (5, 1.5)), (0, (1, 1)), (0, (6, 1.5, 1, 1.5)), (0, (8, 2, 1, 2, 1, 2)), (0, (3, 3)))
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*", "h")
HATCHES = ("", "///", "...", "\\\\\\", "xxx", "|||", "---", "+++")


def looks(agents: Sequence[str]) -> dict[str, Look]:
    """
    :param agents: in the order of the report
    :return: agent -> how it is drawn; lines and markers are cycles of different length, so that no two of the first 66 are
        alike without colours
    """
    return {
        agent: Look(COLORS[i % len(COLORS)], LINES[i % len(LINES)], MARKERS[i % len(MARKERS)], HATCHES[i % len(HATCHES)])
        for i, agent in enumerate(agents)
    }


@contextmanager
def settings() -> Iterator[None]:
    """Matplotlib's settings for the figures of a report, put back afterwards."""
    with matplotlib.rc_context(SETTINGS):
        yield


def to_png(figure: Figure) -> bytes:
    """
    :return: the same bytes for the same figure
    """
    file = io.BytesIO()
    with settings():
        figure.savefig(file, format="png", dpi=DPI, metadata={"Software": None})
    return file.getvalue()


def _panels(count: int, columns: int, width: float, height: float, sharey: bool = False) -> tuple[Figure, list[Axes]]:
    columns = min(columns, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharey=sharey).flatten().tolist()
    for unused in axes[count:]:
        unused.set_visible(False)
    return figure, axes[:count]


def _legend(figure: Figure, drawn: Mapping[str, Look], columns: int, markers: bool = True) -> None:
    """A legend below all panels, as wide as they are, for which the figure grows."""
    handles = [
        Line2D([], [], color=look.color, linestyle=look.line, marker=look.marker if markers else "", label=agent)
        for agent, look in drawn.items()
    ]
    longest = max(map(len, drawn))
    fitting = max(1, min(len(handles), int(figure.get_figwidth() / (0.65 + 0.073 * longest))))
    figure.set_figheight(figure.get_figheight() + 0.19 * -(-len(handles) // fitting) + 0.1)
    figure.legend(handles=handles, loc="outside lower center", ncols=fitting, fontsize=9.5)


def _letters(axes: list[Axes], titles: list[str]) -> None:
    for letter, ax, title in zip("abcdefgh", axes, titles, strict=False):
        ax.set_title(f"({letter}) {title}" if len(axes) > 1 else title, loc="left", color=INK)


def profile_figure(
    profiles: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]]],
    thresholds: np.ndarray,
    unit: str,
    style: Mapping[str, Look],
    columns: int,
) -> Figure:
    """
    Figure 4: fractions of runs, or of games, above a score.

    :param profiles: heading of the panel -> agent -> fraction, low, high (n,) each
    :param thresholds: (n,)
    """
    with settings():
        figure, axes = _panels(len(profiles), columns, PANEL, 2.8)
        for ax, by_agent in zip(axes, profiles.values(), strict=True):
            for agent, (value, low, high) in by_agent.items():
                _curve(ax, thresholds, value, low, high, style[agent], every=max(1, len(thresholds) // 8))
            ax.set(xlabel=f"{textwrap.fill(unit, 40)} ($\\tau$)", ylim=(-0.02, 1.02), xlim=(thresholds[0], thresholds[-1]))
        axes[0].set_ylabel("Fraction with score > $\\tau$")
        _letters(axes, list(profiles))
        _legend(figure, {agent: style[agent] for agent in next(iter(profiles.values()))}, columns)
        return figure


def _curve(ax: Axes, x: np.ndarray, value: np.ndarray, low: np.ndarray, high: np.ndarray, look: Look, every: int = 1) -> None:
    """A curve in its interval; the hatch tells bands apart without colours."""
    ax.plot(x, value, color=look.color, linestyle=look.line, marker=look.marker, markevery=every)
    if not np.isnan(low).all():
        ax.fill_between(x, low, high, facecolor=look.color, edgecolor=look.color, alpha=BAND, linewidth=0, hatch=look.hatch)


def interval_figure(
    aggregates: pd.DataFrame, published: pd.DataFrame, unit: str, style: Mapping[str, Look], columns: int
) -> Figure:
    """
    Figures 5 and 6: aggregates with their intervals, and points without one for methods of which game means are known.

    :param aggregates: columns agent, metric, value, low, high
    :param published: columns label, metric, value; may be empty
    """
    agents, labels = aggregates["agent"].unique().tolist(), published["label"].unique().tolist()
    names = [*agents, *labels]
    with settings():
        figure, axes = _panels(len(HEADINGS), columns, PANEL + 0.2, 0.9 + 0.21 * len(names), sharey=True)
        for ax, metric in zip(axes, HEADINGS, strict=True):
            for row in aggregates[aggregates["metric"] == metric].to_dict("records"):
                look, place = style[row["agent"]], agents.index(row["agent"])
                if not np.isnan(row["low"]):
                    ax.plot([row["low"], row["high"]], [place, place], color=look.color, linewidth=5, alpha=0.3)
                    ax.plot([row["low"], row["high"]], [place, place], "|", color=look.color, markersize=8)
                ax.plot(row["value"], place, look.marker, color=look.color)
            points = published[published["metric"] == metric]
            ax.plot(points["value"], [names.index(n) for n in points["label"]], "o", color=GREY, markerfacecolor="white")
            ax.set_xlabel(unit)
            ax.margins(x=0.09)
            ax.xaxis.set_major_locator(MaxNLocator(5))
            ax.grid(visible=False, axis="y")
        axes[0].set_ylim(len(names) - 0.4, -0.6)
        axes[0].set_yticks(range(len(names)), names)
        for ax in axes:
            ax.tick_params(axis="y", length=0)
            if labels:
                ax.axhline(len(agents) - 0.5, color=GREY, linewidth=0.6)
        _letters(axes, list(HEADINGS.values()))
        return figure


def improvement_figure(probabilities: pd.DataFrame, style: Mapping[str, Look], columns: int) -> Figure:
    """
    :param probabilities: columns agent, baseline, value, low, high, of one baseline
    """
    with settings():
        figure, (ax,) = _panels(1, columns, PANEL if columns == 1 else 1.75 * PANEL, 0.9 + 0.24 * len(probabilities))
        for place, row in enumerate(probabilities.to_dict("records")):
            look = style[row["agent"]]
            if not np.isnan(row["low"]):
                ax.plot([row["low"], row["high"]], [place, place], color=look.color, linewidth=5, alpha=0.3)
                ax.plot([row["low"], row["high"]], [place, place], "|", color=look.color, markersize=8)
            ax.plot(row["value"], place, look.marker, color=look.color)
        ax.axvline(0.5, color=INK, linewidth=0.8, linestyle=(0, (2, 2)))
        ax.set(xlim=(-0.02, 1.02), ylim=(len(probabilities) - 0.4, -0.6))
        ax.set_xlabel(f"P(a run scores higher than one of {probabilities['baseline'].iloc[0]})")
        ax.set_yticks(range(len(probabilities)), probabilities["agent"])
        ax.tick_params(axis="y", length=0)
        ax.grid(visible=False, axis="y")
        return figure


def efficiency_figure(
    fractions: Mapping[str, np.ndarray],
    curves: Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]],
    axis: tuple[str, float],
    unit: str,
    style: Mapping[str, Look],
    columns: int,
) -> Figure:
    """
    :param fractions: agent -> fraction of the training steps (points,)
    :param curves: agent -> IQM, low, high (points,) each
    :param axis: label of the horizontal axis, and what a fraction of 1 is on it
    """
    with settings():
        figure, (ax,) = _panels(1, columns, PANEL if columns == 1 else 1.75 * PANEL, 3.0)
        label, whole = axis
        for agent, (value, low, high) in curves.items():
            _curve(ax, fractions[agent] * whole, value, low, high, style[agent])
        ax.set(xlabel=label, ylabel=textwrap.fill(f"IQM, {unit}", 32))
        ax.set_xlim(left=0)
        _legend(figure, {agent: style[agent] for agent in curves}, columns)
        return figure


def small_multiples(
    curves: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]], ylabel: str, style: Mapping[str, Look], columns: int
) -> Figure:
    """
    A panel per game, with the mean over runs within one standard deviation; Figure 7 where the curves are losses.

    :param curves: game -> agent -> steps (points,), values (runs, points)
    """
    wide = 2 if columns == 1 else 4 if len(curves) > 9 else 3
    with settings():
        figure, axes = _panels(len(curves), wide, PANEL * columns / wide if len(curves) > 1 else PANEL, 1.9)
        for place, (ax, (game, by_agent)) in enumerate(zip(axes, curves.items(), strict=True)):
            for agent, (steps, values) in by_agent.items():
                mean, spread = values.mean(axis=0), values.std(axis=0, ddof=1) if len(values) > 1 else np.nan
                every = max(1, len(steps) // 5)
                _curve(ax, steps / 1_000, mean, mean - spread, mean + spread, style[agent], every)
            ax.set_title(game, loc="left", color=INK, fontsize=10.5)
            ax.xaxis.set_major_locator(MaxNLocator(4))
            ax.yaxis.set_major_locator(MaxNLocator(4))
            if max(np.abs(ax.get_ylim())) >= 10_000:
                ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value / 1_000:g}k" if value else "0"))
            ax.tick_params(labelsize=9)
            if place % wide == 0:
                ax.set_ylabel(ylabel, fontsize=9.5)
            if place + wide >= len(curves):
                ax.set_xlabel("steps (thousands)", fontsize=9.5)
        drawn = {agent: style[agent] for agent in style if any(agent in by_agent for by_agent in curves.values())}
        _legend(figure, drawn, columns)
        return figure


class Picture(NamedTuple):
    """
    :param name: of the file, without suffix
    :param title: heading in the report
    :param caption: what is shown, plain text
    :param draw: number of columns -> figure
    """

    name: str
    title: str
    caption: str
    draw: Callable[[int], Figure]
