"""
Matrix Lie groups: what states and actions are made of (EqR, §3.1, §4 and appendix A).

A network predicts ``num_params`` numbers per block; :meth:`Group.element` turns them into a group element.
Every method is stateless, differentiable and batched over all leading dimensions.
"""

import re
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cache
from math import prod

import torch as th

from sb3_eqr.common.rotations import ROTATIONS

# An inverse is replaced by its damped form where the condition number exceeds the inverse of this many
# machine epsilons: beyond it, a plain solve has no correct digit left.
_SINGULAR_EPS = 10.0


class Group(ABC):
    """
    A group whose elements are arrays of one shape.

    ``num_params``: how many numbers the network predicts per element.
    ``element_shape``: the shape of one element.
    ``has_inverse``: False only where the "group" is none (see :class:`NoGroup`).
    ``needs_host``: True where an element needs a number on the host, as PyTorch's matrix exponential does on a GPU.
    """

    num_params: int
    element_shape: tuple[int, ...]
    has_inverse: bool = True
    needs_host: bool = False

    def __init__(self, name: str, num_params: int, element_shape: tuple[int, ...]):
        self.name = name
        self.num_params = num_params
        self.element_shape = element_shape

    def __repr__(self) -> str:
        return self.name

    @abstractmethod
    def element(self, params: th.Tensor) -> th.Tensor:
        """
        :param params: real numbers, (..., num_params), floating point
        :return: group elements, (..., \\*element_shape), same dtype and device
        """

    @abstractmethod
    def compose(self, left: th.Tensor, right: th.Tensor) -> th.Tensor:
        """
        The group's operation; the left factor acts on the right one (Eq. 10).

        :param left: (..., \\*element_shape)
        :param right: (..., \\*element_shape), broadcast against ``left``
        :return: (..., \\*element_shape)
        """

    @abstractmethod
    def inverse(self, element: th.Tensor) -> th.Tensor:
        """
        :param element: (..., \\*element_shape)
        :return: (..., \\*element_shape); finite also where a GL element is singular
        """

    @abstractmethod
    def identity(self, *batch: int, dtype: th.dtype | None = None, device: th.device | str | None = None) -> th.Tensor:
        """
        :param batch: leading dimensions
        :return: (\\*batch, \\*element_shape)
        """

    @property
    def for_actions(self) -> "Group":
        """
        The same group with the parameters that actions are predicted in: small numbers are small moves there. States have
        to cover the whole group, which "gram-schmidt" does without a seam; an action only has to leave the identity.
        """
        return self

    def identity_params(self) -> th.Tensor:
        """
        :return: parameters of the identity, (num_params,)
        """
        return th.zeros(self.num_params)


class MatrixGroup(Group):
    """Matrices under multiplication; the base of GL, SE, SO and of groups given by generators."""

    def compose(self, left: th.Tensor, right: th.Tensor) -> th.Tensor:
        return left @ right

    def inverse(self, element: th.Tensor) -> th.Tensor:
        return guarded_inverse(element)

    def identity(self, *batch: int, dtype: th.dtype | None = None, device: th.device | str | None = None) -> th.Tensor:
        return th.eye(self.element_shape[-1], dtype=dtype, device=device).expand(*batch, *self.element_shape)


def guarded_inverse(matrix: th.Tensor) -> th.Tensor:
    """
    The inverse where there is one; where the matrix is singular to machine precision, the damped inverse
    (AᵀA + ε‖A‖² I)⁻¹ Aᵀ of Tikhonov, which is always finite. No exception, no data-dependent shape.

    :param matrix: square matrices, (..., n, n), finite
    :return: (..., n, n)
    """
    eps = th.finfo(matrix.dtype).eps
    eye = th.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    with th.no_grad():
        plain, _ = th.linalg.inv_ex(matrix)
        norms = th.linalg.matrix_norm(matrix) * th.linalg.matrix_norm(plain)
        singular = ~(norms < 1 / (_SINGULAR_EPS * eps))  # a NaN counts as singular
    singular = singular[..., None, None]
    # Each branch sees only the matrices that it can handle, so that neither puts a NaN into the other's gradient.
    regular_inverse, _ = th.linalg.inv_ex(th.where(singular, eye, matrix))
    to_damp = th.where(singular, matrix, eye)
    gram = to_damp.mT @ to_damp  # (..., n, n)
    scale = gram.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    damping = eps**0.5 * scale + th.finfo(matrix.dtype).tiny ** 0.5  # the zero matrix has scale 0
    damped_inverse, _ = th.linalg.inv_ex(gram + damping * eye)
    return th.where(singular, damped_inverse @ to_damp.mT, regular_inverse)


class GL(MatrixGroup):
    """General linear: n×n matrices, each entry predicted (almost every one is invertible, appendix A.2)."""

    def __init__(self, n: int):
        super().__init__(f"GL({n})", n * n, (n, n))

    def element(self, params: th.Tensor) -> th.Tensor:
        return params.unflatten(-1, self.element_shape)

    def identity_params(self) -> th.Tensor:
        return th.eye(self.element_shape[0]).flatten()


