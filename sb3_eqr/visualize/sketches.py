"""Convert blocks of latent states to coordinates in a square panel, without drawing."""

from typing import NamedTuple

import numpy as np
import torch as th

from sb3_eqr.common.eqr_algorithm import EqRAlgorithm
from sb3_eqr.common.groups import SE, SO, Group, NoGroup
from sb3_eqr.visualize.latents import frame, split

ARROW = 0.4  # length of a unit arrow that starts at a dot, in half panels
ROOM = 0.85  # the largest coordinate, in half panels
GHOST_ROOM = 3.0  # a panel grows for its predictions, up to this multiple of what the true states need
# Projection of three dimensions: from 60° to the left and 25° above, as in matplotlib. (3, 2)
VIEW = np.array([[0.866, -0.211], [0.5, 0.366], [0.0, 0.906]])


class Shape(NamedTuple):
    """A block at T steps, in units of the panel: edges at ±1, x to the right, y up. NaN where there is no prediction."""

    arrows: np.ndarray | None  # (T, A, 2): images of the unit vectors, relative to the dot
    dots: np.ndarray | None  # (T, 2): translation


class Panel(NamedTuple):
    """One block over the full video, in constant units."""

    name: str
    kind: str  # "arrow", "parallelogram", "axes", or "dot" if there is no rotation
    truth: Shape
    ghost: Shape
    half_width: float | None  # of the panel, in latent units; None if lengths are meaningless


def panels(model: EqRAlgorithm, states: th.Tensor, ghosts: th.Tensor, limit: int) -> list[Panel]:
    """
    :param model: the agent
    :param states: x₀ at T steps, (T, D)
    :param ghosts: predictions of them, (T, D); NaN where there is none
    :param limit: maximum number of blocks
    :return: one panel per block, in order
    """
    found: list[Panel] = []
    several = len(split(model, states)) > 1
    for (group, truth), (_, ghost) in zip(split(model, states.cpu()), split(model, ghosts.cpu()), strict=True):
        for k in range(min(truth.shape[1], limit - len(found))):
            name = f"{len(found)} {group}" if several else f"{len(found)}"
            found.append(panel(name, group, truth[:, k], ghost[:, k]))
    return found


def panel(name: str, group: Group, truth: th.Tensor, ghost: th.Tensor) -> Panel:
    """
    :param name: name of the block
    :param group: group of the block
    :param truth: (T, *element_shape)
    :param ghost: (T, *element_shape)
    """
    axes = _principal_axes(truth) if isinstance(group, NoGroup) and truth.shape[1] > 2 else None
    shapes = [in_plane(group, elements, axes) for elements in (truth, ghost)]
    (arrows, dots), (ghost_arrows, ghost_dots) = shapes
    rotation = isinstance(group, (SO, SE))
    kind = "dot" if arrows is None else ["arrow", "parallelogram", "axes"][arrows.shape[1] - 1]
    arrow_scale, dot_scale, centre, half_width = 1.0, 1.0, np.zeros(2), None
    if arrows is not None:
        assert ghost_arrows is not None
        longest = 1.0 if rotation else _extent(np.abs(arrows), np.abs(ghost_arrows))
        arrow_scale = (ROOM if dots is None else ARROW) / longest
        half_width = None if rotation else 1 / arrow_scale
    if dots is not None:
        assert ghost_dots is not None
        centre = (dots.min(axis=0) + dots.max(axis=0)) / 2
        room = ROOM if arrows is None else 1 - ARROW  # leaves space for an arrow at the outermost dot
        half_width = _extent(np.abs(dots - centre), np.abs(ghost_dots - centre)) / room
        dot_scale = 1 / half_width
    scaled = [
        Shape(
            None if shape.arrows is None else shape.arrows * arrow_scale,
            None if shape.dots is None else (shape.dots - centre) * dot_scale,
        )
        for shape in shapes
    ]
    return Panel(name, kind, scaled[0], scaled[1], half_width)


def in_plane(group: Group, elements: th.Tensor, axes: tuple[np.ndarray, np.ndarray] | None = None) -> Shape:
    """
    Elements as arrows and dots, in latent units. A rotation of the plane is one arrow, its first column; any other 2×2 matrix
    is both columns; three dimensions are projected; of more dimensions only the first two coordinates are shown.

    :param group: group of the elements
    :param elements: (T, *element_shape)
    :param axes: mean, (n,), and two directions, (n, 2), to project a vector onto
    """
    matrix, vector = frame(group, elements)
    arrows = dots = None
    if matrix is not None and not (isinstance(group, SE) and matrix.shape[-1] == 1):  # no rotation in one dimension
        columns = matrix.mT.double().numpy()  # (T, n, n): row i is the image of the i-th unit vector
        arrows = _seen(columns)[:, : 1 if isinstance(group, (SO, SE)) and columns.shape[-1] == 2 else 3]
    if vector is not None:
        values = vector.double().numpy()
        dots = _seen(values) if axes is None else (values - axes[0]) @ axes[1]
    return Shape(arrows, dots)


def _seen(vectors: np.ndarray) -> np.ndarray:
    """(..., n) -> (..., 2)"""
    n = vectors.shape[-1]
    if n == 1:
        return np.concatenate([vectors, 0 * vectors], axis=-1)
    return vectors @ VIEW if n == 3 else vectors[..., :2]


def _principal_axes(vectors: th.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """
    :param vectors: (T, n)
    :return: their mean, (n,), and their first two principal axes, (n, 2), the largest entry of each positive
    """
    values = vectors.double().numpy()
    mean = values.mean(axis=0)
    axes = np.linalg.svd(values - mean, full_matrices=False)[2][:2].T
    return mean, axes * np.sign(axes[np.abs(axes).argmax(axis=0), [0, 1]])


def _extent(truth: np.ndarray, ghost: np.ndarray) -> float:
    """:return: the half width that the true states need, or 98 % of the predictions, unless these are too far out"""
    needed = max(float(truth.max()), 1e-6)
    found = ghost[np.isfinite(ghost)]
    wanted = float(np.quantile(found, 0.98)) if len(found) > 0 else 0.0
    return max(needed, wanted) if wanted <= GHOST_ROOM * needed else needed
