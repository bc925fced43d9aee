"""Aggregate scores with rliable (Agarwal et al. 2021, https://arxiv.org/abs/2108.13264)."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

import numpy as np
import pandas as pd
from rliable import library, metrics
from scipy.stats import t as student

METRICS = {
    "IQM": metrics.aggregate_iqm,
    "median": metrics.aggregate_median,
    "mean": metrics.aggregate_mean,
    "optimality gap": metrics.aggregate_optimality_gap,
}
CONFIDENCE = 0.95  # of all intervals


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed NumPy's global generator, from which rliable's bootstrap draws whatever it is given, and put it back."""
    state = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(state)


def score_matrices(scores: pd.DataFrame) -> dict[str, np.ndarray]:
    """
    :param scores: columns agent, game, seed, score; the scores normalised
    :return: agent -> (runs, games), games in alphabetical order
    :raises ValueError: if an agent has not the same number of runs on every game
    """
    games = sorted(scores["game"].unique())
    matrices = {}
    for agent, rows in scores.groupby("agent", sort=False):
        runs = rows.groupby("game")["seed"].nunique().reindex(games, fill_value=0)
        if runs.nunique() != 1:
            counts = ", ".join(f"{game}: {count}" for game, count in runs.items())
            raise ValueError(f"{agent}: expected the same number of runs on every game, found {counts}")
        columns = [rows[rows["game"] == game].sort_values("seed")["score"].to_numpy() for game in games]
        matrices[str(agent)] = np.stack(columns, axis=1)
    return matrices


def aggregate(matrices: Mapping[str, np.ndarray], reps: int = 2_000, seed: int = 0) -> pd.DataFrame:
    """
    :param matrices: agent -> (runs, games), normalised scores
    :param reps: bootstrap samples, stratified by game
    :param seed: of the bootstrap
    :return: columns agent, metric, value, low, high (of the 95 % interval; NaN with a single run, which has none)
    """
    rows = []
    for agent, matrix in matrices.items():
        values = np.array([function(matrix) for function in METRICS.values()])
        low = high = np.full(len(METRICS), np.nan)
        if len(matrix) > 1:
            with seeded(seed):
                _, intervals = library.get_interval_estimates(
                    {agent: matrix},
                    lambda x: np.array([function(x) for function in METRICS.values()]),
                    reps=reps,
                    confidence_interval_size=CONFIDENCE,
                )
            low, high = intervals[agent]
        rows += [
            {"agent": agent, "metric": name, "value": value, "low": below, "high": above}
            for name, value, below, above in zip(METRICS, values, low, high, strict=True)
        ]
    return pd.DataFrame(rows)


def detectable_difference(first: np.ndarray, second: np.ndarray, reps: int = 2_000, seed: int = 0) -> float:
    """
    How far apart the IQMs of two agents must lie for their runs to show it: half the width of the 95 % interval around a
    difference of 0. Its variances are those that the bootstrap finds, times n / (n - 1), which a bootstrap of n runs is short
    of, and its quantile is Student's, with games (n₁ + n₂ - 2) degrees of freedom: without these two, agents that are alike
    would be told apart by 2 runs on 3 games in a fifth of all cases.

    :param first: (runs, games), normalised scores
    :param second: as well; the number of runs may differ
    :param reps: bootstrap samples, stratified by game
    :param seed: of the bootstrap
    :return: in the unit of the scores
    :raises ValueError: with a single run of either, which says nothing of its spread
    """
    variance = 0.0
    for matrix in (first, second):
        if len(matrix) < 2:
            raise ValueError(f"detectable difference: expected two runs or more of each agent, found {len(matrix)}")
        with seeded(seed):
            samples = library.StratifiedBootstrap(matrix).apply(metrics.aggregate_iqm, reps=reps)
        variance += float(np.var(samples)) * len(matrix) / (len(matrix) - 1)
    freedom = first.shape[1] * (len(first) + len(second) - 2)
    return float(student.ppf((1 + CONFIDENCE) / 2, freedom) * np.sqrt(variance))