class SO(MatrixGroup):
    """Special orthogonal: rotations of n-space, n ≥ 2."""

    def __init__(self, n: int, parameterization: str = "euler"):
        count, self.rotation = ROTATIONS[parameterization]
        super().__init__(f"SO({n})", count(n), (n, n))
        self.parameterization = parameterization
        self.needs_host = parameterization == "exp"

    def element(self, params: th.Tensor) -> th.Tensor:
        return self.rotation(params, self.element_shape[-1])

    def inverse(self, element: th.Tensor) -> th.Tensor:
        return element.mT

    @property
    def for_actions(self) -> Group:
        return SO(self.element_shape[-1]) if self.parameterization == "gram-schmidt" else self


class SE(MatrixGroup):
    """Special Euclidean: [[R, t], [0, 1]]. What makes R comes first among the parameters, then t."""

    def __init__(self, n: int, parameterization: str = "euler"):
        count, self.rotation = ROTATIONS[parameterization]
        super().__init__(f"SE({n})", count(n) + n, (n + 1, n + 1))
        self.n = n
        self.parameterization = parameterization
        self.needs_host = parameterization == "exp"

    def element(self, params: th.Tensor) -> th.Tensor:
        angles, translation = params.split([self.num_params - self.n, self.n], dim=-1)
        return self._assemble(self.rotation(angles, self.n), translation[..., None])

    def inverse(self, element: th.Tensor) -> th.Tensor:
        rotation_inverse = element[..., :-1, :-1].mT
        return self._assemble(rotation_inverse, -rotation_inverse @ element[..., :-1, -1:])

    @property
    def for_actions(self) -> Group:
        return SE(self.n) if self.parameterization == "gram-schmidt" else self

    def _assemble(self, rotation: th.Tensor, translation: th.Tensor) -> th.Tensor:
        top = th.cat([rotation, translation], dim=-1)  # (..., n, n + 1)
        return th.cat([top, _bottom_row(self.n, top.dtype, top.device).expand(*top.shape[:-2], 1, self.n + 1)], dim=-2)


