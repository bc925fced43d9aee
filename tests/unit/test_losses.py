import math

import numpy as np
import pytest
import torch as th
from sb3_contrib.common.utils import quantile_huber_loss as contrib_quantile_huber_loss

from sb3_eqr.common.losses import (
    categorical_loss,
    categorical_projection,
    contrastive_loss,
    normalized_distance,
    quantile_huber_loss,
    reward_cross_entropy,
    reward_mse,
)


def test_normalized_distance_by_hand():
    a = th.tensor([[3.0, 4.0], [1.0, 0.0], [2.0, 0.0], [0.0, 0.0]])
    b = th.tensor([[6.0, 8.0], [0.0, 5.0], [-1.0, 0.0], [1.0, 0.0]])
    # same direction, a right angle, opposite directions, no direction
    th.testing.assert_close(normalized_distance(a, b), th.tensor([0.0, 2.0, 4.0, 1.0]))


def test_normalized_distance_is_that_of_unit_vectors():
    """Value and gradient, also of nearly equal directions, short and long vectors, in float64 by the definition."""
    rng = np.random.default_rng(0)
    for size, noise in ((1.0, 1.0), (1e-6, 1e-3), (1e4, 1e-3)):
        wanted = rng.normal(size=(50, 2, 16))
        given = size * (wanted + noise * rng.normal(size=wanted.shape))
        found, answers = [], []
        for dtype in (th.float32, th.float64):
            y, target = th.tensor(given, dtype=dtype, requires_grad=True), th.tensor(wanted, dtype=dtype)
            units = [x / x.norm(dim=-1, keepdim=True) for x in (y, target)]
            distance = normalized_distance(y, target) if dtype == th.float32 else (units[0] - units[1]).pow(2).sum(dim=-1)
            (gradient,) = th.autograd.grad(distance.sum(), y)
            (found if dtype == th.float32 else answers).extend([distance.double(), size * gradient.double()])
        th.testing.assert_close(found[0], answers[0], rtol=1e-5, atol=1e-6)
        th.testing.assert_close(found[1], answers[1], rtol=1e-4, atol=1e-6)


def test_contrastive_loss_by_hand():
    one, two = th.tensor([1.0, 0.0]), th.tensor([0.0, 3.0])
    target = th.stack([one, two])[:, None]  # (2, 1, 2): a right angle apart
    own, other, same = math.exp(1 / 0.2), math.exp(0.0), math.log(2)
    every = th.ones(2, 1)
    found = contrastive_loss(5 * target, target, every)
    th.testing.assert_close(found, th.full((2, 1), -math.log(own / (own + other))))
    th.testing.assert_close(contrastive_loss(target.flip(0), target, every), th.full((2, 1), -math.log(other / (own + other))))
    th.testing.assert_close(contrastive_loss(target, one.expand(2, 1, 2), every), th.full((2, 1), same))  # a collapse: log B
    # negatives come from the same step
    steps = th.cat([target, target.flip(0)], dim=1)  # (2, 2, 2)
    th.testing.assert_close(contrastive_loss(steps, steps, th.ones(2, 2)), th.full((2, 2), -math.log(own / (own + other))))
    # steps after the end of an episode are not negatives, and their values do not affect the others
    mask = th.tensor([[1.0], [0.0]])
    masked = contrastive_loss(target, th.stack([one, 7 * one])[:, None], mask)
    th.testing.assert_close(masked[0], th.zeros(1))
    assert masked.isfinite().all()


def test_normalized_distance_has_finite_gradients_at_zero():
    a = th.zeros(1, 3, requires_grad=True)
    normalized_distance(a, th.ones(1, 3)).sum().backward()
    assert th.isfinite(a.grad).all()


def test_quantile_huber_loss_has_the_mean_and_gradient_of_sb3_contribs():
    generator = th.Generator().manual_seed(0)
    values, target = th.randn(2, 32, 51, generator=generator) * 3
    ours, theirs = values.clone().requires_grad_(), values.clone().requires_grad_()
    quantile_huber_loss(ours, target).mean().backward()
    loss = contrib_quantile_huber_loss(theirs, target, sum_over_quantiles=True)
    loss.backward()
    assert th.equal(ours.grad, theirs.grad)
    th.testing.assert_close(quantile_huber_loss(values, target).mean(), loss.detach())


