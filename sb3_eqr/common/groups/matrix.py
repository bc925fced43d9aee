"""Rotations, the groups of Table 1, and groups given by generators of their Lie algebra (EqR, §3.1 and appendix A)."""

import zlib
from collections.abc import Callable, Sequence
from functools import cache

import torch as th
from torch.nn import functional as F

from sb3_eqr.common.groups.base import Group


def euler_rotation(angles: th.Tensor, n: int) -> th.Tensor:
    """
    R = Π_{i<j} R^{ij}(θ_ij): one rotation per plane, planes in lexicographic order (appendix A.2,
    following Quessard et al. 2020). R^{ij} holds [[cos, sin], [-sin, cos]] on rows and columns i, j.

    :param angles: radians, (..., n(n-1)/2)
    :return: (..., n, n)
    """
    if n == 2:  # one plane: no product needed
        cos, sin = angles.cos(), angles.sin()  # (..., 1)
        return th.cat([cos, sin, -sin, cos], dim=-1).view(*angles.shape[:-1], 2, 2)
    cos, sin = angles.cos()[..., None], angles.sin()[..., None]  # (..., planes, 1)
    columns = list(th.eye(n, dtype=angles.dtype, device=angles.device).expand(*angles.shape[:-1], n, n).unbind(-1))
    for plane, (i, j) in enumerate(_planes(n)):  # multiplying by R^{ij} from the right mixes columns i and j
        c, s = cos[..., plane, :], sin[..., plane, :]
        columns[i], columns[j] = c * columns[i] - s * columns[j], s * columns[i] + c * columns[j]
    return th.stack(columns, dim=-1)


def exp_rotation(angles: th.Tensor, n: int) -> th.Tensor:
    """
    R = exp(Σ β_ij E^{ij}) over the skew-symmetric basis with E_ij = 1, E_ji = -1 (Eq. 13 and the SO(2) example
    of appendix A.2; this sign makes it equal to the Euler form on SO(2)).

    :param angles: radians, (..., n(n-1)/2)
    :return: (..., n, n)
    """
    return th.matrix_exp(th.einsum("...d,dij->...ij", angles, _skew_basis(n, angles.dtype, angles.device)))


