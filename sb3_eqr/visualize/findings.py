"""The components of the diagnostics: motion, generators, disentanglement, action symmetry, collapse."""

from typing import NamedTuple

import numpy as np
import torch as th
from torch.nn import functional as F

from sb3_eqr.common.groups import SE, SO
from sb3_eqr.common.losses import normalized_distance
from sb3_eqr.common.networks.encoders import trunk_of
from sb3_eqr.common.off_policy import EqROffPolicy
from sb3_eqr.common.type_aliases import PyTorchObs
from sb3_eqr.visualize import latents, measures

DORMANT = 0.025  # Sokar et al. 2023, https://arxiv.org/abs/2302.12902


class Motion(NamedTuple):
    """How far actions move blocks. K counts the blocks of all groups."""

    predicted: np.ndarray  # (A, K): mean ‖κ(x, a) · x − x‖ in the block, over all states
    observed: np.ndarray  # (A, K): mean ‖x₁ − x₀‖ in the block, where a was taken; NaN if it never was


class Generators(NamedTuple):
    """The elements κ(x, a) of the blocks of one group, in coordinates that are 0 at the identity."""

    group: str
    names: list[str]  # of the coordinates, (C,)
    mean: np.ndarray  # (A, K, C), over states; circular for the angle of a plane
    std: np.ndarray  # (A, K, C)


class Disentanglement(NamedTuple):
    """Whether actions, blocks and factors correspond one to one."""

    opposites: list[int]  # (A,): the action that undoes each action, or itself
    specificity: np.ndarray  # (K,): 1 − H / log A' of a block's motion over actions, A' after merging opposites
    redundancy: np.ndarray  # (K, K): mean canonical correlation between blocks
    information: np.ndarray | None  # (K, F): of block and factor, over the factor's entropy; None if factors are unknown
    gap: np.ndarray | None  # (F,): mutual information gap


class ActionSymmetry(NamedTuple):
    """Mean distance of Eq. 19 between b(τ_g · x̂₁) and b(ρ(τ_g) · κ(x₀, a) · x_j), over random pairs."""

    distance: float
    identity: float  # the identity in place of ρ
    shuffled: float  # against the right-hand side of another pair
    from_identity: float  # mean ‖ρ(τ_g) − 1‖ per block


class Collapse(NamedTuple):
    """How much of the latent space the states use."""

    size: float  # root mean square ‖x‖
    spread: float  # root mean square ‖x − mean x‖, over the size
    effective_rank: float  # of the centred states
    dimensions: int  # D
    spectrum: np.ndarray  # (min(N, D),): standard deviations along the principal axes
    n_units: int  # outputs of the trunk
    dead_units: float  # fraction of units that are constant over all observations
    dormant_units: float  # fraction with mean |h| ≤ 0.025 of the layer's mean


def find_motion(model: EqROffPolicy, data: latents.Latents, states: th.Tensor, elements: th.Tensor) -> Motion:
    """
    Motion by the elements κ of every action, (n, A, D), in states, (n, D). Distances in the block rather than sizes of κ: they
    are defined for every group, including "none", and have the units of the transition error.
    """
    latent_model = latents.group_model(model)
    n_actions = elements.shape[1]
    before = states.repeat_interleave(n_actions, dim=0)  # (n * A, D)
    moved = latent_model.act(latent_model.blocks(elements.flatten(0, 1)), before)
    predicted = _block_norms(model, moved - before).unflatten(0, (-1, n_actions)).mean(dim=0)  # (A, K)
    steps = _block_norms(model, data.next_states[:, 0] - data.states)  # (N, K)
    played = F.one_hot(latents.nearest_typical(model, data.actions[:, 0]), n_actions).to(steps.dtype)  # (N, A)
    observed = played.T @ steps / played.sum(dim=0)[:, None]  # 0 / 0 if never taken
    return Motion(_numpy(predicted), _numpy(observed))


def find_generators(model: EqROffPolicy, elements: th.Tensor) -> list[Generators]:
    """Statistics of κ, of every action in n states, (n, A, D)."""
    found = []
    for group, blocks in latents.split(model, elements):
        values = latents.coordinates(group, blocks)  # (n, A, K, C)
        mean, std = values.mean(dim=0), values.std(dim=0, correction=0)
        if isinstance(group, (SO, SE)) and group.n == 2:
            mean[..., 0], std[..., 0] = measures.angle_moments(values[..., 0])
        found.append(Generators(str(group), latents.coordinate_names(group), _numpy(mean), _numpy(std)))
    return found


