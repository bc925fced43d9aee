"""A scatter plot of the blocks of latent states, fast enough to draw during training."""

from typing import Any

import numpy as np
import torch as th
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from sb3_eqr.common.eqr_algorithm import EqRAlgorithm
from sb3_eqr.common.groups import SO, Group
from sb3_eqr.plot_style import GREY, styled
from sb3_eqr.visualize.latents import frame, split
from sb3_eqr.visualize.measures import ROUNDING

SIZE = (6.0, 4.0)  # inches, for all figures
MAX_PANELS = 12
MAX_POINTS = 400
MAX_ARROWS = 150
ABOUT = "A point per state: a block's translation, an arrow for its rotation, or its principal components."


def latent_figure(
    model: EqRAlgorithm,
    states: th.Tensor,
    values: np.ndarray | None = None,
    label: str = "time",
    is_periodic: bool = False,
) -> Figure:
    """
    A panel per block, for at most the 12 that vary most. SO(2) is a point on the circle (the image of the vector (1, 0), as in
    Figure 3 of the paper); SE(2) and T(2) are points in the plane, with the direction of any rotation; a single number is
    plotted over the windows; anything else is projected to its first two principal components.

    :param model: the agent
    :param states: see :func:`~sb3_eqr.visualize.latents.encode`, (N, D)
    :param values: values for the colours, (N,); default: the order of the states
    :param label: label of the colours
    :param is_periodic: whether the smallest and the largest of the values are the same, so that they get the same colour
    """
    kept = np.unique(np.linspace(0, len(states) - 1, min(len(states), MAX_POINTS)).astype(int))
    colours = (np.arange(len(states)) if values is None else np.asarray(values))[kept]
    chosen = states[th.as_tensor(kept, device=states.device)].cpu()
    blocks = [
        (group, f"{group} {i}", found[:, i]) for group, found in split(model, chosen) for i in range(_count(group, found))
    ]
    spreads = np.array([float(found.flatten(1).double().std(dim=0, correction=0).norm()) for _, _, found in blocks])
    shown = sorted(np.argsort(-spreads, kind="stable")[:MAX_PANELS])
    with styled():
        figure = Figure(figsize=SIZE)  # a constrained layout would take longer than the drawing itself
        axes = make_axes(figure, len(shown))
        for ax, i in zip(axes, shown, strict=True):
            group, name, found = blocks[i]
            constant = spreads[i] <= ROUNDING * float(found.norm()) / len(found) ** 0.5
            drawn = _draw(ax, group, found, colours, "twilight" if is_periodic else "viridis")
            about = " (constant)" if constant else _outside(ax, drawn.get_offsets())
            ax.set_title(f"{name}{about}", loc="left", fontsize=8, pad=3)
            ax.tick_params(labelsize=6, length=2, pad=1)
        figure.subplots_adjust(left=0.07, right=0.85, bottom=0.07, top=0.87, wspace=0.35, hspace=0.45)
        bar = figure.colorbar(drawn, cax=figure.add_axes((0.88, 0.12, 0.02, 0.7)))
        bar.set_label("time (steps)" if label == "time" else label)
        of_all = "" if len(shown) == len(blocks) else f" ({len(shown)} of {len(blocks)} blocks, those that vary most)"
        figure.suptitle(f"Latent states{of_all}", fontsize=10)
        figure.text(0.46, 0.005, ABOUT, ha="center", fontsize=7, color=GREY)
        return figure


def n_columns(count: int) -> int:
    """:param count: number of panels"""
    return 4 if count > 4 else min(count, 2)


def make_axes(figure: Figure, count: int, sharey: bool = False) -> list[Axes]:
    """:return: ``count`` axes, in rows of at most four"""
    columns = n_columns(count)
    rows = -(-count // columns)
    axes = figure.subplots(rows, columns, squeeze=False, sharey=sharey).flatten().tolist()
    for unused in axes[count:]:
        unused.remove()
    return axes[:count]


def _draw(ax: Axes, group: Group, elements: th.Tensor, colours: np.ndarray, cmap: str) -> PathCollection:
    """
    :param elements: elements of one block, (n, *element_shape)
    :param colours: (n,)
    :param cmap: matplotlib's name of the colour map
    :return: the points, for the colour bar
    """
    low, high = float(colours.min()), float(colours.max())
    matrix, vector = frame(group, elements)
    if isinstance(group, SO) and group.element_shape[0] == 2:
        turn = np.linspace(0, 2 * np.pi, 100)
        ax.plot(np.cos(turn), np.sin(turn), color=GREY, linewidth=0.5, zorder=0)
        points = elements[:, :, 0].numpy()
        ax.set(aspect="equal", xlim=(-1.2, 1.2), ylim=(-1.2, 1.2), xticks=(-1, 0, 1), yticks=(-1, 0, 1))
    elif vector is not None and vector.shape[-1] == 2:
        points = vector.numpy()
        if matrix is not None:
            few = slice(None, None, -(-len(points) // MAX_ARROWS))
            arrows = matrix[few, :, 0].numpy()
            looks: Any = {"clim": (low, high), "cmap": cmap, "width": 0.006, "scale": 10, "alpha": 0.6}
            ax.quiver(*points[few].T, *arrows.T, colours[few], **looks)
        _roomy(ax, points)
    elif elements[0].numel() == 1:
        points = np.stack([np.arange(len(elements)), elements.flatten().numpy()], axis=1)
    else:
        points = _principal(elements.flatten(1))
        _roomy(ax, points)
    return ax.scatter(points[:, 0], points[:, 1], c=colours, s=6, linewidths=0, vmin=low, vmax=high, cmap=cmap)


def _roomy(ax: Axes, points: np.ndarray) -> None:
    """Equal scales, without zooming in on rounding or out to an episode's few first states (the title counts them)."""
    low, high = np.percentile(points, (1, 99), axis=0)  # (2,) each
    middle = (low + high) / 2
    half = max(0.7 * float((high - low).max()), 1e-6 * float(np.abs(middle).max()), 1e-9)
    ax.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half), aspect="equal")
    ax.locator_params(axis="x", nbins=1)
    ax.locator_params(axis="y", nbins=2)


def _outside(ax: Axes, points: ArrayLike) -> str:
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    x, y = np.asarray(points).T
    count = int(((x < left) | (x > right) | (y < bottom) | (y > top)).sum())
    return f" ({count} outside)" if count else ""


def _principal(x: th.Tensor) -> np.ndarray:
    """
    :param x: (n, d), d ≥ 2
    :return: first two principal components, (n, 2)
    """
    x = x.double()
    left, values, _ = th.linalg.svd(x - x.mean(dim=0), full_matrices=False)
    return (left[:, :2] * values[:2]).numpy()


def _count(group: Group, found: th.Tensor) -> int:
    return found.shape[-1 - len(group.element_shape)]