def performance_profiles(
    matrices: Mapping[str, np.ndarray], thresholds: np.ndarray, reps: int = 2_000, seed: int = 0
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """
    The fraction of runs, over all games, that score above a threshold (Agarwal et al. 2021, section 4.2; Fig. 4 (a) of EqR).

    :param matrices: agent -> (runs, games), normalised scores
    :param thresholds: (n,), in the unit of the scores
    :param reps: bootstrap samples, stratified by game
    :param seed: of the bootstrap
    :return: agent -> fraction in [0, 1], low, high (n,) each, of pointwise 95 % bands; NaN with a single run
    """
    return _profiles(matrices, thresholds, library.score_distributions, reps, seed)


def average_score_profiles(
    matrices: Mapping[str, np.ndarray], thresholds: np.ndarray, reps: int = 2_000, seed: int = 0
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """
    The fraction of games whose mean over runs is above a threshold (Fig. 4 (b) of EqR).

    :param matrices: agent -> (runs, games), normalised scores
    :param thresholds: (n,), in the unit of the scores
    :param reps: bootstrap samples, stratified by game
    :param seed: of the bootstrap
    :return: as :func:`performance_profiles`
    """
    return _profiles(matrices, thresholds, library.average_score_distributions, reps, seed)


def _profiles(
    matrices: Mapping[str, np.ndarray], thresholds: np.ndarray, distribution: Callable, reps: int, seed: int
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    return {
        agent: _with_interval(matrix, lambda scores: distribution(scores, thresholds), reps, seed)
        for agent, matrix in matrices.items()
    }


def sample_efficiency(
    curves: Mapping[str, np.ndarray], reps: int = 2_000, seed: int = 0
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """
    :param curves: agent -> (runs, games, points), normalised scores at evaluations along training
    :param reps: bootstrap samples, stratified by game and point
    :param seed: of the bootstrap
    :return: agent -> IQM, low, high (points,) each, of the 95 % interval; NaN with a single run
    """

    def iqm(scores: np.ndarray) -> np.ndarray:
        return np.array([metrics.aggregate_iqm(scores[..., point]) for point in range(scores.shape[-1])])

    return {agent: _with_interval(curve, iqm, reps, seed) for agent, curve in curves.items()}


def _with_interval(
    scores: np.ndarray, function: Callable[[np.ndarray], np.ndarray], reps: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    :param scores: (runs, games, ...)
    :param function: of such scores, to (n,)
    :return: value, low, high (n,) each
    """
    if len(scores) < 2:
        value = function(scores)
        return value, np.full_like(value, np.nan), np.full_like(value, np.nan)
    with seeded(seed):
        values, intervals = library.get_interval_estimates(
            {"": scores}, function, reps=reps, confidence_interval_size=CONFIDENCE
        )
    return values[""], *intervals[""]


def probability_of_improvement(first: np.ndarray, second: np.ndarray) -> float:
    """
    How likely a run of the first agent beats one of the second, averaged over games; ties count one half. The same number
    as rliable's function of this name, which needs milliseconds for the p-values that it does not return.

    :param first: (runs, games)
    :param second: as well; the number of runs may differ
    :return: in [0, 1]
    """
    gap = first[:, None] - second[None]  # (runs, runs of the second, games)
    return float(np.mean((gap > 0) + 0.5 * (gap == 0)))


def improvement_probabilities(
    matrices: Mapping[str, np.ndarray], baseline: str, reps: int = 2_000, seed: int = 0
) -> pd.DataFrame:
    """
    :param matrices: agent -> (runs, games), normalised scores
    :param baseline: the agent that the others are held against
    :param reps: bootstrap samples, stratified by game
    :param seed: of the bootstrap
    :return: columns agent, baseline, value, low, high; a row per agent other than the baseline; NaN for the interval where
        either has a single run
    """
    rows = []
    other = matrices[baseline]
    for agent, matrix in matrices.items():
        if agent == baseline:
            continue
        value, low, high = probability_of_improvement(matrix, other), np.nan, np.nan
        if min(len(matrix), len(other)) > 1:
            with seeded(seed):
                _, intervals = library.get_interval_estimates(
                    {agent: [matrix, other]},
                    lambda first, second: np.array([probability_of_improvement(first, second)]),
                    reps=reps,
                    confidence_interval_size=CONFIDENCE,
                )
            low, high = intervals[agent][:, 0]
        rows.append({"agent": agent, "baseline": baseline, "value": value, "low": low, "high": high})
    return pd.DataFrame(rows, columns=["agent", "baseline", "value", "low", "high"])


def games_above(matrix: np.ndarray, bound: float = 1.0) -> int:
    """
    :param matrix: (runs, games), normalised scores
    :param bound: 1 is human play where scores are human-normalised: the "superhuman games" of the EqR paper's tables
    :return: on how many games the mean over runs is above the bound
    """
    return int((matrix.mean(axis=0) > bound).sum())


def iqm_differences(matrices: Mapping[str, np.ndarray], baseline: str, reps: int = 2_000, seed: int = 0) -> pd.DataFrame:
    """
    :param matrices: agent -> (runs, games), normalised scores
    :param baseline: the agent that the others are held against
    :param reps: bootstrap samples, stratified by game
    :param seed: of the bootstrap
    :return: columns agent, baseline, runs, baseline_runs, games, difference (of the IQMs, agent - baseline), detectable
        (see :func:`detectable_difference`; NaN where either has a single run)
    """
    other = matrices[baseline]
    rows = []
    for agent, matrix in matrices.items():
        if agent == baseline:
            continue
        enough = min(len(matrix), len(other)) > 1
        rows.append(
            {
                "agent": agent,
                "baseline": baseline,
                "runs": len(matrix),
                "baseline_runs": len(other),
                "games": matrix.shape[1],
                "difference": metrics.aggregate_iqm(matrix) - metrics.aggregate_iqm(other),
                "detectable": detectable_difference(matrix, other, reps, seed) if enough else np.nan,
            }
        )
    return pd.DataFrame(rows)
