"""Products of different groups, and the table of group names."""

import re
from collections.abc import Callable, Sequence
from math import prod

import torch as th

from sb3_eqr.common.groups.base import Group
from sb3_eqr.common.groups.matrix import GL, ROTATIONS, SE, SO, NoGroup, T


class ProductGroup(Group):
    """
    The direct product of different groups, as one flat vector: the first factor's blocks, then the second's, and so on.

    :param factors: pairs of a group and its number of blocks
    """

    def __init__(self, factors: Sequence[tuple[Group, int]]):
        self.factors = list(factors)
        self.has_inverse = all(group.has_inverse for group, _ in self.factors)
        name = " x ".join(f"{group}^{count}" if count > 1 else f"{group}" for group, count in self.factors)
        sizes = ((count * group.num_params, count * prod(group.element_shape)) for group, count in self.factors)
        num_params, size = map(sum, zip(*sizes, strict=True))
        super().__init__(name, num_params, (size,))

    def element(self, params: th.Tensor) -> th.Tensor:
        pairs = zip(self.factors, self._split(params, [(group.num_params,) for group, _ in self.factors]), strict=True)
        return self._flatten(group.element(p) for (group, _), p in pairs)

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

    def _split(self, flat: th.Tensor, shapes: list[tuple[int, ...]]) -> list[th.Tensor]:
        shapes = [(count, *shape) for (_, count), shape in zip(self.factors, shapes, strict=True)]
        pieces = flat.split([prod(shape) for shape in shapes], dim=-1)
        return [piece.unflatten(-1, shape) for piece, shape in zip(pieces, shapes, strict=True)]

    def _unflatten(self, element: th.Tensor) -> list[th.Tensor]:
        return self._split(element, [group.element_shape for group, _ in self.factors])

    def _flatten(self, pieces) -> th.Tensor:
        pairs = zip(self.factors, pieces, strict=True)
        return th.cat([piece.flatten(-1 - len(group.element_shape)) for (group, _), piece in pairs], dim=-1)


_FACTOR = re.compile(r"(GL|SE|SO|T|none)(?:\((\d+)\))?(?:\^(\d+))?")
_LEGAL = "GL(n), SE(n), T(n) or SO(n) with a number for n, such as 'SE(2)', none, none(n), or a product such as "
_LEGAL += "'SE(2)^8 x SO(3)^4'"
NO_GROUP_SIZE = 512  # for "none" without a size: the features_dim of SB3's NatureCNN


def make_group(group: "str | Group", parameterization: str = "euler") -> Group:
    """
    Create a group from its name.

    :param group: "GL(n)", "SE(n)", "SO(n)", "T(n)", "none", or a product such as "SE(2)^8 x SO(3)^4";
        a :class:`Group` is returned unchanged
    :param parameterization: parameterization of the rotations in SO and SE: "euler" (product over planes, the default in the
        paper's experiments), "exp" (matrix exponential) or "gram-schmidt" (orthonormalised columns, without discontinuity)
    :return: the group
    :raises ValueError: if the name or size is invalid; the message lists the valid ones
    """
    if isinstance(group, Group):
        return group
    if not isinstance(group, str):
        raise ValueError(f"group must be {_LEGAL}, got {group!r}.")
    if parameterization not in ROTATIONS:
        raise ValueError(f"parameterization must be one of {list(ROTATIONS)}, got {parameterization!r}.")
    factors = [_make_factor(part, group, parameterization) for part in re.split(r"[x×]", group.replace(" ", ""))]
    if len(factors) == 1 and factors[0][1] is None:
        return factors[0][0]
    return ProductGroup([(factor, count or 1) for factor, count in factors])


def _make_factor(part: str, name: str, parameterization: str) -> tuple[Group, int | None]:
    match = _FACTOR.fullmatch(part)
    if match is None or (match[2] is None and match[1] != "none"):
        near = re.fullmatch(r"(GL|SE|SO|T)\(?(\d+)\)?", part.upper())
        raise ValueError(f"group must be {_LEGAL}, got {name!r}.{f' Did you mean {near[1]}({near[2]})?' if near else ''}")
    kind, n, count = match[1], int(match[2] or NO_GROUP_SIZE), int(match[3]) if match[3] else None
    if n < (2 if kind == "SO" else 1) or count == 0:
        raise ValueError(f"group must be {_LEGAL}, got {name!r}: n is at least 2 for SO, else 1, and the number of blocks 1.")
    kinds: dict[str, Callable[..., Group]] = {"GL": GL, "SE": SE, "SO": SO, "T": T, "none": NoGroup}
    return kinds[kind](n, *[parameterization] * (kind in ("SE", "SO"))), count
