"""Aggregate scores with rliable (Agarwal et al. 2021, https://arxiv.org/abs/2108.13264)."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import numpy as np
import pandas as pd
from rliable import library, metrics
from scipy.stats import norm

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
    How far apart the IQMs of two agents must lie for their runs to show it: the width of the 95 % interval around a
    difference of 0, by the standard deviations that the bootstrap finds.

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
        variance += float(np.var(samples))
    return float(norm.ppf((1 + CONFIDENCE) / 2) * np.sqrt(variance))
