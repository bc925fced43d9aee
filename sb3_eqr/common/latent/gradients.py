"""Where the gradients of the TD loss and of the auxiliary losses meet, at the features, the auxiliary one is capped."""

from typing import Any

import torch as th
from torch.autograd.function import once_differentiable


def branch(features: th.Tensor, share: float | None, gram: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    Return the features twice, once for the TD loss and once for the auxiliary losses. The backward pass keeps the two
    gradients separate, and scales the auxiliary gradient so that its norm is at most ``share`` times that of the TD gradient.

    :param features: (B, F)
    :param share: ≥ 0; ``None``: no scaling
    :param gram: (2, 2), filled by the backward pass with the inner products of the TD and the auxiliary gradient
    :return: the features for the TD loss and for the auxiliary losses, (B, F) each
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
