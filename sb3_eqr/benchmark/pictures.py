"""Which figures a report has, from the statistics of a comparison."""

import re
from collections.abc import Sequence
from functools import partial

import numpy as np

from sb3_eqr.benchmark import figures, statistics
from sb3_eqr.benchmark.analysis import Analysis, thresholds
from sb3_eqr.benchmark.curves import learning_curves, normalized_curves, symmetry_losses
from sb3_eqr.benchmark.figures import Picture
from sb3_eqr.benchmark.reference import SHOWN, SHOWN_GROUPS, SHOWN_LOSSES, PublishedMethod
from sb3_eqr.benchmark.tables import aggregate_means, label, published

BEST = (
    "Best is a high IQM, median and mean and a low optimality gap; Figure 5 (a) of the EqR paper has the first and the last."
)
INTERVALS = "95% stratified bootstrap intervals"
# the agents of Figure 5 (b) and of Figure 6, by the names that agents have in a benchmark
ABLATIONS = {
    "loss_components": (
        r"(eqr_\w+):se2\+aet.*",
        "Losses",
        SHOWN_LOSSES,
        "Agents that differ in their losses, as in Figure 5 (b) of the EqR paper.",
    ),
    "groups": (
        r"(eqr_\w+):(mlp|t2|se2|gl2)\+aet\+r",
        "Groups",
        SHOWN_GROUPS,
        "Agents that differ in their group, as in Figure 6 of the EqR paper.",
    ),
}


def all_pictures(analysis: Analysis) -> list[Picture]:
    """
    :return: the figures that have something to show
    """
    style = figures.looks([label(analysis.comparison, agent) for agent in analysis.matrices])
    return [
        _profiles(analysis, style),
        _intervals(analysis, style, "aggregates", "Aggregate scores", list(analysis.matrices), SHOWN, BEST),
        *_ablations(analysis, style),
        *_improvements(analysis, style),
        *_along_training(analysis, style),
    ]


def _intervals_are(analysis: Analysis, beginning: str) -> str:
    """:return: a sentence on the intervals, "" where all agents have a single run"""
    return "" if analysis.aggregates["low"].isna().all() else f" {beginning} {INTERVALS}."


def _profiles(analysis: Analysis, style: dict[str, figures.Look]) -> Picture:
    taus = thresholds(analysis)
    named = {label(analysis.comparison, agent): matrix for agent, matrix in analysis.matrices.items()}
    profiles = {
        "Score distributions": {
            agent: statistics.performance_profile(matrix, taus, analysis.reps) for agent, matrix in named.items()
        },
        "Average score distributions": {
            agent: statistics.average_score_profile(matrix, taus, analysis.reps) for agent, matrix in named.items()
        },
    }
    caption = (
        "Fraction of runs (a) and of games, by their mean over runs (b), above a score, as Figure 4 of the EqR paper. "
        f"The higher the curve, the better.{_intervals_are(analysis, 'Bands are pointwise')}"
    )
    draw = partial(figures.profile_figure, profiles, taus, analysis.comparison.unit, style)
    return Picture("profiles", "Performance profiles", caption, draw)


def _intervals(
    analysis: Analysis,
    style: dict[str, figures.Look],
    name: str,
    title: str,
    agents: Sequence[str],
    methods: Sequence[PublishedMethod],
    explained: str,
) -> Picture:
    rows = analysis.aggregates[analysis.aggregates["agent"].isin(agents)].copy()
    rows["agent"] = [label(analysis.comparison, agent) for agent in rows["agent"]]
    points = aggregate_means(published(analysis.comparison, methods), analysis.comparison)
    shown = {method.label: f"{method.label}, {method.n_runs}" for method in methods}
    points["label"] = points["label"].map(shown).astype(str)
    caption = f"{explained} Over all runs and games.{_intervals_are(analysis, 'Bars are')}"
    if len(points):
        caption += (
            " Hollow, below the line: published, game means only (of as many runs as told), no interval. The IQM and the "
            "optimality gap of game means are not quite those of runs."
        )
    return Picture(name, title, caption, partial(figures.interval_figure, rows, points, analysis.comparison.unit, style))


def _ablations(analysis: Analysis, style: dict[str, figures.Look]) -> list[Picture]:
    found = []
    for name, (pattern, title, methods, explained) in ABLATIONS.items():
        by_algorithm: dict[str, list[str]] = {}
        for agent in analysis.comparison.agents:
            if match := re.fullmatch(pattern, agent):
                by_algorithm.setdefault(match[1], []).append(agent)
        for algorithm, agents in by_algorithm.items():
            if len(agents) > 1:
                heading = f"{title} of {algorithm}"
                found.append(_intervals(analysis, style, f"{name}_{algorithm}", heading, agents, methods, explained))
    return found


def _improvements(analysis: Analysis, style: dict[str, figures.Look]) -> list[Picture]:
    if analysis.improvements.empty:
        return []
    rows = analysis.improvements.copy()
    for column in ("agent", "baseline"):
        rows[column] = [label(analysis.comparison, agent) for agent in rows[column]]
    caption = (
        f"How likely a run of an agent scores higher than one of {rows['baseline'].iloc[0]}, the baseline (--baseline, or the "
        f"first stock agent), averaged over games.{_intervals_are(analysis, 'Bars are')}"
    )
    draw = partial(figures.improvement_figure, rows, style)
    return [Picture("improvement", "Probability of improvement", caption, draw)]


def _along_training(analysis: Analysis, style: dict[str, figures.Look]) -> list[Picture]:
    comparison = analysis.comparison
    found = []
    fractions, curves = normalized_curves(comparison)
    if curves:
        named = {label(comparison, agent): curve for agent, curve in curves.items()}
        steps = {result["protocol"]["steps"] for result in comparison.results}
        axis = ("training steps (thousands)", steps.pop() / 1_000) if len(steps) == 1 else ("fraction of training steps", 1.0)
        efficiency = {agent: statistics.sample_efficiency(curve, analysis.reps) for agent, curve in named.items()}
        points = {label(comparison, agent): fraction for agent, fraction in fractions.items()}
        caption = "IQM of evaluations along training; the last point is the final evaluation."
        caption += _intervals_are(analysis, "Bands are pointwise")
        draw = partial(figures.efficiency_figure, points, efficiency, axis, comparison.unit, style)
        found.append(Picture("sample_efficiency", "Sample efficiency", caption, draw))
    for name, title, per_game, ylabel, caption in (
        (
            "learning_curves",
            "Learning curves",
            learning_curves(comparison),
            "mean raw score",
            "Raw scores of evaluations along training.",
        ),
        (
            "symmetry_losses",
            "Symmetry losses",
            symmetry_losses(comparison),
            "$L_{AET} + L_{GET}$",
            "L_AET + L_GET along training, as Figure 7 of the EqR paper; the one that an agent has where it has not both.",
        ),
    ):
        if per_game:
            shown = {
                game: {label(comparison, a): curve for a, curve in by_agent.items()} for game, by_agent in per_game.items()
            }
            band = " Means over runs within one standard deviation." if _has_spread(shown) else " A single run each."
            draw = partial(figures.small_multiples, shown, ylabel, style)
            found.append(Picture(name, title, caption + band, draw))
    return found


def _has_spread(per_game: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]) -> bool:
    return any(len(values) > 1 for by_agent in per_game.values() for _, values in by_agent.values())
