"""The statistics of a comparison, each computed once, and what they say in words."""

import dataclasses
import math

import numpy as np
import pandas as pd

from sb3_eqr.benchmark import statistics
from sb3_eqr.benchmark.comparison import Comparison
from sb3_eqr.benchmark.reference import SHOWN
from sb3_eqr.benchmark.tables import aggregate_means, label, number, published, superhuman

N_THRESHOLDS = 81  # of performance profiles
FEW_RUNS = 5  # below, the percentile bootstrap is far too narrow


@dataclasses.dataclass(frozen=True)
class Analysis:
    """
    :param comparison: what is compared
    :param matrices: agent or reference -> (runs, games), normalised scores, games in alphabetical order
    :param aggregates: columns agent, metric, value, low, high
    :param means: rows games, columns published methods, raw mean scores
    :param best: the agent of the benchmark with the highest IQM
    :param differences: of IQMs, against the first agent and against the best, see
        :func:`~sb3_eqr.benchmark.statistics.iqm_differences`
    :param improvements: against the first agent, see :func:`~sb3_eqr.benchmark.statistics.improvement_probabilities`
    :param reps: bootstrap samples behind all intervals
    """

    comparison: Comparison
    matrices: dict[str, np.ndarray]
    aggregates: pd.DataFrame
    means: pd.DataFrame
    best: str
    differences: pd.DataFrame
    improvements: pd.DataFrame
    reps: int

    @property
    def baseline(self) -> str:
        """The first agent, a stock one where there is any."""
        return self.comparison.agents[0]


def analyse(comparison: Comparison, reps: int) -> Analysis:
    """
    :param comparison: what is compared
    :param reps: bootstrap samples
    """
    matrices = statistics.score_matrices(comparison.scores)
    aggregates = statistics.aggregate(matrices, reps)
    iqm = aggregates[aggregates["metric"] == "IQM"].set_index("agent")["value"]
    best = str(iqm.reindex(comparison.agents).idxmax())
    baseline = comparison.agents[0]
    differences = statistics.iqm_differences(matrices, baseline, reps)
    if best != baseline:
        rest = {agent: matrix for agent, matrix in matrices.items() if agent != baseline}
        differences = pd.concat([differences, statistics.iqm_differences(rest, best, reps)], ignore_index=True)
    improvements = statistics.improvement_probabilities(matrices, baseline, reps)
    means = published(comparison, SHOWN)
    return Analysis(comparison, matrices, aggregates, means, best, differences, improvements, reps)


def thresholds(analysis: Analysis) -> np.ndarray:
    """
    :return: (n,) where profiles are evaluated: from 0, or below where many scores are, to where few scores are left
    """
    scores = np.concatenate([matrix.ravel() for matrix in analysis.matrices.values()])
    low = min(0.0, float(np.quantile(scores, 0.1)))
    return np.linspace(low, max(1.0, low + 1.0, 1.05 * float(np.quantile(scores, 0.975))), N_THRESHOLDS)


def difference_in_words(row: dict, comparison: Comparison) -> str:
    """
    :param row: of ``Analysis.differences``
    :return: a sentence on whether the runs tell the two agents apart
    """
    agent, other = label(comparison, row["agent"]), label(comparison, row["baseline"])
    if row["difference"] == 0:
        return f"{agent} and {other} have the same IQM."
    size = _small(abs(row["difference"]))
    side = "above" if row["difference"] >= 0 else "below"
    if math.isnan(row["detectable"]):
        return f"{agent} lies {size} {side} {other}: a single run does not show how much of that is chance."
    runs = str(row["runs"]) if row["runs"] == row["baseline_runs"] else f"{row['runs']} and {row['baseline_runs']}"
    shown = f"{runs} runs on {counted(row['games'], 'game')} show differences from {_small(row['detectable'])} on"
    if abs(row["difference"]) < row["detectable"]:
        return f"{agent} and {other} cannot be told apart: the difference is {size}, {shown}."
    return f"{agent} lies {size} {side} {other}: {shown}."


def _small(value: float) -> str:
    """:return: two decimals, or as many as it takes to see a digit of a smaller number"""
    return number(value, 2 if value >= 0.01 or value == 0 else min(6, 1 - math.floor(math.log10(value))))


def counted(count: int, noun: str) -> str:
    """:return: "1 game", "5 games" """
    return f"{count} {noun}{'' if count == 1 else 's'}"


def aggregates_file(analysis: Analysis) -> pd.DataFrame:
    """
    :return: columns agent, metric, value, low, high, runs, games, from ("runs" or "game means only"), protocol_differs
    """
    comparison = analysis.comparison
    above = [
        {"agent": agent, "metric": superhuman(comparison), "value": statistics.games_above(matrix)}
        for agent, matrix in analysis.matrices.items()
    ]
    own = pd.concat([analysis.aggregates, pd.DataFrame(above)], ignore_index=True)
    own["runs"] = [len(analysis.matrices[agent]) for agent in own["agent"]]
    own["from"] = "runs"
    known = aggregate_means(analysis.means, comparison).rename(columns={"label": "agent"})
    known["metric"] = known["metric"].replace("above 1", superhuman(comparison))
    known["runs"] = known["agent"].map({method.label: method.runs for method in SHOWN})
    known["from"] = "game means only"
    table = pd.concat([own, known], ignore_index=True) if len(known) else own
    table["games"] = len(comparison.games)
    table["protocol_differs"] = table["agent"].map(comparison.differing).fillna("")
    return table[["agent", "metric", "value", "low", "high", "runs", "games", "from", "protocol_differs"]]


def notes(analysis: Analysis) -> list[str]:
    """
    :return: sentences that a reader must know before any number
    """
    comparison = analysis.comparison
    found = [f"‡ {agent} was run under another protocol: {what}." for agent, what in comparison.differing.items()]
    found += comparison.notes
    single = [agent for agent, matrix in analysis.matrices.items() if len(matrix) == 1]
    if single:
        verb = "has" if len(single) == 1 else "have"
        found.append(
            f"{', '.join(single)} {verb} a single run per game: no intervals, and no say on what another run would do."
        )
    few = [agent for agent, matrix in analysis.matrices.items() if 1 < len(matrix) < FEW_RUNS]
    if few:
        found.append(
            f"{', '.join(few)}: fewer than {FEW_RUNS} runs per game. A bootstrap of so few is narrower than it should be: "
            'trust no interval that excludes another by little, and read "What the runs can show".'
        )
    return found
