"""
Aggregate scores as rliable defines them (Agarwal et al. 2021, https://arxiv.org/abs/2108.13264), each with its 95 % interval.
The intervals of a single run are NaN. A matrix, (runs, games), holds the normalised scores of an agent, and ``matrices`` are
agent -> matrix.
"""

from collections.abc import Callable, Mapping

import numpy as np
import pandas as pd
from scipy.stats import t as student
from scipy.stats import trim_mean

CONFIDENCE = 0.95
MIN_RUNS = 3  # for a verdict: two runs hardly show how much scores differ by chance
REPS = 2_000  # bootstrap samples, stratified by game, as for rliable's profiles
Estimate = tuple[np.ndarray, np.ndarray, np.ndarray]  # value, low, high
Matrices = Mapping[str, np.ndarray]


def iqm(scores: np.ndarray) -> np.ndarray:
    """(..., runs, games) -> (...): the mean of the middle half of all scores."""
    return trim_mean(scores.reshape(*scores.shape[:-2], -1), 0.25, axis=-1)


METRICS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "IQM": iqm,
    "median": lambda scores: np.median(scores.mean(axis=-2), axis=-1),
    "mean": lambda scores: scores.mean(axis=(-2, -1)),
    "optimality gap": lambda scores: 1 - np.minimum(scores, 1).mean(axis=(-2, -1)),
}


def resample(matrix: np.ndarray, reps: int, seed: int = 0) -> np.ndarray:
    """(runs, games, ...) -> (reps, runs, games, ...): bootstrap samples, which are those of rliable's StratifiedBootstrap."""
    drawn = np.random.RandomState(seed).choice(len(matrix), (reps, *matrix.shape))
    return np.take_along_axis(matrix[None], drawn, axis=1)


def estimate(function: Callable[[np.ndarray], np.ndarray], matrix: np.ndarray, reps: int, seed: int = 0) -> Estimate:
    """
    :param function: maps arrays (..., runs, games, ...) to (...) or (..., n)
    :param matrix: (runs, games, ...)
    """
    value = function(matrix)
    if len(matrix) < 2:
        return value, np.full_like(value, np.nan), np.full_like(value, np.nan)
    low, high = np.quantile(function(resample(matrix, reps, seed)), [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], axis=0)
    return value, low, high


def score_matrices(scores: pd.DataFrame) -> dict[str, np.ndarray]:
    """
    :param scores: columns agent, game, seed, score; the scores normalised; each agent has the same seeds on every game
    :return: agent -> (runs, games), games in alphabetical order
    """
    return {
        str(agent): np.ascontiguousarray(rows.pivot(index="seed", columns="game", values="score"))
        for agent, rows in scores.groupby("agent", sort=False)
    }


def aggregate(matrices: Matrices, reps: int = REPS, seed: int = 0) -> pd.DataFrame:
    """:return: columns agent, metric, value, low, high"""

    def all_metrics(scores: np.ndarray) -> np.ndarray:
        return np.stack([function(scores) for function in METRICS.values()], axis=-1)

    found = {
        agent: zip(METRICS, *estimate(all_metrics, matrix, reps, seed), strict=True) for agent, matrix in matrices.items()
    }
    rows = [(agent, *row) for agent, rows in found.items() for row in rows]
    return pd.DataFrame(rows, columns=["agent", "metric", "value", "low", "high"])


def performance_profile(matrix: np.ndarray, thresholds: np.ndarray, reps: int = REPS, seed: int = 0) -> Estimate:
    """
    The fraction of runs, over all games, that score above a threshold (Agarwal et al. 2021, section 4.2; Fig. 4 of EqR).

    :param thresholds: (n,), in the unit of the scores
    :return: (n,) each, with pointwise intervals
    """

    def fractions(scores: np.ndarray) -> np.ndarray:
        return np.stack([(scores > threshold).mean(axis=(-2, -1)) for threshold in thresholds], axis=-1)

    return estimate(fractions, matrix, reps, seed)


def sample_efficiency(curves: np.ndarray, reps: int = REPS) -> Estimate:
    """
    :param curves: (runs, games, points), normalised scores of the evaluations during training
    :return: IQM, low, high: (points,) each
    """
    return estimate(lambda scores: iqm(np.moveaxis(scores, -1, -3)), curves, reps)


def detectable_difference(first: np.ndarray, second: np.ndarray, reps: int = REPS) -> float:
    """
    The smallest difference between the IQMs of two agents that their runs can detect: half the width of the 95 % interval
    around a difference of 0. It uses the bootstrap's variances times n / (n - 1), because a bootstrap of n runs
    underestimates them by that factor, and Student's quantile with Satterthwaite's degrees of freedom, where each variance
    has games (n - 1). Without both corrections, 2 runs on 3 games would distinguish identical agents in a fifth of all cases.

    :return: the difference in the unit of the scores; NaN if either agent has a single run, whose spread is unknown
    """
    if min(len(first), len(second)) < 2:
        return np.nan
    lengths = np.array([len(first), len(second)])
    variances = np.array([np.var(iqm(resample(matrix, reps))) for matrix in (first, second)]) * lengths / (lengths - 1)
    if not variances.any():
        return 0.0
    freedom = variances.sum() ** 2 / (variances**2 / (first.shape[1] * (lengths - 1))).sum()
    return float(student.ppf((1 + CONFIDENCE) / 2, freedom) * np.sqrt(variances.sum()))


def iqm_differences(matrices: Matrices, baseline: str, reps: int = REPS) -> pd.DataFrame:
    """
    :param baseline: the agent that the others are compared with
    :return: columns agent, baseline, runs, baseline_runs, games, difference (of the IQMs, agent - baseline), detectable
        (see :func:`detectable_difference`; NaN for fewer than ``MIN_RUNS`` runs)
    """
    other = matrices[baseline]
    return pd.DataFrame(
        {
            "agent": agent,
            "baseline": baseline,
            "runs": len(matrix),
            "baseline_runs": len(other),
            "games": matrix.shape[1],
            "difference": iqm(matrix) - iqm(other),
            "detectable": detectable_difference(matrix, other, reps) if min(len(matrix), len(other)) >= MIN_RUNS else np.nan,
        }
        for agent, matrix in matrices.items()
        if agent != baseline
    )


def distinct_best(matrices: Matrices, reps: int) -> str | None:
    """:return: the agent with the highest IQM, if these runs distinguish it from every other one"""
    if len(matrices) < 2 or min(map(len, matrices.values())) < MIN_RUNS:
        return None
    best = max(matrices, key=lambda agent: float(iqm(matrices[agent])))
    is_distinct = all(
        iqm(matrices[best]) - iqm(matrix) > detectable_difference(matrices[best], matrix, reps)
        for agent, matrix in matrices.items()
        if agent != best
    )
    return best if is_distinct else None


def games_above(matrix: np.ndarray) -> int:
    """:return: number of games whose mean is above 1: the "superhuman games" of the EqR paper, if 1 is the human score"""
    return int((matrix.mean(axis=0) > 1).sum())
