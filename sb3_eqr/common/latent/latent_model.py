"""
The latent model: how actions move latent states, and the three losses that train it (EqR, §5 and §6).

It takes tensors, a mask and callables, and is independent of Q-learning and Atari.
Shapes: B batch size, M prediction depth, K blocks, D size of the flat latent state, A number of actions.
"""

from collections.abc import Callable
from copy import deepcopy
from math import prod
from typing import Any, TypeVar

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_eqr.common.groups import Group
from sb3_eqr.common.latent.rollout import HiddenLayer, rollout
from sb3_eqr.common.losses import contrastive_loss, normalized_distance, reward_cross_entropy, reward_mse
from sb3_eqr.common.type_aliases import LatentLosses

Module = TypeVar("Module", bound=nn.Module)
NEAR_IDENTITY = 0.01  # initial outputs of κ and ρ around the identity, relative to PyTorch's default (docs/gradients.md)
Projection = Callable[[th.Tensor], th.Tensor]

# name -> (outputs of the reward network, loss)
REWARD_LOSSES = {"mse": (1, reward_mse), "categorical": (3, reward_cross_entropy)}
# name -> loss as a function of predictions and targets, (B, M, P), and the mask, (B, M)
AET_LOSSES: dict[str, Callable[[th.Tensor, th.Tensor, th.Tensor], th.Tensor]] = {
    "distance": lambda prediction, target, mask: normalized_distance(prediction, target),
    "contrastive": contrastive_loss,
}


