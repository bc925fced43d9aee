"""
The latent model: how actions move states, and the three losses that teach it (EqR, §5 and §6).

It receives tensors, a mask and callables, and knows neither Q-learning nor Atari.
Shapes: B batch, M prediction depth, K blocks, D size of the flat state, A number of actions.
"""

from collections.abc import Callable
from math import prod

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_eqr.common.groups import Group
from sb3_eqr.common.losses import contrastive_loss, normalized_distance, reward_cross_entropy, reward_mse
from sb3_eqr.common.type_aliases import LatentLosses

Projection = Callable[[th.Tensor], th.Tensor]

# name -> (outputs of the reward network, loss)
REWARD_LOSSES = {"mse": (1, reward_mse), "categorical": (3, reward_cross_entropy)}
# name -> loss of predictions and targets, (B, M, P), and the mask, (B, M)
AET_LOSSES: dict[str, Callable[[th.Tensor, th.Tensor, th.Tensor], th.Tensor]] = {
    "distance": lambda prediction, target, mask: normalized_distance(prediction, target),
    "contrastive": contrastive_loss,
}


class LatentModel(nn.Module):
    """
    κ (actions to group elements), r_ψ (reward), ρ (how a symmetry of states acts on actions) and b (its projection).

    :param group: of each block
    :param n_blocks: K
    :param n_actions: A
    :param hidden_dim: width of every hidden layer, and of b; 256 in appendix B.4
    :param reward_loss: "mse" (Eq. 17) or "categorical" (three signs, as in the authors' released code)
    :param aet_loss: "distance" (Eq. 18) or "contrastive" (:func:`~sb3_eqr.common.losses.contrastive_loss`)
    :param state_dependent_actions: κ(s, a); ``False``: κ(a), as in Example 2
    :raises ValueError: for an unknown loss
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
    ):
        super().__init__()
        for name, found, legal in (("reward_loss", reward_loss, REWARD_LOSSES), ("aet_loss", aet_loss, AET_LOSSES)):
            if found not in legal:
                raise ValueError(f"{name}: expected one of {list(legal)}, found {found!r}")
        group = group.for_actions
        self.group = group
        self.n_blocks = n_blocks
        self.n_actions = n_actions
        state_dim = n_blocks * prod(group.element_shape)
        algebra_dim = n_blocks * group.num_params
        self.state_dependent_actions = state_dependent_actions
        self.transition = _hidden_layer(state_dim * state_dependent_actions + n_actions, hidden_dim, algebra_dim)  # κ
        if not state_dependent_actions:
            self.transition[1] = nn.Identity()  # statistics of a batch of actions would move κ(a) with the draw
        self.aet_loss = aet_loss
        n_outputs, self._reward_loss = REWARD_LOSSES[reward_loss]
        self.reward_net = _hidden_layer(state_dim, hidden_dim, n_outputs)  # r_ψ
        self.action_symmetry = _hidden_layer(state_dim, hidden_dim, algebra_dim)  # ρ
        self.projection = nn.Linear(state_dim, hidden_dim)  # b

    def forward(
        self,
        state: th.Tensor,
        actions: th.Tensor,
        rewards: th.Tensor | None,
        mask: th.Tensor,
        target_states: th.Tensor,
        target: "LatentModel | None",
        project: Projection | None,
        target_project: Projection,
    ) -> LatentLosses:
        """
        The losses of Eq. 18 and 19, per sample, each step weighted by the one mask. ``None`` for ``rewards``, ``target``
        or ``project`` leaves the reward, the GET or the AET loss out.

        :param state: x₀ = τ(s_t), online, (B, D)
        :param actions: a_t ... a_{t+M-1}, int64, (B, M)
        :param rewards: r_{t+1} ... r_{t+M}, (B, M)
        :param mask: 1 where the episode had not ended before step t+m, (B, M)
        :param target_states: x̄₀ ... x̄_M from the target encoder, without gradient, (B, M + 1, D);
            without AET, x̄₀ is enough, (B, 1, D)
        :param target: the target copy of this model, in eval mode, its parameters frozen
        :param project: p, (..., D) -> (..., P)
        :param target_project: p̄
        :return: three losses, (B,) each; ``None`` for one that is off
        """
        # Past the end there is no action: a constant one keeps the mask's promise even through batch statistics.
        one_hot = F.one_hot((actions * mask.long()).long(), self.n_actions).to(state.dtype)  # (B, M, A)
        predicted = self.rollout(state, one_hot, mask)  # (B, M, D)
        aet = symmetry = reward = None
        if project is not None:
            with th.no_grad():
                target_projected = target_project(target_states[:, 1:])  # (B, M, P)
            aet = (AET_LOSSES[self.aet_loss](project(predicted), target_projected, mask) * mask).sum(dim=1)
        if target is not None:
            first = self._symmetry_loss(state, predicted[:, 0], one_hot[:, 0], target_states[:, 0], target)
            symmetry = mask[:, 0] * first
        if rewards is not None:
            outputs = self.reward_net(predicted.flatten(0, 1)).unflatten(0, mask.shape)  # (B, M, 1 or 3)
            reward = (self._reward_loss(outputs, rewards) * mask).sum(dim=1)
        return LatentLosses(aet, symmetry, reward)

    def rollout(self, state: th.Tensor, one_hot: th.Tensor, mask: th.Tensor) -> th.Tensor:
        """
        x̂_m = κ(x̂_{m−1}, a_{t+m−1}) · x̂_{m−1} (Eq. 10), held where the episode has ended: from x₀, (B, D), one-hot actions,
        (B, M, A), and the mask, (B, M), to x̂_1 ... x̂_M, (B, M, D).
        """
        states = []
        goes_on = (mask > 0)[:, :, None]  # (B, M, 1)
        for action, moves in zip(one_hot.unbind(1), goes_on.unbind(1), strict=True):  # each step needs the one before
            state = th.where(moves, self.act(self.action_element(state, action), state), state)
            states.append(state)
        return th.stack(states, dim=1)

    def action_element(self, state: th.Tensor, one_hot: th.Tensor) -> th.Tensor:
        """κ(x, a), or κ(a): a state, (B, D), and one-hot actions, (B, A), to K group elements, (B, K, *element_shape)."""
        inputs = th.cat([state, one_hot], dim=1) if self.state_dependent_actions else one_hot
        return self.element(self.transition(inputs))

    def act(self, elements: th.Tensor, state: th.Tensor) -> th.Tensor:
        """Elements · state: (B, K, *element_shape) and (B, D) to (B, D)."""
        return self.group.compose(elements, self.blocks(state)).flatten(1)

    def _symmetry_loss(
        self, state: th.Tensor, predicted: th.Tensor, one_hot: th.Tensor, target_state: th.Tensor, target: "LatentModel"
    ) -> th.Tensor:
        """
        Eq. 19: τ_g moves the predicted next state x̂₁; ρ(τ_g) κ̄ moves the partner's state; both should arrive together. From
        x₀, x̂₁ and x̄₀, (B, D) each, and one-hot a_t, (B, A), to (B,).
        """
        partner = target_state[th.randint(len(state), (len(state),), device=state.device)]  # x̄_j of Algorithm 1
        with th.no_grad():  # τ_g carries no gradient, as in the authors' code
            inverse = self.group.inverse(self.blocks(state))
            symmetry = self.group.compose(self.blocks(partner), inverse)  # τ_g, (B, K, ...)
            target_action = target.action_element(state, one_hot)  # κ̄, (B, K, ...)
        moved_prediction = self.act(symmetry, predicted)
        action_map = self.element(self.action_symmetry(symmetry.flatten(1)))  # ρ(τ_g), (B, K, ...)
        moved_partner = self.act(self.group.compose(action_map, target_action), partner)
        return normalized_distance(self.projection(moved_prediction), target.projection(moved_partner))

    def blocks(self, state: th.Tensor) -> th.Tensor:
        """The blocks of a flat state: (B, D) to (B, K, *element_shape)."""
        return state.unflatten(1, (self.n_blocks, *self.group.element_shape))

    def element(self, params: th.Tensor) -> th.Tensor:
        """Group elements from their parameters: (B, K * num_params) to (B, K, *element_shape)."""
        return self.group.element(params.unflatten(1, (self.n_blocks, self.group.num_params)))


def _hidden_layer(n_in: int, n_hidden: int, n_out: int) -> nn.Sequential:
    """One hidden layer with batch norm and ReLU: κ, r_ψ and ρ alike (appendix B.4)."""
    return nn.Sequential(nn.Linear(n_in, n_hidden), nn.BatchNorm1d(n_hidden), nn.ReLU(), nn.Linear(n_hidden, n_out))
