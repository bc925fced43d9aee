"""Losses as pure functions. Each returns one number per sample, so that replay weights can multiply it."""

import torch as th
from torch.nn import functional as F


def normalized_distance(prediction: th.Tensor, target: th.Tensor) -> th.Tensor:
    """
    ‖y/‖y‖ − ȳ/‖ȳ‖‖² (footnote 6, Eq. 18 and 19): 0 for equal directions, 4 for opposite ones.

    :param prediction: (..., D)
    :param target: (..., D)
    :return: (...), in [0, 4]
    """
    difference = F.normalize(prediction, dim=-1) - F.normalize(target, dim=-1)  # (..., D)
    return difference.square().sum(dim=-1)


def quantile_huber_loss(current: th.Tensor, target: th.Tensor) -> th.Tensor:
    """
    Quantile Huber loss with κ = 1, summed over the predicted quantiles and averaged over the target's
    (Dabney et al. 2018, Eq. 10, https://arxiv.org/abs/1710.10044); its batch mean is what ``sb3_contrib.QRDQN`` minimises.

    :param current: predicted quantiles at the midpoints (i + ½)/N, (B, N)
    :param target: target quantiles, (B, N'), without gradient
    :return: (B,)
    """
    n_quantiles = current.shape[1]
    midpoints = (th.arange(n_quantiles, device=current.device, dtype=th.float) + 0.5) / n_quantiles  # (N,)
    delta = target[:, None, :] - current[:, :, None]  # (B, N, N')
    abs_delta = delta.abs()
    huber = th.where(abs_delta > 1, abs_delta - 0.5, delta**2 * 0.5)
    asymmetry = (midpoints[None, :, None] - (delta.detach() < 0).float()).abs()
    return (asymmetry * huber).sum(dim=1).mean(dim=1)


def reward_mse(prediction: th.Tensor, reward: th.Tensor) -> th.Tensor:
    """
    Squared error of the predicted reward (Eq. 17).

    :param prediction: (..., 1)
    :param reward: (...)
    :return: (...)
    """
    return (prediction.squeeze(-1) - reward).square()


def reward_cross_entropy(logits: th.Tensor, reward: th.Tensor) -> th.Tensor:
    """
    Cross-entropy over the three signs of a reward (−, 0, +): the form that the authors' released code uses.

    :param logits: (..., 3)
    :param reward: (...), any size; only its sign counts
    :return: (...)
    """
    sign = reward.sign().long() + 1  # 0, 1, 2
    return F.cross_entropy(logits.flatten(0, -2), sign.flatten(), reduction="none").view(reward.shape)