@pytest.mark.parametrize(
    "values, probabilities, expected",
    [
        ([-1.0, 0.0, 1.0], [0.2, 0.5, 0.3], [0.2, 0.5, 0.3]),  # the atoms themselves
        ([-0.5, 0.0, 0.25], [0.2, 0.4, 0.4], [0.1, 0.1 + 0.4 + 0.3, 0.1]),  # between atoms
        ([0.4, 0.4, 0.4], [0.2, 0.4, 0.4], [0.0, 0.6, 0.4]),  # terminal: all atoms at the reward
        ([5.0, 6.0, 7.0], [0.2, 0.4, 0.4], [0.0, 0.0, 1.0]),  # all above the range
        ([-3.0, -0.75, 9.0], [0.5, 0.2, 0.3], [0.5 + 0.15, 0.05, 0.3]),  # both ends clipped: no longer evenly spaced
        ([0.5, -2.0, 0.0], [0.4, 0.1, 0.5], [0.1, 0.2 + 0.5, 0.2]),  # decreasing, then increasing once clipped
        ([2.0, 0.0, -1.5], [0.1, 0.2, 0.7], [0.7, 0.2, 0.1]),  # decreasing
    ],
)
def test_projection_by_hand(values, probabilities, expected):
    found = categorical_projection(th.tensor([values]), th.tensor([probabilities]), -1.0, 1.0)
    th.testing.assert_close(found, th.tensor([expected]), rtol=0, atol=1e-6)


@pytest.mark.parametrize("n_atoms, v_min, v_max", [(51, -10.0, 10.0), (2, 0.0, 1.0), (11, -3.0, 17.0), (101, -0.1, 0.2)])
def test_projection_against_a_loop_in_float64(n_atoms, v_min, v_max):
    """Eq. 7 of Bellemare et al. 2017 for each atom and each value; some transitions are terminal."""
    rng = np.random.default_rng(0)
    batch, spacing = 8, (v_max - v_min) / (n_atoms - 1)
    support = v_min + spacing * np.arange(n_atoms)
    rewards = rng.normal(size=(batch, 1)) * (v_max - v_min) / 2
    discounts = 0.99**10 * (rng.random((batch, 1)) < 0.7)  # 0: terminal
    values = rewards + discounts * support
    probabilities = rng.dirichlet(np.full(n_atoms, 0.3), size=batch)
    expected = np.zeros((batch, n_atoms))
    for b in range(batch):
        for i in range(n_atoms):
            for j in range(n_atoms):
                distance = abs(min(max(values[b, j], v_min), v_max) - support[i]) / spacing
                expected[b, i] += max(1 - distance, 0) * probabilities[b, j]
    exact = categorical_projection(th.tensor(values), th.tensor(probabilities), v_min, v_max)
    np.testing.assert_allclose(exact, expected, atol=1e-12)
    single = categorical_projection(th.tensor(values).float(), th.tensor(probabilities).float(), v_min, v_max)
    np.testing.assert_allclose(single, expected, atol=2e-5)
    assert (single.double().sum(dim=1) - th.tensor(probabilities).float().double().sum(dim=1)).abs().max() < 1e-6
    assert (single >= 0).all()


def test_categorical_loss_by_hand():
    logits = th.tensor([[0.0, 0.0], [0.0, math.log(3)], [5.0, 5.0]], requires_grad=True)
    target = th.tensor([[0.5, 0.5], [0.5, 0.5], [1.0, 0.0]])
    loss, divergence = categorical_loss(logits, target)
    # -1/2 ln 1/4 - 1/2 ln 3/4 = ln 4 - 1/2 ln 3; the entropy of the targets is ln 2, ln 2, 0
    expected = [math.log(2), math.log(4) - math.log(3) / 2, math.log(2)]
    th.testing.assert_close(loss, th.tensor(expected))
    th.testing.assert_close(divergence, th.tensor([0.0, math.log(2) - math.log(3) / 2, math.log(2)]), rtol=1e-5, atol=1e-7)
    assert not divergence.requires_grad and (divergence >= 0).all()
    loss.sum().backward()
    th.testing.assert_close(logits.grad, logits.detach().softmax(dim=1) - target)


def test_reward_losses_by_hand():
    rewards = th.tensor([[1.0, -3.0], [0.0, 0.5]])
    found = reward_mse(th.tensor([[[0.5], [-1.0]], [[0.0], [2.0]]]), rewards)
    th.testing.assert_close(found, th.tensor([[0.25, 4.0], [0.0, 2.25]]))
    logits = th.zeros(2, 2, 3)
    logits[0, 1, 0] = math.log(2)  # the negative class has probability 2 / 4 there, 1 / 3 elsewhere
    third = math.log(3)
    found = reward_cross_entropy(logits, rewards)
    th.testing.assert_close(found, th.tensor([[third, math.log(2)], [third, third]]))