class LatentModel(nn.Module):
    """
    The reward network r_ψ and the losses. Subclasses define how actions move latent states (``rollout``).

    :param state_dim: D
    :param n_actions: A
    :param hidden_dim: width of the hidden layer of r_ψ
    :param reward_loss: "mse" (Eq. 17) or "categorical" (the sign of the reward, as in the authors' released code)
    :param aet_loss: "distance" (Eq. 18) or "contrastive" (:func:`~sb3_eqr.common.losses.contrastive_loss`)
    :param embedding: module from the encoder's features to latent states; ``None``: the features are the latent states
    :param norm: of the hidden layers, see :class:`~sb3_eqr.common.latent.rollout.HiddenLayer`
    :raises ValueError: if a loss is unknown
    """

    transition: Any  # has a target copy
    projection: nn.Module  # b of the GET loss; has a target copy
    has_symmetry_loss = False

    def __init__(
        self,
        state_dim: int,
        n_actions: int,
        hidden_dim: int,
        reward_loss: str,
        aet_loss: str,
        embedding: nn.Module | None = None,
        norm: str = "layer",
    ):
        super().__init__()
        self.embedding = embedding or nn.Identity()  # has a target copy
        for name, found, legal in (("reward_loss", reward_loss, REWARD_LOSSES), ("aet_loss", aet_loss, AET_LOSSES)):
            if found not in legal:
                raise ValueError(f"{name} must be one of {list(legal)}, got {found!r}.")
        self.n_actions = n_actions
        self.aet_loss = aet_loss
        n_outputs, self._reward_loss = REWARD_LOSSES[reward_loss]
        self.reward_net = HiddenLayer(state_dim, hidden_dim, n_outputs, norm)  # r_ψ

    def forward(
        self,
        state: th.Tensor,
        actions: th.Tensor,
        rewards: th.Tensor | None,
        mask: th.Tensor,
        target_state: th.Tensor,
        target_rollout: th.Tensor | None,
        target: "LatentModel | None",
        project: Projection | None,
        target_project: Projection,
    ) -> LatentLosses:
        """
        Compute the losses of Eq. 18 and 19, per sample. The losses of the rollout are means over its valid steps, whereas the
        paper uses sums. ``None`` for ``rewards``, ``target`` or ``project`` disables the reward, the GET or the AET loss.

        :param state: x₀ = τ(s_t), online, (B, D)
        :param actions: a_t ... a_{t+M-1}, int64, (B, M)
        :param rewards: r_{t+1} ... r_{t+M}, (B, M)
        :param mask: 1 where the episode had not ended before step t+m, (B, M)
        :param target_state: x̄₀ from the target encoder, without gradient, (B, D)
        :param target_rollout: x̄₁ ... x̄_M from the target encoder, without gradient, (B, M, D); ``None`` without AET loss
        :param target: the target copy of this model, in eval mode, with frozen parameters
        :param project: p, (N, D) -> (N, P)
        :param target_project: p̄
        :return: three losses, (B,) each; ``None`` for a disabled loss
        """
        # Past the end of the episode, set the action to 0, so that masked steps cannot leak through batch statistics.
        actions = actions * mask.long()  # (B, M)
        predicted = self.rollout(state, actions)  # (B, M, D)
        rows = predicted.flatten(0, 1)  # (B * M, D)
        weights = mask / mask.sum(dim=1, keepdim=True).clamp(min=1)  # (B, M)
        aet = symmetry = reward = None
        if project is not None and target_rollout is not None:
            with th.no_grad():
                target_projected = target_project(target_rollout.flatten(0, 1)).view(*mask.shape, -1)  # (B, M, P)
            projected = project(rows).view(*mask.shape, -1)  # (B, M, P)
            aet = (AET_LOSSES[self.aet_loss](projected, target_projected, mask) * weights).sum(dim=1)
        if target is not None:
            symmetry = mask[:, 0] * self.symmetry_loss(state, predicted[:, 0], actions[:, 0], target_state, target)
        if rewards is not None:
            outputs = self.reward_net(rows).view(*mask.shape, -1)  # (B, M, 1 or 3)
            reward = (self._reward_loss(outputs, rewards) * weights).sum(dim=1)
        return LatentLosses(aet, symmetry, reward)

    def rollout(self, state: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Predict x̂_1 ... x̂_M, (B, M, D), from x₀, (B, D), and actions, int64, (B, M)."""
        raise NotImplementedError

    def symmetry_loss(
        self, state: th.Tensor, predicted: th.Tensor, actions: th.Tensor, target_state: th.Tensor, target: Any
    ) -> th.Tensor:
        """The GET loss, (B,), if the model has one, from x₀, x̂₁ and x̄₀, (B, D) each, and a_t, (B,)."""
        raise NotImplementedError


class GroupLatentModel(LatentModel):
    """
    κ (maps actions to group elements), ρ (how a symmetry of states acts on actions), b (the projection of the GET loss) and
    r_ψ.

    :param group: group of each block
    :param n_blocks: K
    :param n_actions: A
    :param hidden_dim: width of all hidden layers and of b; 256 in appendix B.4
    :param reward_loss: as in :class:`LatentModel`
    :param aet_loss: as in :class:`LatentModel`
    :param state_dependent_actions: ``True``: κ(s, a); ``False``: κ(a), as in Example 2
    :param embedding: as in :class:`LatentModel`
    :param norm: as in :class:`LatentModel`; κ(a) has none
    :raises ValueError: if a loss is unknown
    """

    def __init__(
        self,
        group: Group,
        n_blocks: int,
        n_actions: int,
        hidden_dim: int = 256,
        reward_loss: str = "mse",
        aet_loss: str = "distance",
        state_dependent_actions: bool = True,
        embedding: nn.Module | None = None,
        norm: str = "layer",
    ):
        group = group.for_actions
        state_dim = n_blocks * prod(group.element_shape)
        super().__init__(state_dim, n_actions, hidden_dim, reward_loss, aet_loss, embedding, norm)
        self.group = group
        self.n_blocks = n_blocks
        self.has_symmetry_loss = group.has_inverse
        algebra_dim = n_blocks * group.num_params
        self.state_dependent_actions = state_dependent_actions
        if state_dependent_actions:
            self.transition = HiddenLayer(state_dim + n_actions, hidden_dim, algebra_dim, norm)  # κ
        else:  # no batch norm: κ(a) would vary with the actions drawn into the batch
            layers = nn.Linear(n_actions, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, algebra_dim)
            self.transition = nn.Sequential(*layers)
        self.action_symmetry = HiddenLayer(state_dim, hidden_dim, algebra_dim, norm)  # ρ
        self.projection = nn.Linear(state_dim, hidden_dim)  # b
        if group.has_inverse:
            self._start_near_identity()

    @th.no_grad()
    def _start_near_identity(self) -> None:
        """Scale the initial outputs of κ and ρ: one step moves a state a little, which random moves would drown out."""
        networks: tuple[Any, ...] = self.transition, self.action_symmetry
        for *_, last in networks:
            last.weight.mul_(NEAR_IDENTITY)
            last.bias.copy_(self.group.identity_params().repeat(self.n_blocks))

    def rollout(self, state: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Predict x̂_m = κ(x̂_{m−1}, a_{t+m−1}) · x̂_{m−1} (Eq. 10), (B, M, D), from x₀, (B, D), and actions, int64, (B, M).
        """
        if self.state_dependent_actions:
            return rollout(self.group, state, actions, self.transition)
        states = [state]
        for action in actions.unbind(1):
            states.append(self._act(self.action_params(state, action), states[-1]))
        return th.stack(states[1:], dim=1)

    def action_params(self, state: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Parameters of κ(x, a) or κ(a), (B, K * num_params), from states, (B, D), and actions, int64, (B,)."""
        one_hot = F.one_hot(actions, self.n_actions).to(state.dtype)  # (B, A)
        return self.transition(th.cat([state, one_hot], dim=1) if self.state_dependent_actions else one_hot)

    def action_element(self, state: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """κ(x, a) or κ(a) as group elements, (B, K, *element_shape), from states, (B, D), and actions, int64, (B,)."""
        return self.element(self.action_params(state, actions))

    def act(self, elements: th.Tensor, state: th.Tensor) -> th.Tensor:
        """Apply group elements, (B, K, *element_shape), to states, (B, D)."""
        return self.group.compose(elements, self.blocks(state)).flatten(1)

    def _act(self, params: th.Tensor, state: th.Tensor) -> th.Tensor:
        """As :meth:`act`, with elements given by their parameters, (B, K * num_params)."""
        return self.act(self.element(params), state)

    def symmetry_loss(
        self, state: th.Tensor, predicted: th.Tensor, actions: th.Tensor, target_state: th.Tensor, target: "GroupLatentModel"
    ) -> th.Tensor:
        """
        Eq. 19: τ_g acts on the predicted next state x̂₁, and ρ(τ_g) κ̄ on the state of a random partner; both results should
        coincide. Computes (B,) from x₀, x̂₁ and x̄₀, (B, D) each, and a_t, (B,).
        """
        partner = target_state[th.randint(len(state), (len(state),), device=state.device)]  # x̄_j of Algorithm 1
        with th.no_grad():  # τ_g carries no gradient, as in the authors' code
            symmetry = self.group.compose(self.blocks(partner), self.group.inverse(self.blocks(state)))  # τ_g, (B, K, ...)
            next_partner = target._act(target.action_params(state, actions), partner)  # κ̄ · x̄_j, (B, D)
        moved_prediction = self.act(symmetry, predicted)
        moved_partner = self._act(self.action_symmetry(symmetry.flatten(1)), next_partner)  # ρ(τ_g) κ̄ · x̄_j
        return normalized_distance(self.projection(moved_prediction), target.projection(moved_partner))

    def blocks(self, state: th.Tensor) -> th.Tensor:
        """Split flat states, (B, D), into blocks, (B, K, *element_shape)."""
        return state.view(-1, self.n_blocks, *self.group.element_shape)

    def element(self, params: th.Tensor) -> th.Tensor:
        """Group elements, (B, K, *element_shape), from their parameters, (B, K * num_params)."""
        return self.group.element(params.view(-1, self.n_blocks, self.group.num_params))


def frozen_copy(module: Module) -> Module:
    """A copy in eval mode whose parameters are not trained. Omits modules that targets do not need (r_ψ, ρ)."""
    copy = deepcopy(module)
    if isinstance(copy, LatentModel):
        del copy.reward_net
        if isinstance(copy, GroupLatentModel):
            del copy.action_symmetry
    return copy.requires_grad_(False).eval()
