"""The latent networks, with one normalised hidden layer, and the latent rollout, which applies κ repeatedly (Eq. 10)."""

from typing import Any

import torch as th
from torch import nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from sb3_eqr.common.groups import Group

Norm = nn.LayerNorm | nn.BatchNorm1d
NORMS: dict[str, type[Norm]] = {"layer": nn.LayerNorm, "batch": nn.BatchNorm1d}


class HiddenLayer(nn.Sequential):
    """
    Linear layer, norm, ReLU, linear layer: the architecture of κ, r_ψ and ρ (appendix B.4, where the norm is batch norm).

    :param n_in: size of the input
    :param n_hidden: H
    :param n_out: size of the output
    :param norm: "layer" or "batch"
    """

    def __init__(self, n_in: int, n_hidden: int, n_out: int, norm: str = "layer"):
        super().__init__(nn.Linear(n_in, n_hidden), NORMS[norm](n_hidden), nn.ReLU(), nn.Linear(n_hidden, n_out))

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """Map (B, n_in) to (B, n_out)."""
        first, norm, _, last = self
        weights = first.weight, first.bias, norm.weight, norm.bias, last.weight, last.bias
        return _HiddenLayer.apply(inputs, *weights, norm)


def _activate(before: th.Tensor, norm: Norm) -> tuple[th.Tensor, tuple[th.Tensor, ...]]:
    """Norm and ReLU of (B, H), without an autograd graph, and the tensors that :func:`_activate_backward` needs."""
    if isinstance(norm, nn.LayerNorm):
        found = th.native_layer_norm(before, norm.normalized_shape, norm.weight, norm.bias, norm.eps)
    else:
        statistics: Any = norm.running_mean, norm.running_var, norm.training, norm.momentum, norm.eps
        found = th.native_batch_norm(before, norm.weight, norm.bias, *statistics)
    normed, mean, inverse_deviation = found
    hidden = normed.relu_()
    return hidden, (before, hidden, norm.weight, mean, inverse_deviation)


def _activate_backward(gradient: th.Tensor, saved: tuple[th.Tensor, ...], norm: Norm) -> tuple[th.Tensor, ...]:
    """The gradients of :func:`_activate`'s input, (B, H), and of scale and shift, (H,), from the gradient of its result."""
    before, hidden, scale, *moments = saved
    of_normed = th.ops.aten.threshold_backward(gradient, hidden, 0)
    if isinstance(norm, nn.LayerNorm):
        arguments = norm.normalized_shape, *moments, scale, norm.bias, [True] * 3
        return th.ops.aten.native_layer_norm_backward(of_normed, before, *arguments)
    statistics = norm.running_mean, norm.running_var, *moments, norm.training, norm.eps
    return th.ops.aten.native_batch_norm_backward(of_normed, before, scale, *statistics, [True] * 3)


class _HiddenLayer(th.autograd.Function):
    """:class:`HiddenLayer` as one autograd node, which halves the number of operations of the backward pass."""

    @staticmethod
    def forward(
        ctx: Any,
        inputs: th.Tensor,
        weight: th.Tensor,
        bias: th.Tensor,
        scale: th.Tensor,
        shift: th.Tensor,
        last_weight: th.Tensor,
        last_bias: th.Tensor,
        norm: Norm,
    ) -> th.Tensor:
        hidden, saved = _activate(F.linear(inputs, weight, bias), norm)
        ctx.norm = norm
        ctx.save_for_backward(inputs, weight, last_weight, *saved)
        return F.linear(hidden, last_weight, last_bias)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:
        inputs, weight, last_weight, *saved = ctx.saved_tensors
        of_before, *of_norm = _activate_backward(gradient @ last_weight, tuple(saved), ctx.norm)
        of_first = of_before.mT @ inputs, of_before.sum(dim=0)
        of_last = gradient.mT @ saved[1], gradient.sum(dim=0)
        of_inputs = of_before @ weight if ctx.needs_input_grad[0] else None
        return of_inputs, *of_first, *of_norm, *of_last, None


def rollout(group: Group, state: th.Tensor, actions: th.Tensor, transition: HiddenLayer) -> th.Tensor:
    """
    x̂_m = κ(x̂_{m−1}, a_{t+m−1}) · x̂_{m−1}.

    :param group: group of the K blocks
    :param state: x₀, (B, D)
    :param actions: a_t ... a_{t+M-1}, int64, (B, M)
    :param transition: κ, which maps state and one-hot action, D + A numbers, to the parameters of K elements
    :return: x̂_1 ... x̂_M, (B, M, D)
    """
    layers: Any = transition
    first, norm, _, last = layers
    weight, of_actions = first.weight.split([state.shape[1], first.in_features - state.shape[1]], dim=1)
    offsets = F.embedding(actions.mT, of_actions.mT) + first.bias  # (M, B, H): contribution of the actions, for all steps
    return _Rollout.apply(state, offsets, weight, norm.weight, norm.bias, last.weight, last.bias, group, norm)


class _Rollout(th.autograd.Function):
    """
    The sequential steps of the rollout, with a hand-written gradient: only the gradient of the states is computed step by
    step; each weight gradient is one product over all steps.
    """

    @staticmethod
    def forward(
        ctx: Any,
        state: th.Tensor,
        offsets: th.Tensor,
        weight: th.Tensor,
        scale: th.Tensor,
        shift: th.Tensor,
        last_weight: th.Tensor,
        last_bias: th.Tensor,
        group: Group,
        norm: Norm,
    ) -> th.Tensor:
        transposed, last_transposed = weight.mT, last_weight.mT
        blocks = state.view(len(state), -1, *group.element_shape)  # (B, K, ...)
        states, ctx.steps = [state], []
        for offset in offsets.unbind():
            hidden, saved = _activate(th.addmm(offset, states[-1], transposed), norm)  # (B, H)
            params = th.addmm(last_bias, hidden, last_transposed)  # (B, K * num_params)
            blocks, pull_back = group.act_vjp(params.view(*blocks.shape[:2], -1), blocks)
            states.append(blocks.flatten(1))  # (B, D)
            ctx.steps.append((saved, pull_back))
        ctx.group, ctx.norm = group, norm
        ctx.save_for_backward(weight, last_weight, *states[:-1])
        return th.stack(states[1:], dim=1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:
        weight, last_weight, *states = ctx.saved_tensors
        *of_moved, of_state = gradient.unbind(1)  # (B, D) each
        shape = (len(of_state), -1, *ctx.group.element_shape)
        found = []
        for saved, pull_back in reversed(ctx.steps):
            of_elements, of_blocks = pull_back(of_state.view(shape))
            params = of_elements.flatten(1)  # (B, K * num_params)
            of_before, scale, shift = _activate_backward(params @ last_weight, saved, ctx.norm)
            of_state = th.addmm(of_blocks.flatten(1), of_before, weight)
            found.append((of_before, params, scale, shift))
            if of_moved:
                of_state += of_moved.pop()
        of_offsets, every_params, of_scale, of_shift = zip(*reversed(found), strict=True)
        rows, of_params = th.cat(of_offsets), th.cat(every_params)  # (M * B, ...)
        hiddens = th.cat([saved[1] for saved, _ in ctx.steps])
        of_weights = rows.mT @ th.cat(states), of_params.mT @ hiddens
        of_norm = th.stack(of_scale).sum(dim=0), th.stack(of_shift).sum(dim=0)
        by_steps = rows.view(len(ctx.steps), *of_offsets[0].shape)  # (M, B, H)
        return of_state, by_steps, of_weights[0], *of_norm, of_weights[1], of_params.sum(dim=0), None, None
