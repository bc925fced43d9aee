import math

import numpy as np
import torch as th
from sb3_contrib.common.utils import quantile_huber_loss as contrib_quantile_huber_loss

from sb3_eqr.common.losses import normalized_distance, quantile_huber_loss, reward_cross_entropy, reward_mse


def test_normalized_distance_by_hand():
    a = th.tensor([[3.0, 4.0], [1.0, 0.0], [2.0, 0.0], [0.0, 0.0]])
    b = th.tensor([[6.0, 8.0], [0.0, 5.0], [-1.0, 0.0], [1.0, 0.0]])
    # same direction, a right angle, opposite directions, no direction
    th.testing.assert_close(normalized_distance(a, b), th.tensor([0.0, 2.0, 4.0, 1.0]))


def test_normalized_distance_has_finite_gradients_at_zero():
    a = th.zeros(1, 3, requires_grad=True)
    normalized_distance(a, th.ones(1, 3)).sum().backward()
    assert th.isfinite(a.grad).all()


def test_quantile_huber_loss_against_a_loop():
    rng = np.random.default_rng(0)
    current, target = rng.normal(size=(4, 5)) * 2, rng.normal(size=(4, 3)) * 2
    expected = np.zeros(4)
    for b in range(4):
        for i in range(5):
            for j in range(3):
                u = target[b, j] - current[b, i]
                huber = 0.5 * u * u if abs(u) <= 1 else abs(u) - 0.5
                expected[b] += abs((i + 0.5) / 5 - (u < 0)) * huber / 3
    found = quantile_huber_loss(th.tensor(current), th.tensor(target))
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-6)  # midpoints are float32, as in sb3_contrib


def test_quantile_huber_loss_has_contribs_mean_and_gradient():
    generator = th.Generator().manual_seed(0)
    values, target = th.randn(2, 32, 51, generator=generator) * 3
    ours, theirs = values.clone().requires_grad_(), values.clone().requires_grad_()
    quantile_huber_loss(ours, target).mean().backward()
    loss = contrib_quantile_huber_loss(theirs, target, sum_over_quantiles=True)
    loss.backward()
    assert th.equal(ours.grad, theirs.grad)
    th.testing.assert_close(quantile_huber_loss(values, target).mean(), loss.detach())


def test_reward_losses_by_hand():
    rewards = th.tensor([[1.0, -3.0], [0.0, 0.5]])
    found = reward_mse(th.tensor([[[0.5], [-1.0]], [[0.0], [2.0]]]), rewards)
    th.testing.assert_close(found, th.tensor([[0.25, 4.0], [0.0, 2.25]]))
    logits = th.zeros(2, 2, 3)
    logits[0, 1, 0] = math.log(2)  # the negative class has probability 2 / 4 there, 1 / 3 elsewhere
    third = math.log(3)
    found = reward_cross_entropy(logits, rewards)
    th.testing.assert_close(found, th.tensor([[third, math.log(2)], [third, third]]))
