"""
The latent model: how actions move latent states, and the losses that train it (EqR, §4 to §6).

It knows tensors only: features of observations, embeddings of actions, rewards and a mask. It is independent of Q-learning,
of Atari, and of whether actions are Discrete.
Shapes: B batch size, M prediction depth, F features, K blocks, D size of the flat latent state, A size of an action embedding.
"""

from collections.abc import Callable, Collection
from copy import deepcopy
from math import prod
from typing import TypeVar

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_eqr.common.groups import Group
from sb3_eqr.common.latent.options import LatentOptions
from sb3_eqr.common.losses import contrastive_loss, normalized_distance, reward_cross_entropy, reward_mse

Module = TypeVar("Module", bound=nn.Module)
NEAR_IDENTITY = 0.01  # initial outputs of κ and ρ around the identity, relative to PyTorch's default (docs/gradients.md)
NORMS: dict[str, type[nn.Module]] = {"layer": nn.LayerNorm, "batch": nn.BatchNorm1d}
# name -> (outputs of the reward network, loss)
REWARD_LOSSES = {"mse": (1, reward_mse), "categorical": (3, reward_cross_entropy)}
# name -> loss as a function of predictions and targets, (B, M, P), and the mask, (B, M)
AET_LOSSES: dict[str, Callable[[th.Tensor, th.Tensor, th.Tensor], th.Tensor]] = {
    "distance": lambda prediction, target, mask: normalized_distance(prediction, target),
    "contrastive": contrastive_loss,
}