@cache
def _skew_basis(n: int, dtype: th.dtype, device: th.device) -> th.Tensor:
    with th.inference_mode(False):  # the cached tensor must also work in training, even if first used for inference
        basis = th.zeros(n * (n - 1) // 2, n, n, dtype=dtype)
        for d, (i, j) in enumerate(_planes(n)):
            basis[d, i, j], basis[d, j, i] = 1.0, -1.0
        return basis.to(device)


def _planes(n: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(n) for j in range(i + 1, n)]


def gram_schmidt_rotation(params: th.Tensor, n: int) -> th.Tensor:
    """
    The network predicts the first n − 1 columns, which are orthonormalised one after another; the last column completes the
    rotation (Zhou et al. 2019, §4, https://arxiv.org/abs/1812.07035). Unlike angles, these parameters need not jump when a
    state returns to its start: a continuous map from a loop to the real line cannot wind around a circle.

    :param params: the columns one by one, (..., n(n-1)); all 0 is the identity. A column that is linearly dependent on the
        previous ones is replaced by the axis that depends on them least
    :return: (..., n, n)
    """
    found = params.new_empty(*params.shape[:-1], n, 0)  # (..., n, columns so far)
    for raw in params.unflatten(-1, (n - 1, n)).unbind(-2):
        column = _without(found, _without(found, raw))  # twice: once may leave rounding errors as large as the remainder
        dependent = column.norm(dim=-1) <= n * _ROUNDING * th.finfo(params.dtype).eps * raw.detach().norm(dim=-1)
        column = th.where(dependent[..., None], _free_axis(found), column)
        found = th.cat([found, F.normalize(column, dim=-1)[..., None]], dim=-1)
    last = F.normalize(_free_axis(found), dim=-1)[..., None]
    orientation = th.linalg.det(th.cat([found, last], dim=-1).detach()).sign()[..., None, None]
    return th.cat([found, orientation * last], dim=-1)


_ROUNDING = 10.0  # machine epsilons that may remain of a column of length 1 after subtracting twice


def _without(columns: th.Tensor, vector: th.Tensor) -> th.Tensor:
    """The component of a vector, (..., n), orthogonal to orthonormal columns, (..., n, k)."""
    return vector - (columns @ (columns.mT @ vector[..., None])).squeeze(-1)


def _free_axis(columns: th.Tensor) -> th.Tensor:
    """The longest component, (..., n), of a coordinate axis orthogonal to orthonormal columns, (..., n, k)."""
    eye = th.eye(columns.shape[-2], dtype=columns.dtype, device=columns.device)
    free = eye - columns @ columns.mT  # (..., n, n): its columns are these components, its diagonal their squared lengths
    longest = free.detach().diagonal(dim1=-2, dim2=-1).argmax(dim=-1)  # (...)
    return (free @ eye[longest][..., None]).squeeze(-1)


# name -> (number of parameters of a rotation in n dimensions, function from parameters to the rotation)
ROTATIONS: dict[str, tuple[Callable[[int], int], Callable[[th.Tensor, int], th.Tensor]]] = {
    "euler": (lambda n: n * (n - 1) // 2, euler_rotation),
    "exp": (lambda n: n * (n - 1) // 2, exp_rotation),
    "gram-schmidt": (lambda n: n * (n - 1), gram_schmidt_rotation),
}


class MatrixGroup(Group):
    """
    Matrices under multiplication; base class of GL, SE, SO and groups given by generators.

    :param name: name of the group
    :param num_params: number of parameters per element
    :param size: m, for m×m matrices
    :param is_affine: whether the last row of every matrix is 0 ... 0 1. Elements omit this constant row
    """

    def __init__(self, name: str, num_params: int, size: int, is_affine: bool = False):
        super().__init__(name, num_params, (size - 1 if is_affine else size, size))
        self.is_affine = is_affine

    def matrix(self, element: th.Tensor) -> th.Tensor:
        """The matrices, (..., m, m), of elements, (..., *element_shape)."""
        if not self.is_affine:
            return element
        m = element.shape[-1]
        bottom = _bottom_row(m, element.dtype, element.device).expand(*element.shape[:-2], 1, m)
        return th.cat([element, bottom], dim=-2)

    def compose(self, left: th.Tensor, right: th.Tensor) -> th.Tensor:
        return left @ self.matrix(right)  # [A, t] [[A', t'], [0, 1]] = [A A', A t' + t]

    def inverse(self, element: th.Tensor) -> th.Tensor:
        if not self.is_affine:
            return guarded_inverse(element)
        inverse = guarded_inverse(element[..., :-1])  # of [A, t]: [A⁻¹, −A⁻¹ t], however large t is
        return th.cat([inverse, -inverse @ element[..., -1:]], dim=-1)

    def identity(self, *batch: int, dtype: th.dtype | None = None, device: th.device | str | None = None) -> th.Tensor:
        return th.eye(*self.element_shape, dtype=dtype, device=device).expand(*batch, *self.element_shape)


@cache
def _bottom_row(m: int, dtype: th.dtype, device: th.device) -> th.Tensor:
    with th.inference_mode(False):  # the cached tensor must also work in training, even if first used for inference
        return th.eye(m, dtype=dtype)[-1:].to(device)


# The damped inverse replaces the plain one if the condition number exceeds the reciprocal of this many machine epsilons:
# beyond that, a plain solve has no correct digits left.
_SINGULAR_EPS = 10.0


def guarded_inverse(matrix: th.Tensor) -> th.Tensor:
    """
    The inverse, or, for a matrix that is singular to machine precision, Tikhonov's damped inverse
    (AᵀA + ε‖A‖² I)⁻¹ Aᵀ. Raises no exception and has no data-dependent shapes.

    :param matrix: square matrices, (..., n, n); the result is finite if the squares of their entries are
    :return: (..., n, n)
    """
    eps = th.finfo(matrix.dtype).eps
    eye = th.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    with th.no_grad():
        plain, _ = th.linalg.inv_ex(matrix)
        norms = th.linalg.matrix_norm(matrix) * th.linalg.matrix_norm(plain)
        singular = ~(norms < 1 / (_SINGULAR_EPS * eps))  # a NaN counts as singular
    singular = singular[..., None, None]
    # Each branch gets only matrices that it can handle, so that neither produces a NaN in the other's gradient.
    regular_inverse, _ = th.linalg.inv_ex(th.where(singular, eye, matrix))
    to_damp = th.where(singular, matrix, eye)
    gram = to_damp.mT @ to_damp  # (..., n, n)
    scale = gram.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    damping = eps**0.5 * scale + th.finfo(matrix.dtype).tiny ** 0.5  # the zero matrix has scale 0
    damped_inverse, _ = th.linalg.inv_ex(gram + damping * eye)
    return th.where(singular, damped_inverse @ to_damp.mT, regular_inverse)


class GL(MatrixGroup):
    """General linear: n×n matrices whose entries are the parameters (almost all are invertible, appendix A.2)."""

    def __init__(self, n: int):
        super().__init__(f"GL({n})", n * n, n)

    def element(self, params: th.Tensor) -> th.Tensor:
        return params.unflatten(-1, self.element_shape)

    def identity_params(self) -> th.Tensor:
        return th.eye(self.element_shape[0]).flatten()


class _Rotations(MatrixGroup):
    """
    Base class of SO and SE.

    :param name: "SO" or "SE"
    :param n: dimension of the space
    :param parameterization: a key of ``ROTATIONS``
    :param n_shifts: number of translation parameters, 0 or n
    """

    def __init__(self, name: str, n: int, parameterization: str, n_shifts: int):
        self.n_angles, self.rotation = ROTATIONS[parameterization][0](n), ROTATIONS[parameterization][1]
        super().__init__(f"{name}({n})", self.n_angles + n_shifts, n + (n_shifts > 0), is_affine=n_shifts > 0)
        self.n = n
        self.parameterization = parameterization

    @property
    def for_actions(self) -> Group:
        return type(self)(self.n) if self.parameterization == "gram-schmidt" else self  # type: ignore[call-arg, arg-type]


class SO(_Rotations):
    """Special orthogonal: rotations in n dimensions, n ≥ 2."""

    def __init__(self, n: int, parameterization: str = "euler"):
        super().__init__("SO", n, parameterization, n_shifts=0)

    def element(self, params: th.Tensor) -> th.Tensor:
        return self.rotation(params, self.n)

    def inverse(self, element: th.Tensor) -> th.Tensor:
        return element.mT


class SE(_Rotations):
    """
    Special Euclidean: [[R, t], [0, 1]]. An element holds the entries that vary, [R, t]. The parameters of R come first, then
    those of t.
    """

    def __init__(self, n: int, parameterization: str = "euler"):
        super().__init__("SE", n, parameterization, n_shifts=n)

    def element(self, params: th.Tensor) -> th.Tensor:
        angles, shift = params.split([self.n_angles, self.n], dim=-1)
        return th.cat([self.rotation(angles, self.n), shift[..., None]], dim=-1)  # (..., n, n + 1)

    def inverse(self, element: th.Tensor) -> th.Tensor:
        rotation_inverse = element[..., :-1].mT
        return th.cat([rotation_inverse, -rotation_inverse @ element[..., -1:]], dim=-1)


class T(Group):
    """Translations: n-vectors under addition."""

    def __init__(self, n: int):
        super().__init__(f"T({n})", n, (n,))

    def element(self, params: th.Tensor) -> th.Tensor:
        return params

    def compose(self, left: th.Tensor, right: th.Tensor) -> th.Tensor:
        return left + right

    def inverse(self, element: th.Tensor) -> th.Tensor:
        return -element

    def identity(self, *batch: int, dtype: th.dtype | None = None, device: th.device | str | None = None) -> th.Tensor:
        return th.zeros(*batch, *self.element_shape, dtype=dtype, device=device)


class NoGroup(Group):
    """
    No group: unconstrained n-vectors. ``compose`` returns the left factor, so the transition network predicts the next
    state directly. This is the MLP row of Table 3, and the kind of model that SPR uses.
    """

    has_inverse = False

    def __init__(self, n: int):
        super().__init__(f"none({n})", n, (n,))

    def element(self, params: th.Tensor) -> th.Tensor:
        return params

    def compose(self, left: th.Tensor, right: th.Tensor) -> th.Tensor:
        return left.expand(th.broadcast_shapes(left.shape, right.shape))

    def inverse(self, element: th.Tensor) -> th.Tensor:
        raise ValueError('group must have inverses for the GET loss, got "none". Pass symmetry_coef=0 or another group.')

    def identity(self, *batch: int, dtype: th.dtype | None = None, device: th.device | str | None = None) -> th.Tensor:
        raise ValueError('group must have an identity, got "none". Pass a group such as "SE(2)".')

    def identity_params(self) -> th.Tensor:
        return self.identity()


class MatrixLieGroup(MatrixGroup):
    """
    Any matrix Lie group, given by a basis of its Lie algebra: element = exp(Σ β_i E⁽ⁱ⁾) (Eq. 13).

    :param generators: the basis E⁽ⁱ⁾, (D, m, m), anything ``torch.as_tensor`` accepts; finite, D ≥ 1, m ≥ 1
    :raises ValueError: if the shape is wrong, an entry is not finite, or the matrices are linearly dependent
    """

    def __init__(self, generators: th.Tensor | Sequence):
        basis = th.as_tensor(generators, dtype=th.float64)
        if basis.ndim != 3 or basis.shape[1] != basis.shape[2] or 0 in basis.shape or not basis.isfinite().all():
            raise ValueError(
                f"generators must be D >= 1 finite square matrices of shape (D, m, m), got shape {tuple(basis.shape)}"
                f"{'' if basis.isfinite().all() else ' with entries that are not finite'}."
            )
        if th.linalg.matrix_rank(basis.flatten(1)) < len(basis):
            raise ValueError(
                f"generators must be linearly independent, got {len(basis)} linearly dependent matrices. Leave out "
                "those that are linear combinations of others."
            )
        self.generators = basis.detach().clone()
        checksum = zlib.crc32(self.generators.numpy().tobytes())  # distinguishes groups whose bases have the same shape
        d, m, _ = basis.shape
        is_affine = m > 1 and not bool(basis[:, -1].any())  # if the last row of A is 0, that of exp(A) is 0 ... 0 1
        super().__init__(f"MatrixLieGroup({d}x{m}x{m}, {checksum:08x})", d, m, is_affine)

    def element(self, params: th.Tensor) -> th.Tensor:
        matrix = th.matrix_exp(th.einsum("...d,dij->...ij", params, self.generators.to(params)))
        return matrix[..., : self.element_shape[0], :]
