"""The metrics of a diagnosis, compared with numbers computed by hand."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.utils import explained_variance

from sb3_eqr.visualize import measures
from sb3_eqr.visualize.diagnostics import find_verdict, skill_and_gain


def test_transition_error_matches_loops_over_windows_and_pairs():
    rng = np.random.default_rng(0)
    n, m, d = 6, 3, 4
    x0, x, guess = rng.normal(size=(n, d)), rng.normal(size=(n, m, d)), rng.normal(size=(n, m, d))
    mask = (np.arange(m) < rng.integers(1, m + 1, n)[:, None]).astype(float)
    found = measures.transition_error(*(th.as_tensor(a) for a in (x0, x, guess, mask)))
    for step in range(m):
        valid = np.flatnonzero(mask[:, step])
        error = np.mean([np.sum((guess[i, step] - x[i, step]) ** 2) for i in valid])
        shuffled = np.mean([np.sum((guess[i, step] - x[j, step]) ** 2) for i in valid for j in valid])
        still = np.mean([np.sum((x0[i] - x[i, step]) ** 2) for i in valid])
        assert found.n_windows[step] == len(valid)
        assert np.allclose([found.error[step], found.shuffled[step], found.still[step]], [error, shuffled, still])
        assert np.allclose([found.skill[step], found.gain[step]], [1 - error / shuffled, 1 - error / still])


def test_transition_of_an_exact_rollout_and_of_one_state():
    x = th.randn(8, 2, 3, generator=th.Generator().manual_seed(0))
    exact = measures.transition_error(th.zeros(8, 3), x, x, th.ones(8, 2))
    assert (exact.error == 0).all() and (exact.skill == 1).all() and (exact.gain == 1).all()
    one = th.ones(8, 2, 3)
    nothing = measures.transition_error(one[:, 0], one, one, th.ones(8, 2))
    assert np.isnan(nothing.skill).all() and np.isnan(nothing.gain).all()  # 0 / 0
    unseen = measures.transition_error(one[:, 0], one, one, th.tensor([[1.0, 0.0]]).expand(8, 2))
    assert unseen.n_windows.tolist() == [8, 0] and np.isnan(unseen.error[1])


def test_reward_error():
    rng = np.random.default_rng(0)
    guess, true, mask = rng.normal(size=(9, 2)), rng.normal(size=(9, 2)), np.ones((9, 2))
    mask[5:, 1] = 0
    found = measures.reward_error(*(th.as_tensor(a) for a in (guess, true, mask)))
    for m, n in enumerate((9, 5)):
        assert found.error[m] == pytest.approx(np.mean((guess[:n, m] - true[:n, m]) ** 2))
        assert found.constant[m] == pytest.approx(np.mean((true[:n, m] - true[:n, m].mean()) ** 2))
        assert found.explained[m] == pytest.approx(explained_variance(guess[:n, m], true[:n, m]))
    same = measures.reward_error(th.zeros(4, 1), th.ones(4, 1), th.ones(4, 1))
    assert same.error == 1 and same.constant == 0 and np.isnan(same.explained)


def test_moments_of_angles_across_pi():
    mean, std = measures.angle_moments(th.tensor([np.pi - 0.1, -np.pi + 0.1]))
    assert abs(mean) == pytest.approx(np.pi) and std == pytest.approx(np.sqrt(-2 * np.log(np.cos(0.1))), rel=1e-4)
    mean, std = measures.angle_moments(0.5 + 0.01 * th.randn(5000, generator=th.Generator().manual_seed(0)))
    assert mean == pytest.approx(0.5, abs=1e-3) and std == pytest.approx(0.01, rel=0.05)


def test_concentration():
    weights = np.array([[3.0, 1.0, 2.0, 0.0], [0.0, 1.0, 2.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
    assert np.allclose(measures.concentration(weights, axis=0), [1, 0, 0.5, np.nan], equal_nan=True)
    assert np.isnan(measures.concentration(np.ones((1, 2)), axis=0)).all()


def test_opposites_are_mutual():
    generators = np.array([[1.0, 0.0], [-2.0, 0.1], [0.0, 1.0], [0.1, -1.0], [0.0, 0.0]])
    assert measures.opposites(generators) == [1, 0, 3, 2, 4]
    assert measures.opposites(np.array([[1.0, 0.0], [0.9, 0.1], [-1.0, 0.0]])) == [2, 1, 0]  # the second has no opposite
    merged = measures.merged(np.arange(10.0).reshape(5, 2), [1, 0, 3, 2, 4])
    assert merged.tolist() == [[1, 2], [5, 6], [8, 9]]


def test_canonical_correlations():
    generator = th.Generator().manual_seed(0)
    x, noise = th.randn(20_000, 2, generator=generator), th.randn(20_000, 2, generator=generator)
    turned = x @ th.tensor([[2.0, 1.0, 0.0], [0.0, -3.0, 1.0]]) + 5
    half = th.stack([x[:, 0], noise[:, 0]], dim=1)
    found = measures.canonical_correlations([x, turned, noise, x + noise, half, th.ones(20_000, 1)])
    assert np.allclose(found[0], [1, 1, 0, np.sqrt(0.5), 0.5, 0], atol=0.02)
    assert (found == found.T).all() and (np.diag(found) == 1).all()


def test_mutual_information_of_a_known_joint():
    counts = np.array([[400, 100], [50, 450]])
    first, second = np.repeat([0, 0, 1, 1], counts.ravel()), np.repeat([0, 1, 0, 1], counts.ravel())
    p = counts / 1000
    plain = (p * np.log(p / p.sum(axis=1, keepdims=True) / p.sum(axis=0))).sum()
    miller = (1 + 1 - 3) / 2000  # occupied labels minus one: of each variable, minus that of both
    assert measures.mutual_information(first, second) == pytest.approx(plain + miller)
    assert measures.entropy(np.arange(1600) % 16) == pytest.approx(np.log(16) + 15 / 3200)
    a, b = np.random.default_rng(0).integers(0, 10, (2, 1000))
    assert measures.mutual_information(a, b) < 0.015  # 0.04 without the correction
    assert measures.mutual_information(a, np.zeros(1000, dtype=int)) == 0


def test_bins_and_cells_find_the_positions_of_a_ring():
    places = np.random.default_rng(0).integers(0, 16, 800)
    angles = 2 * np.pi * places / 16
    points = th.as_tensor(np.stack([np.cos(angles), np.sin(angles)], axis=1))
    labels = measures.cells(points, n_cells=16)
    assert measures.mutual_information(labels, places) == pytest.approx(measures.entropy(places))
    assert np.bincount(measures.bins(np.sin(np.arange(800)), 8)).tolist() == [100] * 8
    assert len(np.unique(measures.bins(places, 40))) == 16  # no more bins than distinct values
    assert not measures.cells(th.ones(9, 2)).any()


def test_information_gap():
    information = np.array([[0.9, 0.5], [0.2, 0.4], [0.1, 0.5]])
    assert np.allclose(measures.information_gap(information), [0.7, 0])
    assert np.isnan(measures.information_gap(information[:1])).all()


@pytest.mark.parametrize("values, rank", [([2, 2, 2, 0], 3), ([5], 1), ([2, 1, 1], 2**1.5), ([0, 0], 0), ([1, 1e-9], 1)])
def test_effective_rank(values, rank):
    assert measures.effective_rank(np.array(values, dtype=float), size=1.0) == pytest.approx(rank)


def test_spectrum_is_of_the_covariance():
    x = th.randn(50, 3, generator=th.Generator().manual_seed(0), dtype=th.float64) * th.tensor([1.0, 5.0, 0.1])
    variances = np.linalg.eigvalsh(np.cov(x.numpy().T, bias=True))[::-1]
    assert np.allclose(measures.spectrum(x) ** 2, variances)


def errors(error, shuffled, still):
    rows = [np.array(values) for values in (error, shuffled, still)]
    return measures.Transition(*rows, 1 - rows[0] / rows[1], 1 - rows[0] / rows[2], np.array([100, 50]))


@pytest.mark.parametrize(
    "error, shuffled, still, verdict",
    [
        ([0.01, 0.02], [0.1, 0.1], [0.05, 0.1], "predicts"),
        ([1e-8, 1e-8], [1e-6, 1e-6], [1e-6, 1e-6], "predicts"),  # states differ little, but it predicts how
        ([0.01, 0.02], [0.1, 0.1], [0.001, 0.002], "does not predict"),  # κ changes states less than they differ
        ([0.2, 0.2], [0.2, 0.2], [1e-7, 1e-7], "does not predict"),  # a single state, which κ does not change
        ([1e-7, 1e-7], [1e-6, 1e-6], [1e-8, 1e-8], "collapsed"),
    ],
)
def test_verdict(error, shuffled, still, verdict):
    assert find_verdict(errors(error, shuffled, still)) == verdict


def test_skill_and_gain_weight_steps_by_their_windows():
    skill, gain = skill_and_gain(errors([1.0, 4.0], [4.0, 4.0], [2.0, 8.0]))
    assert skill == pytest.approx(1 - (100 * 1 + 50 * 4) / (100 * 4 + 50 * 4))
    assert gain == pytest.approx(1 - (100 * 1 + 50 * 4) / (100 * 2 + 50 * 8))
