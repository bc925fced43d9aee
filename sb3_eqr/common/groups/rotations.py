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
    cos, sin = angles.cos(), angles.sin()  # (..., planes)
    if n == 2:  # one plane: there is nothing to multiply
        return th.cat([cos, sin, -sin, cos], dim=-1).unflatten(-1, (2, 2))
    cos, sin = cos[..., None], sin[..., None]
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
    with th.inference_mode(False):  # whoever calls first, it serves in training, too
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

    :param params: the columns one by one, (..., n(n-1)); all 0 is the identity. A column that depends on those before it gives
        way to the axis that depends on them least
    :return: (..., n, n)
    """
    found = params.new_empty(*params.shape[:-1], n, 0)  # (..., n, columns so far)
    for raw in params.unflatten(-1, (n - 1, n)).unbind(-2):
        column = _without(found, _without(found, raw))  # twice: once leaves rounding errors as large as what is left
        dependent = column.norm(dim=-1) <= n * _ROUNDING * th.finfo(params.dtype).eps * raw.detach().norm(dim=-1)
        column = th.where(dependent[..., None], _free_axis(found), column)
        found = th.cat([found, F.normalize(column, dim=-1)[..., None]], dim=-1)
    last = F.normalize(_free_axis(found), dim=-1)[..., None]
    orientation = th.linalg.det(th.cat([found, last], dim=-1).detach()).sign()[..., None, None]
    return th.cat([found, orientation * last], dim=-1)


_ROUNDING = 10.0  # machine epsilons that two rounds of subtracting may leave of a column of length 1


def _without(columns: th.Tensor, vector: th.Tensor) -> th.Tensor:
    """What of a vector, (..., n), is orthogonal to orthonormal columns, (..., n, k)."""
    return vector - (columns @ (columns.mT @ vector[..., None])).squeeze(-1)


def _free_axis(columns: th.Tensor) -> th.Tensor:
    """Of the axes the one with the longest part orthogonal to orthonormal columns, (..., n, k): that part, (..., n)."""
    eye = th.eye(columns.shape[-2], dtype=columns.dtype, device=columns.device)
    free = eye - columns @ columns.mT  # (..., n, n): its columns are those parts, its diagonal their squared lengths
    longest = free.detach().diagonal(dim1=-2, dim2=-1).argmax(dim=-1)  # (...)
    return (free @ eye[longest][..., None]).squeeze(-1)


# name -> (how many numbers make a rotation of n-space, the rotation that they make)
ROTATIONS: dict[str, tuple[Callable[[int], int], Callable[[th.Tensor, int], th.Tensor]]] = {
    "euler": (lambda n: n * (n - 1) // 2, euler_rotation),
    "exp": (lambda n: n * (n - 1) // 2, exp_rotation),
    "gram-schmidt": (lambda n: n * (n - 1), gram_schmidt_rotation),
}
