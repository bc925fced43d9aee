"""Aggregates of known scores, by hand and by rliable itself."""

import numpy as np
import pandas as pd
import pytest
from rliable import library, metrics

from sb3_eqr.benchmark.statistics import aggregate, detectable_difference, score_matrices


def table(agent, matrix):
    rows = [
        {"agent": agent, "game": f"game{game}", "seed": seed, "score": score}
        for seed, run in enumerate(matrix)
        for game, score in enumerate(run)
    ]
    return pd.DataFrame(rows).sample(frac=1, random_state=0)


def test_aggregates_by_hand():
    """Two runs, four games: the middle four of the eight scores are 0.2, 0.4, 0.6, 0.8."""
    scores = table("a", [[0.0, 0.2, 0.6, 3.0], [0.1, 0.4, 0.8, 5.0]])
    values = aggregate(score_matrices(scores), reps=10).set_index("metric")["value"]
    assert values["IQM"] == pytest.approx(0.5)
    assert values["mean"] == pytest.approx(10.1 / 8)
    assert values["median"] == pytest.approx((0.3 + 0.7) / 2)  # of the means of the games
    assert values["optimality gap"] == pytest.approx(1 - (0.0 + 0.2 + 0.6 + 1 + 0.1 + 0.4 + 0.8 + 1) / 8)


def test_intervals_are_those_of_rliable():
    matrix = np.random.default_rng(0).gamma(1.0, 1.0, (5, 6))
    found = aggregate({"a": matrix}, reps=200, seed=3)
    np.random.seed(3)
    _, iqm = library.get_interval_estimates({"a": matrix}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=200)
    assert found.loc[0, ["low", "high"]].tolist() == pytest.approx(iqm["a"][:, 0].tolist())
    pd.testing.assert_frame_equal(found, aggregate({"a": matrix}, reps=200, seed=3))
    state = np.random.get_state()[1].copy()
    aggregate({"a": matrix}, reps=5)
    assert (np.random.get_state()[1] == state).all()


def test_a_single_run_has_no_interval():
    found = aggregate({"a": np.ones((1, 4))})
    assert found["value"].tolist() == [1, 1, 1, 0] and found[["low", "high"]].isna().all(axis=None)


def test_unequal_runs_are_told():
    with pytest.raises(ValueError, match="a: expected the same number of runs on every game, found game0: 1, game1: 2"):
        score_matrices(table("a", [[1.0, 2.0], [1.0, 2.0]]).query("game != 'game0' or seed == 0"))


def test_the_detectable_difference_is_what_resampling_whole_experiments_gives():
    """One game without tails to trim: the IQM of n runs varies as 25 %-trimmed means of n draws do."""
    rng = np.random.default_rng(1)
    first, second = rng.normal(0, 1.0, (400, 1)), rng.normal(0, 2.0, (400, 1))
    drawn = rng.normal(0, 1.0, (4_000, 400))
    spread = np.sort(drawn, axis=1)[:, 100:300].mean(axis=1).std()  # of an IQM of 400 runs, sd 1
    assert detectable_difference(first, second) == pytest.approx(1.96 * spread * np.sqrt(1 + 4), rel=0.15)
    with pytest.raises(ValueError, match="two runs or more of each agent, found 1"):
        detectable_difference(first[:1], second)
