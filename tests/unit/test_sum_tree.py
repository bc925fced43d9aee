import numpy as np
import pytest

from sb3_eqr.common.replay.sum_tree import SumTree


def leaves_at(priorities, masses):
    """The index of the priority that each mass falls into, with NumPy alone."""
    return np.searchsorted(np.cumsum(priorities), masses, side="right")


@pytest.mark.parametrize("capacity", [1, 2, 3, 7, 64, 65, 100, 1000])
def test_draws_follow_the_running_sum(capacity):
    rng = np.random.default_rng(capacity)
    priorities = rng.random(capacity) * (rng.random(capacity) < 0.7) + (np.arange(capacity) == 0)
    tree = SumTree(capacity)
    tree.set(np.arange(capacity), priorities)
    uniforms = rng.random(1000)
    masses = (np.arange(1000) + uniforms) * (priorities.sum() / 1000)  # one from each of 1,000 equal ranges
    assert np.array_equal(tree.sample(1000, uniforms), leaves_at(priorities, masses))


def test_masses_at_the_boundaries_never_select_a_leaf_of_priority_zero():
    """Priorities are binary fractions, so masses at, just below and just above every running sum are exact."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        priorities = np.where(rng.random(500) < 0.05, 2.0 ** rng.integers(-9, 0, 500), 0.0)
        priorities[300] += 1.0
        priorities[123] += 2.0 ** np.ceil(np.log2(priorities.sum())) - priorities.sum()  # the total is a power of two
        tree = SumTree(500)
        tree.set(np.arange(500), priorities)
        total = priorities.sum()
        sums = np.cumsum(priorities)
        masses = np.concatenate([[0.0], sums[sums < total], np.nextafter(sums, 0), np.nextafter(sums[sums < total], total)])
        found = np.array([tree.sample(1, np.array([mass / total]))[0] for mass in masses])
        assert np.array_equal(found, leaves_at(priorities, masses)) and (tree.get(found) > 0).all()


def test_rounding_does_not_select_beyond_the_last_priority():
    tree = SumTree(6)
    tree.set(np.array([1, 4]), np.array([0.1, 0.2]))  # 0.1 + 0.2 > 0.3
    assert tree.sample(1, np.array([np.nextafter(1.0, 0)])).tolist() == [4]
    assert tree.sample(1, np.array([1.0])).tolist() == [4]  # a mass equal to the total


def test_sums_do_not_drift():
    rng = np.random.default_rng(0)
    tree, values = SumTree(150), np.zeros(150)
    for _ in range(2000):
        leaves = rng.integers(0, 150, 8)
        priorities = rng.random(8) * 10.0 ** rng.integers(-8, 8)
        tree.set(leaves, priorities)
        values[leaves] = priorities
    assert np.array_equal(tree.get(np.arange(150)), values)
    uniforms = rng.random(500)
    masses = (np.arange(500) + uniforms) * (values.sum() / 500)
    assert np.array_equal(tree.sample(500, uniforms), leaves_at(values, masses))


def test_draws_are_proportional_and_stratified():
    tree = SumTree(4)
    tree.set(np.arange(4), np.array([1.0, 2.0, 0.0, 5.0]))
    rng = np.random.default_rng(0)
    counts = np.bincount(np.concatenate([tree.sample(8, rng.random(8)) for _ in range(500)]), minlength=4)
    # Eight strata over a total of eight: each batch draws the leaves exactly 1, 2, 0 and 5 times.
    assert counts.tolist() == [500, 1000, 0, 2500]
