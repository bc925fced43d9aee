"""
The figures of a report, counterparts of Figures 4 and 5 of the EqR paper, and curves over
training.
"""

import io
from collections.abc import Mapping
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rliable import plot_utils

from sb3_eqr.benchmark import statistics
from sb3_eqr.benchmark.analysis import Analysis
from sb3_eqr.benchmark.comparison import Comparison
from sb3_eqr.benchmark.reference import SHOWN
from sb3_eqr.benchmark.scores import evaluation_curve, normalised
from sb3_eqr.benchmark.statistics import METRICS
from sb3_eqr.plot_style import GREY, INK, SETTINGS, Look, looks, styled

DPI = 160
N_THRESHOLDS = 81  # points of a performance profile
INTERVALS = "95% stratified bootstrap intervals"


class ReportFigure(NamedTuple):
    """A figure with its texts."""

    name: str  # of the file, without suffix
    title: str  # heading in the report
    caption: str  # plain text
    figure: Figure


def to_png(shown: ReportFigure) -> bytes:
    """:return: the figure as PNG, the same bytes for the same figure; the figure is closed"""
    file = io.BytesIO()
    for ax in shown.figure.axes:
        ax.spines[:].set_linewidth(SETTINGS["axes.linewidth"])  # rliable draws thick ones
    with styled():
        shown.figure.savefig(file, format="png", dpi=DPI, bbox_inches="tight", metadata={"Software": None})
    plt.close(shown.figure)
    return file.getvalue()


def width_on_page(png: bytes) -> int:
    """:return: width in pixels of the page, 100 per inch, at which letters are as large as those of the page's notes"""
    return 100 * int.from_bytes(png[16:20], "big") // DPI


def all_figures(analysis: Analysis) -> list[ReportFigure]:
    """:return: the figures for which there is data"""
    style = looks([analysis.comparison.label(agent) for agent in analysis.matrices])
    with styled():
        found = [_profiles(analysis, style), _aggregates(analysis, style)] if analysis.comparison.is_averaged else []
        found += _sample_efficiency(analysis, style) if found else []
        return found + _learning_curves(analysis.comparison, style)


def _bands(analysis: Analysis, beginning: str) -> str:
    """:return: a sentence on the intervals, "" if all agents have a single run"""
    return "" if analysis.aggregates["low"].isna().all() else f" {beginning} {INTERVALS}."


def _legend(figure: Figure, style: Mapping[str, Look]) -> None:
    lines = [plt.Line2D([], [], color=look.color, linestyle=look.line, marker=look.marker) for look in style.values()]
    figure.legend(lines, list(style), loc="outside lower center", ncols=min(len(style), 3))


def thresholds(matrices: Mapping[str, np.ndarray]) -> np.ndarray:
    """:return: (n,) thresholds of the profiles: from 0, or lower if many scores are, to where few scores are left"""
    scores = np.concatenate([matrix.ravel() for matrix in matrices.values()])
    low = min(0.0, float(np.quantile(scores, 0.1)))
    return np.linspace(low, max(1.0, low + 1.0, 1.05 * float(np.quantile(scores, 0.975))), N_THRESHOLDS)


def _draw(ax: Axes, x: np.ndarray, found: statistics.Estimate, look: Look, **marks: Any) -> None:
    """Draw a curve with the band of its intervals."""
    value, low, high = found
    ax.plot(x, value, color=look.color, linestyle=look.line, marker=look.marker, **marks)
    ax.fill_between(x, low, high, color=look.color, alpha=0.2)


