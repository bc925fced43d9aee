"""Aggregates of known scores, compared with numbers computed by hand and with rliable."""

import numpy as np
import pandas as pd
import pytest
from rliable import library, metrics
from scipy.stats import ttest_ind

from sb3_eqr.benchmark.statistics import (
    aggregate,
    detectable_difference,
    games_above,
    iqm_differences,
    performance_profile,
    sample_efficiency,
    score_matrices,
)


def table(agent, matrix):
    rows = [(agent, f"game{game}", seed, score) for seed, run in enumerate(matrix) for game, score in enumerate(run)]
    return pd.DataFrame(rows, columns=["agent", "game", "seed", "score"]).sample(frac=1, random_state=0)


def test_aggregates_by_hand():
    """Two runs, four games: the middle four of the eight scores are 0.2, 0.4, 0.6, 0.8."""
    scores = table("a", [[0.0, 0.2, 0.6, 3.0], [0.1, 0.4, 0.8, 5.0]])
    values = aggregate(score_matrices(scores), reps=10).set_index("metric")["value"]
    assert values["IQM"] == pytest.approx(0.5)
    assert values["mean"] == pytest.approx(10.1 / 8)
    assert values["median"] == pytest.approx((0.3 + 0.7) / 2)  # of the games' means
    assert values["optimality gap"] == pytest.approx(1 - (0.0 + 0.2 + 0.6 + 1 + 0.1 + 0.4 + 0.8 + 1) / 8)


def test_intervals_match_rliable():
    matrix = np.random.default_rng(0).gamma(1.0, 1.0, (5, 6))
    found = aggregate({"a": matrix}, reps=200, seed=3)
    np.random.seed(3)
    _, iqm = library.get_interval_estimates({"a": matrix}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=200)
    assert found.loc[0, ["low", "high"]].tolist() == pytest.approx(iqm["a"][:, 0].tolist())
    pd.testing.assert_frame_equal(found, aggregate({"a": matrix}, reps=200, seed=3))
    state = np.random.get_state()[1].copy()
    aggregate({"a": matrix}, reps=5)
    assert (np.random.get_state()[1] == state).all()


def test_the_detectable_difference_matches_resampled_experiments():
    """For one game, the IQM of n runs varies like the 25 %-trimmed mean of n samples."""
    rng = np.random.default_rng(1)
    first, second = rng.normal(0, 1.0, (400, 1)), rng.normal(0, 2.0, (400, 1))
    drawn = rng.normal(0, 1.0, (1_000, 400))
    spread = np.sort(drawn, axis=1)[:, 100:300].mean(axis=1).std()  # of the IQM of 400 runs with standard deviation 1
    assert detectable_difference(first, second, 500) == pytest.approx(1.96 * spread * np.sqrt(1 + 4), rel=0.15)
    assert np.isnan(detectable_difference(first[:1], second))


@pytest.mark.parametrize("n_runs", [2, 3])
def test_the_detectable_difference_of_few_runs_matches_a_t_test(n_runs):
    """The IQM of three runs on one game is their mean, because it trims none."""
    first, second = np.random.default_rng(0).normal(0, [[1.0], [2.0]], (2, n_runs))
    low, high = ttest_ind(first, second, equal_var=False).confidence_interval(0.95)
    found = detectable_difference(first[:, None], second[:, None], 2_000)
    assert found == pytest.approx((high - low) / 2, rel=0.1)  # the freedom depends on the bootstrap's variances, too


def test_the_detectable_difference_with_different_numbers_of_runs():
    """The runs 0, 0 and 3 have the variance 3, and the error 1 of their mean; the others are equal. 3 - 1 = 2 degrees."""
    first, second = np.zeros((2, 1)), np.array([[0.0], [0.0], [3.0]])
    for pair in ((first, second), (second, first)):
        assert detectable_difference(*pair, 2_000) == pytest.approx(4.303, rel=0.05)  # Student's t, 97.5 %
    assert detectable_difference(np.zeros((2, 1)), np.ones((3, 1))) == 0


def test_the_detectable_difference_of_several_games_matches_a_t_test():
    """Four games far apart, two runs: the IQM is the mean over the second and third game."""
    rng = np.random.default_rng(0)
    first = rng.normal([-1e6, 0, 1, 1e6], [1, 1, 2, 1], (2, 4))
    second = first + 5  # with the same spread
    variances = 2 * first[:, 1:3].var(axis=0, ddof=1).sum()
    critical = 2.306  # Student's t, 4 games times 2 + 2 - 2 degrees of freedom, 97.5 %
    assert detectable_difference(first, second, 500) == pytest.approx(critical * np.sqrt(variances / 2) / 2, rel=0.1)


def test_equal_agents_are_rarely_distinguished():
    """
    At most in 11 of 100 trials: 5 % plus three standard deviations. With the bootstrap's variance and a normal quantile it
    would be 20 %.
    """
    rng = np.random.default_rng(0)
    means = rng.normal(size=3)
    apart = 0
    for _ in range(100):
        first, second = rng.normal(means, 1, (2, 2, 3))  # two runs, three games
        apart += abs(metrics.aggregate_iqm(first) - metrics.aggregate_iqm(second)) > detectable_difference(first, second, 30)
    assert apart <= 11


def test_profiles_by_hand():
    """Two runs, two games: 3 of 4 scores are above 0.5, and so is the mean of one of two games. 0.8 is not above 0.8."""
    matrix = np.array([[0.0, 0.6], [0.8, 1.0]])
    taus = np.array([-1.0, 0.5, 0.8, 2.0])
    value, low, high = performance_profile(matrix, taus, reps=20)
    assert value.tolist() == [1, 0.75, 0.25, 0] and (low <= value).all() and (value <= high).all() and low[1] < high[1]
    _, low, high = performance_profile(np.ones((1, 2)), taus, reps=20)
    assert np.isnan(low).all() and np.isnan(high).all()


def test_profiles_match_rliable():
    matrix, taus = np.random.default_rng(0).gamma(1.0, 1.0, (4, 3)), np.linspace(0, 2, 5)
    np.random.seed(5)
    values, bands = library.create_performance_profile({"a": matrix}, taus, reps=30)
    found = performance_profile(matrix, taus, reps=30, seed=5)
    np.testing.assert_allclose(found, [values["a"], *bands["a"]])


def test_sample_efficiency_is_an_iqm_per_point():
    curves = np.random.default_rng(0).gamma(1.0, 1.0, (4, 5, 3))
    value, low, high = sample_efficiency(curves, reps=50)
    assert value.tolist() == pytest.approx([metrics.aggregate_iqm(curves[..., point]) for point in range(3)])
    assert (low < value).all() and (value < high).all()


def test_games_above_a_threshold_are_counted_by_their_means():
    assert games_above(np.array([[0.0, 1.0, 3.0], [3.0, 1.0, 0.0]])) == 2


def test_differences_of_iqms():
    first, second = np.array([[0.0], [1.0], [0.5]]), np.array([[2.0], [2.0], [2.0]])
    row = iqm_differences({"a": first, "b": second, "c": first[:2]}, "a", reps=100).to_dict("records")
    assert row[0]["difference"] == pytest.approx(1.5)
    assert [row[0][key] for key in ("runs", "baseline_runs", "games")] == [3, 3, 1]
    assert row[0]["detectable"] == detectable_difference(second, first, reps=100) and np.isnan(row[1]["detectable"])
