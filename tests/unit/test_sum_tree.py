import numpy as np
import pytest

from sb3_eqr.common.replay.sum_tree import SumTree


@pytest.mark.parametrize("capacity", [1, 2, 3, 7, 64, 65, 100, 1000])
def test_find_is_the_running_sum(capacity):
    rng = np.random.default_rng(capacity)
    priorities = rng.random(capacity) * (rng.random(capacity) < 0.7) + (np.arange(capacity) == 0)
    tree = SumTree(capacity)
    tree.set(np.arange(capacity), priorities)
    masses = rng.random(1000) * priorities.sum() * (1 - 1e-9)
    expected = np.searchsorted(np.cumsum(priorities), masses, side="right")
    assert np.array_equal(tree.find(masses), expected)


def test_masses_on_the_edges_never_find_an_empty_leaf():
    tree = SumTree(6)
    tree.set(np.array([1, 4]), np.array([0.1, 0.2]))
    total = 0.1 + 0.2
    masses = np.array([0.0, 0.1, np.nextafter(0.1, 0), total, np.nextafter(total, 1), 0.05])
    assert tree.find(masses).tolist() == [1, 4, 1, 4, 4, 1]


def test_edges_between_blocks_never_find_an_empty_leaf():
    """Most leaves empty, sizes that round: masses at, just below and just above every running sum."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        priorities = rng.random(500) ** 9 * (rng.random(500) < 0.05) + 1e-9 * (np.arange(500) == 300)
        tree = SumTree(500)
        tree.set(np.arange(500), priorities)
        sums = np.cumsum(priorities)
        masses = np.concatenate([[0.0], sums, np.nextafter(sums, 0), np.nextafter(sums, 9), tree._running_sum()])
        assert (tree.get(tree.find(masses)) > 0).all()


def test_sums_do_not_drift():
    rng = np.random.default_rng(0)
    tree, values = SumTree(150), np.zeros(150)
    for _ in range(2000):
        leaves = rng.integers(0, 150, 8)
        priorities = rng.random(8) * 10.0 ** rng.integers(-8, 8)
        tree.set(leaves, priorities)
        values[leaves] = priorities
    assert np.array_equal(tree.get(np.arange(150)), values)
    masses = rng.random(500) * values.sum() * (1 - 1e-12)
    assert np.array_equal(tree.find(masses), np.searchsorted(np.cumsum(values), masses, side="right"))


def test_draws_are_proportional_and_stratified():
    tree = SumTree(4)
    tree.set(np.arange(4), np.array([1.0, 2.0, 0.0, 5.0]))
    rng = np.random.default_rng(0)
    counts = np.bincount(np.concatenate([tree.sample(8, rng.random(8)) for _ in range(500)]), minlength=4)
    # Eight strata over a total of eight: each batch has exactly one, two, none and five.
    assert counts.tolist() == [500, 1000, 0, 2500]