def _profiles(analysis: Analysis, style: Mapping[str, Look]) -> ReportFigure:
    taus = thresholds(analysis.matrices)
    figure, ax = plt.subplots(figsize=(5, 3.2), layout="constrained")
    for look, matrix in zip(style.values(), analysis.matrices.values(), strict=True):
        _draw(ax, taus, statistics.performance_profile(matrix, taus, analysis.reps), look, markevery=N_THRESHOLDS // 8)
    ax.set(xlabel=f"score τ ({analysis.comparison.unit})", ylabel="fraction of runs above τ", yticks=np.linspace(0, 1, 5))
    ax.grid(alpha=0.2)
    _legend(figure, style)
    caption = "Fraction of runs that score above τ, as Figure 4 of the EqR paper. Higher curves are better."
    return ReportFigure("profiles", "Performance profiles", caption + _bands(analysis, "Bands are pointwise"), figure)


def _aggregates(analysis: Analysis, style: Mapping[str, Look]) -> ReportFigure:
    comparison = analysis.comparison
    metrics = [metric for metric in comparison.metrics if metric in METRICS]
    shown = {("runs", agent): comparison.label(agent) for agent in analysis.matrices}
    known = [method for method in SHOWN if method.label in analysis.means]
    shown |= {("game means only", method.label): f"{method.label}, {method.n_runs}" for method in known}
    found = analysis.aggregates.set_index(["from", "agent", "metric"]).sort_index()
    points = {label: found.loc[key].loc[metrics, "value"].to_numpy() for key, label in shown.items()}
    ends = {label: found.loc[key].loc[metrics, ["low", "high"]].to_numpy().T for key, label in shown.items()}
    colors = {label: style[label].color if label in style else GREY for label in points}
    figure, axes = plot_utils.plot_interval_estimates(
        points, ends, metrics, colors=colors, subfigure_width=2.2, row_height=0.3, xlabel="", interval_height=0.6
    )
    for ax, values in zip(axes, zip(*points.values(), strict=True), strict=True):
        ax.invert_yaxis()
        ax.margins(x=0.08)  # bars do not touch the edge
        ax.set_title(ax.get_title(), fontsize="large")
        ax.tick_params(labelsize="medium", length=2)
        ax.set_xlabel(comparison.unit, fontsize="small")
        ax.plot(values, range(len(points)), "o", color=INK, markersize=3)
    gap = "" if comparison.is_raw else ", lower for the optimality gap"
    caption = f"Over all runs and games. Higher is better for IQM, median and mean{gap}; as Figure 5 (a) of the EqR paper."
    caption += _bands(analysis, "Bars are")
    if known:
        caption += (
            " Points without a bar are from published game means, over as many runs as named. The IQM and optimality gap of "
            "game means differ slightly from those of runs."
        )
    return ReportFigure("aggregates", "Aggregate scores", caption, figure)


def normalized_curves(comparison: Comparison) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """
    :return: agent -> fractions of the training steps (points,), normalised scores (runs, games, points); agents whose runs
        have fewer than two points in common are left out
    """
    curves = {}
    for agent in comparison.agents:
        evaluated = {(run["seed"], run["game"]): evaluation_curve(run) for run in comparison.runs(agent)}
        digits = max(2, *(len(str(len(steps) - 1)) for steps, _ in evaluated.values()))  # 3 for more than 100 points
        by_run = {}
        for (seed, game), (steps, raw) in evaluated.items():
            shares = np.round(steps / steps[-1], digits)  # games may differ in steps, and the points of curves by rounding
            curve = pd.Series(normalised(raw, comparison.bounds[game]), index=shares)
            by_run[seed, game] = curve[~curve.index.duplicated(keep="last")]
        table = pd.DataFrame(by_run).dropna()  # points by runs
        if len(table) > 1:
            seeds = sorted({seed for seed, _ in by_run})
            values = [[table[seed, game].to_numpy() for game in comparison.games] for seed in seeds]
            curves[agent] = table.index.to_numpy(), np.array(values)
    return curves


def _sample_efficiency(analysis: Analysis, style: Mapping[str, Look]) -> list[ReportFigure]:
    comparison = analysis.comparison
    curves = normalized_curves(comparison)
    if not curves:
        return []
    steps = {result["protocol"]["steps"] for result in comparison.results}
    whole, axis = (steps.pop() / 1_000, "training steps (thousands)") if len(steps) == 1 else (1.0, "fraction of the steps")
    figure, ax = plt.subplots(figsize=(5, 3.2), layout="constrained")
    shown = {label: style[label] for label in map(comparison.label, curves)}
    for look, (fractions, scores) in zip(shown.values(), curves.values(), strict=True):
        _draw(ax, fractions * whole, statistics.sample_efficiency(scores, analysis.reps), look)
    ax.set(xlabel=axis, ylabel=f"IQM ({comparison.unit})", xlim=(0, None))
    ax.grid(alpha=0.2)
    _legend(figure, shown)
    caption = "IQM of the evaluations during training; the last point is the final evaluation."
    caption += _bands(analysis, "Bands are pointwise")
    return [ReportFigure("sample_efficiency", "Sample efficiency", caption, figure)]


def _learning_curves(comparison: Comparison, style: Mapping[str, Look]) -> list[ReportFigure]:
    """A panel per game: mean and standard deviation over runs, without those that were evaluated only at the end."""
    found = {}
    for run in comparison.results:
        steps, scores = evaluation_curve(run)
        if len(steps) > 1:
            found[run["game"], comparison.label(run["agent"]), run["seed"]] = pd.Series(scores, steps / 1_000)
    if not found:
        return []
    table = pd.DataFrame(found).T  # runs by steps
    games, agents, seeds = (table.index.unique(level) for level in range(3))
    n_columns = min(3, len(games))
    n_rows = -(-len(games) // n_columns)
    size = (2.6 * n_columns, 2.1 * n_rows + 0.4)
    figure, axes = plt.subplots(n_rows, n_columns, figsize=size, squeeze=False, layout="constrained")
    for ax, game in zip(axes.flat, games, strict=False):
        for agent, curves in table.loc[game].groupby(level=0):
            mean = curves.mean().dropna()
            deviation = curves.std().fillna(0)[mean.index]
            _draw(ax, mean.index.to_numpy(), (mean, mean - deviation, mean + deviation), style[agent])
        ax.set(title=game, xlabel="steps (thousands)", xlim=(0, None))
    for unused in axes.flat[len(games) :]:
        unused.remove()
    axes[0, 0].set_ylabel("mean raw score")
    _legend(figure, {agent: look for agent, look in style.items() if agent in agents})
    caption = "Raw scores of the evaluations during training. "
    caption += "Means over runs ± one standard deviation." if len(seeds) > 1 else "A single run each."
    return [ReportFigure("learning_curves", "Learning curves", caption, figure)]