def find_disentanglement(
    model: EqROffPolicy, states: th.Tensor, factors: np.ndarray | None, motion: Motion, generators: list[Generators]
) -> Disentanglement:
    """
    Of states, (N, D), and true factors, (N, F), if known. A block's information about a factor is that of its rotation or of
    its translation, whichever is larger; either is a lower bound on the block's.
    """
    means = [part.mean.reshape(len(part.mean), -1) for part in generators]
    opposites = measures.opposites(np.concatenate(means, axis=1))
    blocks = latents.each_block(model, states)
    redundancy = measures.canonical_correlations([block.flatten(1) for *_, block in blocks])
    information = gap = None
    if factors is not None:
        frames = [latents.frame(group, block) for _, group, block in blocks]
        labels = [[measures.cells(part.flatten(1)) for part in parts if part is not None] for parts in frames]
        binned = [measures.bins(factor) for factor in factors.T]
        information = np.array([[_information(parts, factor) for factor in binned] for parts in labels])
        gap = measures.information_gap(information)
    specificity = measures.concentration(measures.merged(motion.predicted, opposites), axis=0)
    return Disentanglement(opposites, specificity, redundancy, information, gap)


def _information(parts: list[np.ndarray], factor: np.ndarray) -> float:
    whole = measures.entropy(factor)
    return max(measures.mutual_information(part, factor) for part in parts) / whole if whole > 0 else np.nan


def find_action_symmetry(model: EqROffPolicy, data: latents.Latents, rng: np.random.Generator) -> ActionSymmetry | None:
    """The effect of ρ in Eq. 19, computed with the online networks only; ``rng`` draws each state's partner."""
    latent_model, n = latents.group_model(model), len(data.states)
    group = latent_model.group
    if not group.has_inverse or n < 2:
        return None
    order = rng.permutation(n)
    partner = np.empty(n, dtype=int)
    partner[order] = np.roll(order, 1)  # never the state itself
    state, other = (latent_model.blocks(x) for x in (data.states, data.states[partner]))
    with th.no_grad(), latents.eval_mode(model):
        symmetry = group.compose(other, group.inverse(state))  # τ_g, (N, K, ...)
        rho = latent_model.element(latent_model.action_symmetry(symmetry.flatten(1)))
        kappa = latent_model.action_element(data.states, model.policy.embed_actions(data.actions[:, 0]))
        left = latent_model.symmetry_projection(latent_model.act(symmetry, data.predicted[:, 0]))
        right, plain = (
            latent_model.symmetry_projection(latent_model.act(element, data.states[partner]))
            for element in (group.compose(rho, kappa), kappa)
        )
        distances = [normalized_distance(left, x) for x in (right, plain, right[partner])]
    away = _block_norms(model, (rho - group.identity(dtype=rho.dtype, device=rho.device)).flatten(1))
    return ActionSymmetry(*(float(x.mean()) for x in (*distances, away)))


def find_collapse(model: EqROffPolicy, states: th.Tensor, observations: PyTorchObs) -> Collapse:
    """The collapse of states, (N, D), and of the units that encode their observations, N."""
    size = float(states.double().square().sum(dim=1).mean().sqrt())
    spectrum = measures.spectrum(states)
    spread = float(np.linalg.norm(spectrum)) / size if size > 0 else 0.0
    rank = measures.effective_rank(spectrum, size)
    outputs = _trunk_outputs(model, observations)
    low, high, mean = outputs.amin(dim=0), outputs.amax(dim=0), outputs.abs().mean(dim=0)  # (U,) each
    dead = high - low <= measures.ROUNDING * th.maximum(high.abs(), low.abs())
    dormant = mean <= DORMANT * mean.mean()
    fractions = [float(x.double().mean()) for x in (dead, dormant)]
    return Collapse(size, spread, rank, states.shape[1], spectrum, len(dead), *fractions)


def _trunk_outputs(model: EqROffPolicy, observations: PyTorchObs) -> th.Tensor:
    """The outputs of the trunk, (N, U)."""
    trunk = trunk_of(model.policy.encoder)  # after a layer norm, a unit that is always 0 is not constant
    seen: list[th.Tensor] = []
    hook = trunk.register_forward_hook(lambda _module, _inputs, output: seen.append(output.flatten(1)))
    try:
        latents.encode(model, observations)
    finally:
        hook.remove()
    return th.cat(seen)


def _block_norms(model: EqROffPolicy, states: th.Tensor) -> th.Tensor:
    """The size of each block of flat states, (N, D) to (N, K)."""
    return th.cat([found.flatten(2).norm(dim=2) for _, found in latents.split(model, states)], dim=1)


def _numpy(tensor: th.Tensor) -> np.ndarray:
    return tensor.double().cpu().numpy()
