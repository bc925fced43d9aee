"""
Rotations of n-space from the numbers that a network predicts (EqR, appendix A.2).

Every function is differentiable and batched over all leading dimensions.
"""

from collections.abc import Callable
from functools import cache

import torch as th
from torch.nn import functional as F


def euler_rotation(angles: th.Tensor, n: int) -> th.Tensor:
    """
    R = Π_{i<j} R^{ij}(θ_ij): one rotation per plane, planes in lexicographic order (appendix A.2,
    following Quessard et al. 2020). R^{ij} holds [[cos, sin], [-sin, cos]] on rows and columns i, j.

    :param angles: radians, (..., n(n-1)/2)
    :return: (..., n, n)
    """
    cos, sin = angles.cos()[..., None], angles.sin()[..., None]  # (..., planes, 1)
    columns = list(th.eye(n, dtype=angles.dtype, device=angles.device).expand(*angles.shape[:-1], n, n).unbind(-1))
    for plane, (i, j) in enumerate(_planes(n)):  # multiplying by R^{ij} from the right mixes columns i and j
        c, s = cos[..., plane, :], sin[..., plane, :]
        columns[i], columns[j] = c * columns[i] - s * columns[j], s * columns[i] + c * columns[j]
    return th.stack(columns, dim=-1)


def exp_rotation(angles: th.Tensor, n: int) -> th.Tensor:
    """
    R = exp(Σ β_ij E^{ij}) over the skew-symmetric basis with E_ij = 1, E_ji = -1 (Eq. 13 and the SO(2) example
    of appendix A.2; the sign for which it equals the Euler form on SO(2)).

    :param angles: radians, (..., n(n-1)/2)
    :return: (..., n, n)
    """
    return th.matrix_exp(th.einsum("...d,dij->...ij", angles, _skew_basis(n, angles.dtype, angles.device)))


@cache
def _skew_basis(n: int, dtype: th.dtype, device: th.device) -> th.Tensor:
    basis = th.zeros(n * (n - 1) // 2, n, n, dtype=dtype)
    for d, (i, j) in enumerate(_planes(n)):
        basis[d, i, j], basis[d, j, i] = 1.0, -1.0
    return basis.to(device)


def _planes(n: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(n) for j in range(i + 1, n)]


def gram_schmidt_rotation(params: th.Tensor, n: int) -> th.Tensor:
    """
    The n − 1 first columns are predicted whole and made orthonormal one after another, the last one completes a rotation
    (Zhou et al. 2019, §4, https://arxiv.org/abs/1812.07035). Unlike angles, these numbers need not jump where a state comes
    round to where it was: a continuous map from a loop to the real line cannot wind around a circle.

    :param params: the columns one by one, (..., n(n-1)); all 0 is the identity
    :return: (..., n, n)
    """
    eye = th.eye(n, dtype=params.dtype, device=params.device)
    # A trace of the identity, so that a vector of zeros has a direction; lost in the rounding of any other.
    raw = params.unflatten(-1, (n - 1, n)) + th.finfo(params.dtype).tiny ** 0.25 * eye[: n - 1]  # (..., n - 1, n)
    columns: list[th.Tensor] = []
    for column in raw.unbind(-2):
        for found in columns:
            column = column - (column * found).sum(-1, keepdim=True) * found
        columns.append(F.normalize(column, dim=-1, eps=th.finfo(params.dtype).tiny))
    known = th.stack(columns, dim=-1) if columns else params.new_empty(*params.shape[:-1], n, 0)  # (..., n, n - 1)
    rows = th.tensor([[k for k in range(n) if k != i] for i in range(n)], dtype=th.long, device=params.device)  # (n, n - 1)
    signs = th.tensor([(-1.0) ** (i + n - 1) for i in range(n)], dtype=params.dtype, device=params.device)
    last = signs * th.linalg.det(known[..., rows, :])  # (..., n): the cofactors of the last column
    return th.cat([known, last[..., None]], dim=-1)


# name -> (how many numbers make a rotation of n-space, the rotation that they make)
ROTATIONS: dict[str, tuple[Callable[[int], int], Callable[[th.Tensor, int], th.Tensor]]] = {
    "euler": (lambda n: n * (n - 1) // 2, euler_rotation),
    "exp": (lambda n: n * (n - 1) // 2, exp_rotation),
    "gram-schmidt": (lambda n: n * (n - 1), gram_schmidt_rotation),
}