class LatentModel(nn.Module):
    """
    Latent states x = τ(s) are K blocks of a group, actions become group elements κ(x, a), and the next state is their
    product. Everything that the auxiliary losses need is a component of this module; :func:`frozen_copy` of it is the target,
    written x̄, κ̄, p̄, b̄. Options are in ``options.py``; weights and the encoder in front belong to the caller.

    :param embedding: the last layer of τ, from features, (B, F), to latent states, (B, D)
    :param group: group of the blocks
    :param n_blocks: K
    :param action_dim: A
    :param options: all other options
    :param projection: p of the AET loss if ``options.projection`` is "head": a module from (N, D) to (N, P)
    """

    def __init__(
        self,
        embedding: nn.Module,
        group: Group,
        n_blocks: int,
        action_dim: int,
        options: LatentOptions,
        projection: nn.Module | None = None,
    ):
        super().__init__()
        self.options = options
        self.group = group.for_actions
        self.has_symmetry_loss = group.has_inverse  # which the GET loss needs
        self.n_blocks = n_blocks
        self.action_dim = action_dim
        self.state_dim = n_blocks * prod(group.element_shape)  # D
        width, norm = options.latent_hidden_dim, options.latent_norm
        n_outputs, self._reward_loss = REWARD_LOSSES[options.reward_loss]
        self.embedding = embedding
        self.reward_net = hidden_layer(self.state_dim, width, n_outputs, norm)  # r_ψ
        self._make_transition(width, norm)
        own = nn.Linear(self.state_dim, width) if options.projection == "own" else nn.Identity()
        self.projection: nn.Module = own if projection is None else projection  # p
        self.predictor: nn.Module = nn.Identity()
        if options.predictor:
            with th.no_grad():
                size = self.projection(th.zeros(1, self.state_dim)).shape[1]
            self.predictor = nn.Linear(size, size)
            if options.transition == "group":  # like κ and ρ around the identity, or the latent model has to undo it first
                nn.init.eye_(self.predictor.weight)
                nn.init.zeros_(self.predictor.bias)

    def _make_transition(self, width: int, norm: str) -> None:
        """Create κ and, for the GET loss, ρ and b."""
        n_params = self.n_blocks * self.group.num_params
        if self.options.state_dependent_actions:
            self.transition = hidden_layer(self.state_dim + self.action_dim, width, n_params, norm)  # κ(x, a)
        elif not self.group.has_inverse:
            raise ValueError(
                "state_dependent_actions must be True without a group, where κ(s, a) alone predicts the next state, got "
                'False. Pass a group such as group="SE(2)".'
            )
        else:  # κ(a), without batch norm: it would vary with the actions drawn into the batch
            self.transition = nn.Sequential(nn.Linear(self.action_dim, width), nn.ReLU(), nn.Linear(width, n_params))
        if self.has_symmetry_loss:
            self.action_symmetry = hidden_layer(self.state_dim, width, n_params, norm)  # ρ
            self.symmetry_projection = nn.Linear(self.state_dim, width)  # b
            with th.no_grad():  # at first, one step moves a state a little, which random moves would drown out
                for *_, last in (self.transition, self.action_symmetry):
                    last.weight.mul_(NEAR_IDENTITY)  # type: ignore[operator, union-attr]
                    last.bias.copy_(self.group.identity_params().repeat(self.n_blocks))  # type: ignore[operator, union-attr]

    def forward(
        self,
        names: Collection[str],
        features: th.Tensor,
        actions: th.Tensor,
        rewards: th.Tensor,
        mask: th.Tensor,
        target: "LatentModel",
        target_state: th.Tensor | None = None,
        target_states: th.Tensor | None = None,
    ) -> dict[str, th.Tensor]:
        """
        Compute the auxiliary losses of Eq. 18 and 19, per sample. AET and reward loss are means over the valid steps of the
        rollout; the paper has sums.

        :param names: the losses to compute, of "aet", "symmetry" (GET) and "reward"
        :param features: of s_t, online, (B, F)
        :param actions: embeddings of a_t ... a_{t+M-1}, (B, M, A)
        :param rewards: r_{t+1} ... r_{t+M}, (B, M)
        :param mask: 1 where the episode had not ended before step t+m, (B, M); the step that ends it counts
        :param target: the target copy of this model
        :param target_state: x̄₀, the target's latent state of s_t, (B, D), which "symmetry" needs
        :param target_states: x̄_1 ... x̄_M, those of s_{t+1} ... s_{t+M}, (B * M, D), which "aet" needs
        :return: (B,) for each name
        """
        state = self.embedding(features)  # x₀ = τ(s_t), (B, D)
        predicted = self.rollout(state, actions)  # x̂_1 ... x̂_M, (B, M, D)
        losses = {}
        if "aet" in names:
            assert target_states is not None
            losses["aet"] = self.aet_loss(predicted, target_states, mask, target)
        if "symmetry" in names:
            assert target_state is not None
            found = self.symmetry_loss(state, predicted[:, 0], actions[:, 0], target_state, target)
            losses["symmetry"] = mask[:, 0] * found
        if "reward" in names:
            losses["reward"] = self.reward_loss(predicted, rewards, mask)
        return losses

    def rollout(self, state: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Predict x̂_m = κ(x̂_{m−1}, a_{t+m−1}) · x̂_{m−1} (Eq. 10).

        :param state: x₀, (B, D)
        :param actions: embeddings of a_t ... a_{t+M-1}, (B, M, A)
        :return: x̂_1 ... x̂_M, (B, M, D)
        """
        states = []
        for action in actions.unbind(1):
            state = self.act(self.action_element(state, action), state)
            states.append(state)
        return th.stack(states, dim=1)

    def aet_loss(self, predicted: th.Tensor, target_states: th.Tensor, mask: th.Tensor, target: "LatentModel") -> th.Tensor:
        """
        Action-equivariant transitions (Eq. 18): the mean over valid m of d(p(x̂_m), p̄(x̄_m)), with the predictor after p, and
        d(u, v) = ‖u/‖u‖ − v/‖v‖‖² or, with ``aet_loss="contrastive"``, InfoNCE (both in ``losses.py``).

        :return: (B,)
        """
        with th.no_grad():
            wanted = target.projection(target_states)  # (B * M, P)
        found = self.project(predicted.flatten(0, 1))
        losses = AET_LOSSES[self.options.aet_loss](found.view(*mask.shape, -1), wanted.view(*mask.shape, -1), mask)
        return mean_over_steps(losses, mask)

    def project(self, state: th.Tensor) -> th.Tensor:
        """p, followed by the predictor: (N, D) to (N, P)."""
        first, second = self.projection, self.predictor
        if isinstance(first, nn.Linear) and isinstance(second, nn.Linear) and len(state) > self.state_dim:
            weight = second.weight @ first.weight  # the same map by one product for all states in place of two
            return F.linear(state, weight, F.linear(first.bias, second.weight, second.bias))
        return second(first(state))

    def symmetry_loss(
        self,
        state: th.Tensor,
        predicted: th.Tensor,
        action: th.Tensor,
        target_state: th.Tensor,
        target: "LatentModel",
    ) -> th.Tensor:
        """
        Group-equivariant transitions (Eq. 19): d(b(τ_g · x̂₁), b̄(ρ(τ_g) · κ̄(x₀, a_t) · x̄_j)) with τ_g = x̄_j · x₀⁻¹, for a
        random partner j of each sample. The action element is that of the sample's own state x₀, and acts on the partner's.

        :return: (B,)
        """
        # As in the authors' code, τ_g carries no gradient, nor does what comes from the target: on the right, only ρ learns.
        with th.no_grad():
            partners = th.randint(len(state), (len(state),), device=state.device)
            partner = target_state[partners]  # x̄_j of Algorithm 1, (B, D)
            symmetry = self.group.compose(self.blocks(partner), self.group.inverse(self.blocks(state)))  # τ_g
            next_partner = target.act(target.action_element(state, action), partner)  # κ̄ · x̄_j, (B, D)
        rho = self.element(self.action_symmetry(symmetry.flatten(1)))  # ρ(τ_g)
        moved_prediction = self.symmetry_projection(self.act(symmetry, predicted))
        moved_partner = target.symmetry_projection(self.act(rho, next_partner))
        return normalized_distance(moved_prediction, moved_partner)

    def reward_loss(self, predicted: th.Tensor, rewards: th.Tensor, mask: th.Tensor) -> th.Tensor:
        """
        The loss of r_ψ(x̂_m) for r_{t+m} (Eq. 17).

        :return: (B,)
        """
        outputs = self.reward_net(predicted.flatten(0, 1)).view(*mask.shape, -1)  # (B, M, 1 or 3)
        return mean_over_steps(self._reward_loss(outputs, rewards), mask)

    def action_element(self, state: th.Tensor, action: th.Tensor) -> th.Tensor:
        """κ(x, a), or κ(a), (B, K, *element_shape), from states, (B, D), and action embeddings, (B, A)."""
        return self.element(
            self.transition(th.cat([state, action], dim=1) if self.options.state_dependent_actions else action)
        )

    def act(self, elements: th.Tensor, state: th.Tensor) -> th.Tensor:
        """Apply group elements, (B, K, *element_shape), to states, (B, D)."""
        return self.group.compose(elements, self.blocks(state)).flatten(1)

    def blocks(self, state: th.Tensor) -> th.Tensor:
        """Split flat states, (B, D), into blocks, (B, K, *element_shape)."""
        return state.view(-1, self.n_blocks, *self.group.element_shape)

    def element(self, params: th.Tensor) -> th.Tensor:
        """Group elements, (B, K, *element_shape), from their parameters, (B, K * num_params)."""
        return self.group.element(params.view(-1, self.n_blocks, self.group.num_params))


def hidden_layer(n_in: int, width: int, n_out: int, norm: str) -> nn.Sequential:
    """Linear layer, norm, ReLU, linear layer: κ, r_ψ and ρ (appendix B.4), from (N, n_in) to (N, n_out)."""
    return nn.Sequential(nn.Linear(n_in, width), NORMS[norm](width), nn.ReLU(), nn.Linear(width, n_out))


def mean_over_steps(losses: th.Tensor, mask: th.Tensor) -> th.Tensor:
    """The mean of (B, M) over the steps with mask 1, (B,); 0 without any."""
    return (losses * mask).sum(dim=1) / mask.sum(dim=1).clamp(min=1)


def frozen_copy(module: Module) -> Module:
    """A copy in eval mode whose parameters are not trained."""
    return deepcopy(module).requires_grad_(False).eval()
