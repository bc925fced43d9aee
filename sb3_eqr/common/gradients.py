"""From a loss to gradients within their norm, in few operations."""

from collections.abc import Iterable
from typing import Any

import torch as th
from torch import nn
from torch.autograd.function import once_differentiable


def clip_grad_norm(parameters: Iterable[nn.Parameter], max_norm: float | None) -> th.Tensor:
    """
    As PyTorch's ``clip_grad_norm_``, for parameters of one device and dtype, in a fifth of its operations.

    :param parameters: those without a gradient are left out; at least one has one
    :param max_norm: of all gradients together, > 0; ``None``: nothing is clipped
    :return: the norm before clipping, ()
    """
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    norm = th.linalg.vector_norm(th.stack(th._foreach_norm(gradients)))
    if max_norm is not None and (norm.is_cuda or norm > max_norm):  # a GPU would have to be waited for
        th._foreach_mul_(gradients, (max_norm / (norm + 1e-6)).clamp(max=1.0))
    return norm


def assign_gradients(loss: th.Tensor, parameters: Iterable[nn.Parameter]) -> None:
    """
    ``loss.backward()`` for parameters that have no gradient yet or one to forget: theirs are replaced, and nothing is
    accumulated, which saves an operation for each. A parameter that the loss does not depend on, or a frozen one, has
    ``None`` then.

    :param loss: ()
    :param parameters: those trained
    """
    trained = []
    for parameter in parameters:
        parameter.grad = None
        if parameter.requires_grad:
            trained.append(parameter)
    for parameter, gradient in zip(trained, th.autograd.grad(loss, trained, allow_unused=True), strict=True):
        parameter.grad = gradient


def branch(features: th.Tensor, share: float | None, gram: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    Features for the TD loss and for the auxiliary losses: the same numbers, but the gradients of both are kept apart where
    they meet, and the auxiliary one is scaled there so that its norm is at most a share of the TD loss's.

    :param features: (B, F)
    :param share: ≥ 0; ``None``: nothing is scaled
    :param gram: (2, 2), filled in by the backward pass: the inner products of TD and auxiliary gradient
    :return: (B, F) twice
    """
    return _Branch.apply(features, share, gram)


class _Branch(th.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: th.Tensor, share: float | None, gram: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        ctx.share, ctx.gram = share, gram
        return features.view_as(features), features.view_as(features)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_td: th.Tensor, of_auxiliary: th.Tensor) -> tuple[th.Tensor | None, ...]:
        both = th.stack([of_td.flatten(), of_auxiliary.flatten()])  # (2, B * F)
        th.mm(both, both.mT, out=ctx.gram)
        if ctx.share is None:
            return of_td + of_auxiliary, None, None
        squares = ctx.gram.diagonal()
        scale = (ctx.share * (squares[0] / squares[1].clamp(min=1e-30)).sqrt()).clamp(max=1.0)
        return th.addcmul(of_td, of_auxiliary, scale), None, None
