"""Losses and rescaling as pure functions. Each loss is one number per sample, so that replay weights can multiply it."""

import torch as th
from torch.nn import functional as F


def rescaled(features: th.Tensor) -> th.Tensor:
    """
    Shift and scale the features of each sample to [0, 1] (Schrittwieser et al. 2020,
    https://arxiv.org/abs/1911.08265; SPR and BBF do this with the output of their convolutions).

    :param features: (B, D)
    :return: (B, D)
    """
    low = features.amin(dim=1, keepdim=True)
    return (features - low) / (features.amax(dim=1, keepdim=True) - low + 1e-5)


def normalized_distance(prediction: th.Tensor, target: th.Tensor) -> th.Tensor:
    """
    ‖y/‖y‖ − ȳ/‖ȳ‖‖² (footnote 6, Eq. 18 and 19): 0 for equal directions, 4 for opposite ones.

    :param prediction: (..., D)
    :param target: (..., D)
    :return: (...), in [0, 4]
    """
    return (F.normalize(prediction, dim=-1) - F.normalize(target, dim=-1)).square().sum(dim=-1)


TEMPERATURE = 0.2  # of contrastive_loss; common values are 0.07 to 0.5, and smaller ones weigh only the nearest negatives


def contrastive_loss(prediction: th.Tensor, target: th.Tensor, mask: th.Tensor) -> th.Tensor:
    """
    InfoNCE (van den Oord et al. 2018, Eq. 4, https://arxiv.org/abs/1807.03748): the cross-entropy of identifying a
    prediction's own target among the targets of the batch at the same step, with the cosine similarity divided by
    ``TEMPERATURE`` as logits. A constant representation costs the logarithm of their number, so a collapse does not minimise
    the loss.

    :param prediction: (B, M, P)
    :param target: (B, M, P)
    :param mask: (B, M); targets with mask 0 do not serve as negatives
    :return: (B, M), ≥ 0
    """
    cosines = th.einsum("bmp,nmp->bnm", F.normalize(prediction, dim=-1), F.normalize(target, dim=-1))  # (B, B, M)
    own = th.arange(len(prediction), device=prediction.device)  # (B,)
    counts = (mask > 0) | (own[:, None, None] == own[:, None])  # (B, B, M): a sample's own target always counts
    logits = (cosines / TEMPERATURE).masked_fill(~counts, -th.inf)
    return F.cross_entropy(logits, own[:, None].expand(mask.shape), reduction="none")


def quantile_huber_loss(current: th.Tensor, target: th.Tensor) -> th.Tensor:
    """
    Quantile Huber loss with κ = 1, summed over the predicted quantiles and averaged over the target's
    (Dabney et al. 2018, Eq. 10, https://arxiv.org/abs/1710.10044); its batch mean is what ``sb3_contrib.QRDQN`` minimises.

    :param current: predicted quantiles at the midpoints (i + ½)/N, (B, N)
    :param target: target quantiles, (B, N'), without gradient
    :return: (B,)
    """
    n_quantiles = current.shape[1]
    midpoints = ((th.arange(n_quantiles, device=current.device, dtype=th.float) + 0.5) / n_quantiles)[:, None]  # (N, 1)
    predicted, wanted = th.broadcast_tensors(current[:, :, None], target[:, None, :])  # (B, N, N')
    weights = th.where(wanted < predicted, 1 - midpoints, midpoints)  # |τ - 1{u < 0}|
    return (weights * F.huber_loss(predicted, wanted, reduction="none")).sum(dim=1).mean(dim=1)


def categorical_projection(values: th.Tensor, probabilities: th.Tensor, v_min: float, v_max: float) -> th.Tensor:
    """
    Project a distribution over arbitrary values onto the same number of evenly spaced atoms on [v_min, v_max]: each value is
    clipped to that range, and its probability is split between its two neighbouring atoms in proportion to proximity
    (Bellemare et al. 2017, Eq. 7, https://arxiv.org/abs/1707.06887). The total probability is preserved.

    :param values: values in any order, (B, N)
    :param probabilities: their probabilities, (B, N)
    :param v_min: the first atom
    :param v_max: the last atom, > v_min
    :return: probabilities of the atoms, (B, N)
    """
    n_atoms = values.shape[1]
    # In units of the atom spacing, so that the two shares of a value add up to exactly 1.
    positions = ((values - v_min) * ((n_atoms - 1) / (v_max - v_min))).clamp(0, n_atoms - 1)  # (B, N)
    atoms = th.arange(n_atoms, device=values.device, dtype=values.dtype)  # (N,)
    shares = th.rsub((positions[:, :, None] - atoms).abs_(), 1).clamp_(min=0)  # (B, N, N): of each value for each atom
    return shares.mul_(probabilities[:, :, None]).sum(dim=1)  # not a matrix product, whose precision may be lower on GPU


def categorical_loss(logits: th.Tensor, target: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    Cross-entropy of a predicted distribution with the target, and the KL divergence, which is the cross-entropy minus the
    target's entropy. The KL divergence is the priority of Rainbow (https://arxiv.org/abs/1710.02298): it is 0 for a
    perfectly predicted transition.

    :param logits: logits of the atoms, (B, N)
    :param target: probabilities of the atoms, without gradient, (B, N)
    :return: cross-entropy, (B,), and KL(target ‖ prediction) ≥ 0 without gradient, (B,)
    """
    cross_entropy = F.cross_entropy(logits, target, reduction="none")
    return cross_entropy, (cross_entropy.detach() + th.xlogy(target, target).sum(dim=1)).clamp(min=0)


def reward_mse(prediction: th.Tensor, reward: th.Tensor) -> th.Tensor:
    """
    Squared error of the predicted reward (Eq. 17).

    :param prediction: (..., 1)
    :param reward: (...)
    :return: (...)
    """
    return F.mse_loss(prediction.squeeze(-1), reward, reduction="none")


def reward_cross_entropy(logits: th.Tensor, reward: th.Tensor) -> th.Tensor:
    """
    Cross-entropy over the three signs of a reward (−, 0, +), as in the authors' released code.

    :param logits: (..., 3)
    :param reward: (...); only its sign counts
    :return: (...)
    """
    sign = reward.sign().long() + 1  # 0, 1, 2
    return F.cross_entropy(logits.flatten(0, -2), sign.flatten(), reduction="none").view(reward.shape)