@cache
def _bottom_row(n: int, dtype: th.dtype, device: th.device) -> th.Tensor:
    with th.inference_mode(False):  # whoever calls first, it serves in training, too
        return th.eye(n + 1, dtype=dtype)[-1:].to(device)


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
    No group at all: free n-vectors, and "composing" keeps the left factor, so that the transition network
    predicts the next state itself. This is the MLP row of Table 3, and SPR's kind of model.
    """

    has_inverse = False

    def __init__(self, n: int):
        super().__init__(f"none({n})", n, (n,))

    def element(self, params: th.Tensor) -> th.Tensor:
        return params

    def compose(self, left: th.Tensor, right: th.Tensor) -> th.Tensor:
        return left.expand(th.broadcast_shapes(left.shape, right.shape))

    def inverse(self, element: th.Tensor) -> th.Tensor:
        raise ValueError('group "none" has no inverse, so it cannot serve the GET loss: set get_coef=0 or choose a group')

    def identity(self, *batch: int, dtype: th.dtype | None = None, device: th.device | str | None = None) -> th.Tensor:
        raise ValueError('group "none" has no identity: choose a group such as "SE(2)"')

    def identity_params(self) -> th.Tensor:
        return self.identity()


class MatrixLieGroup(MatrixGroup):
    """
    Any matrix Lie group, given by a basis of its algebra: element = exp(Σ β_i E⁽ⁱ⁾) (Eq. 13).

    :param generators: the basis E⁽ⁱ⁾, (D, m, m), anything ``torch.as_tensor`` takes; finite, D ≥ 1, m ≥ 1
    :raises ValueError: if the shape is another, an entry is not finite, or they depend on each other
    """

    needs_host = True

    def __init__(self, generators: th.Tensor | Sequence):
        basis = th.as_tensor(generators, dtype=th.float64)
        if basis.ndim != 3 or basis.shape[1] != basis.shape[2] or 0 in basis.shape or not basis.isfinite().all():
            raise ValueError(
                f"generators: expected D >= 1 finite square matrices, shape (D, m, m), found shape {tuple(basis.shape)}"
                f"{'' if basis.isfinite().all() else ' with entries that are not finite'}"
            )
        if th.linalg.matrix_rank(basis.flatten(1)) < len(basis):
            raise ValueError(
                f"generators: expected a basis, found {len(basis)} matrices that depend on each other. Leave out "
                "those that are sums of others."
            )
        self.generators = basis
        checksum = zlib.crc32(basis.numpy().tobytes())  # two bases of one shape are two groups
        super().__init__(
            f"MatrixLieGroup({basis.shape[0]}x{basis.shape[1]}x{basis.shape[2]}, {checksum:08x})",
            basis.shape[0],
            tuple(basis.shape[1:]),
        )
        self._placed: dict[tuple[th.dtype, th.device], th.Tensor] = {}

    def element(self, params: th.Tensor) -> th.Tensor:
        place = (params.dtype, params.device)
        if place not in self._placed:  # copied once per device, not once per step
            self._placed[place] = self.generators.to(dtype=params.dtype, device=params.device)
        return th.matrix_exp(th.einsum("...d,dij->...ij", params, self._placed[place]))


class ProductGroup(Group):
    """
    Different groups side by side, as one flat vector: the first factor's blocks, then the second's, and so on.

    :param factors: pairs of a group and how many blocks of it
    """

    def __init__(self, factors: Sequence[tuple[Group, int]]):
        self.factors = list(factors)
        self.has_inverse = all(group.has_inverse for group, _ in self.factors)
        self.needs_host = any(group.needs_host for group, _ in self.factors)
        self._sizes = [count * prod(group.element_shape) for group, count in self.factors]
        name = " x ".join(f"{group}^{count}" if count > 1 else f"{group}" for group, count in self.factors)
        super().__init__(name, sum(group.num_params * count for group, count in self.factors), (sum(self._sizes),))

    def element(self, params: th.Tensor) -> th.Tensor:
        pieces = params.split([group.num_params * count for group, count in self.factors], dim=-1)
        return self._flatten(
            group.element(piece.unflatten(-1, (count, group.num_params)))
            for (group, count), piece in zip(self.factors, pieces, strict=True)
        )

    def compose(self, left: th.Tensor, right: th.Tensor) -> th.Tensor:
        pairs = zip(self.factors, self._unflatten(left), self._unflatten(right), strict=True)
        return self._flatten(group.compose(a, b) for (group, _), a, b in pairs)

    def inverse(self, element: th.Tensor) -> th.Tensor:
        pieces = zip(self.factors, self._unflatten(element), strict=True)
        return self._flatten(group.inverse(piece) for (group, _), piece in pieces)

    def identity(self, *batch: int, dtype: th.dtype | None = None, device: th.device | str | None = None) -> th.Tensor:
        return self._flatten(group.identity(*batch, n, dtype=dtype, device=device) for group, n in self.factors)

    def identity_params(self) -> th.Tensor:
        return th.cat([group.identity_params().repeat(count) for group, count in self.factors])

    @property
    def for_actions(self) -> Group:
        return ProductGroup([(group.for_actions, count) for group, count in self.factors])

    def _unflatten(self, element: th.Tensor) -> list[th.Tensor]:
        pieces = element.split(self._sizes, dim=-1)
        return [
            piece.unflatten(-1, (count, *group.element_shape))
            for (group, count), piece in zip(self.factors, pieces, strict=True)
        ]

    def _flatten(self, pieces) -> th.Tensor:
        groups = [group for group, _ in self.factors]
        return th.cat([piece.flatten(-1 - len(g.element_shape)) for g, piece in zip(groups, pieces, strict=True)], dim=-1)


_FACTOR = re.compile(r"(GL|SE|SO|T|none)(?:\((\d+)\))?(?:\^(\d+))?")
_LEGAL = "GL(n), SE(n), T(n) with n >= 1, SO(n) with n >= 2, none or none(n), or a product such as 'SE(2)^8 x SO(3)^4'"
NO_GROUP_SIZE = 512  # the width of SB3's NatureCNN, for "none" without a size


def make_group(group: "str | Group", parameterization: str = "euler") -> Group:
    """
    The one table from names to groups.

    :param group: "GL(n)", "SE(n)", "SO(n)", "T(n)", "none", a product such as "SE(2)^8 x SO(3)^4";
        a :class:`Group` is returned as it is
    :param parameterization: of rotations, in SO and SE: "euler" (product over planes, the default of the paper's
        experiments), "exp" (matrix exponential) or "gram-schmidt" (orthonormalised columns, which have no seam)
    :raises ValueError: for a name or size that is not legal; the message lists the legal ones
    """
    if isinstance(group, Group):
        return group
    if not isinstance(group, str):
        raise ValueError(f"group: expected {_LEGAL}; found {group!r}")
    if parameterization not in ROTATIONS:
        raise ValueError(f"parameterization: expected one of {list(ROTATIONS)}, found {parameterization!r}")
    factors = [_make_factor(part, group, parameterization) for part in re.split(r"[x×]", group.replace(" ", ""))]
    if len(factors) == 1 and factors[0][1] is None:
        return factors[0][0]
    return ProductGroup([(factor, count or 1) for factor, count in factors])


def _make_factor(part: str, name: str, parameterization: str) -> tuple[Group, int | None]:
    match = _FACTOR.fullmatch(part)
    if match is None or (match[2] is None and match[1] != "none"):
        raise ValueError(f"group: expected {_LEGAL}; found {name!r}")
    kind, n, count = match[1], int(match[2] or NO_GROUP_SIZE), int(match[3]) if match[3] else None
    if n < (2 if kind == "SO" else 1) or count == 0:
        raise ValueError(f"group: expected {_LEGAL}; found {name!r}, whose n or number of blocks is too small")
    makers: dict[str, Callable[[], Group]] = {
        "GL": lambda: GL(n),
        "SE": lambda: SE(n, parameterization),
        "SO": lambda: SO(n, parameterization),
        "T": lambda: T(n),
        "none": lambda: NoGroup(n),
    }
    return makers[kind](), count
