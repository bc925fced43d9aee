"""Figures, at 6×4 inches. They need no display, and do not use matplotlib's ``pyplot``, so they need not be closed."""

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import ArrayLike

from sb3_eqr.common.groups import SO, Group
from sb3_eqr.common.off_policy import EqROffPolicy
from sb3_eqr.common.saving.files import atomic_write
from sb3_eqr.plot_style import COLORS, GREY, LINES, MARKERS, styled
from sb3_eqr.visualize.diagnostics import Diagnostics
from sb3_eqr.visualize.findings import Generators
from sb3_eqr.visualize.latents import each_block, frame, names_of_factors
from sb3_eqr.visualize.measures import ROUNDING, Transition

SIZE, DPI = (6.0, 4.0), 150  # SIZE: inches
MAX_PANELS, MAX_POINTS, MAX_ARROWS = 12, 400, 150  # of the latent states; MAX_PANELS also of the generators
ABOUT = "A point per state: a block's translation, an arrow for its rotation, or its principal components."
MAX_COORDINATES = 6  # of a block, in one panel
MAX_NUMBERS, MAX_NUMBER_COLUMNS = 36, 6  # printed in a heat map; with more columns, the numbers would overlap
PLAIN = FuncFormatter(lambda value, _: f"{value:g}")  # instead of powers of ten
COORDINATES = {"angle": "angle in a plane (radians)", "a": "matrix entry a", "t": "translation t", "x": "entry x"}
MAX_LETTERS = 72  # of horizontal tick labels at the bottom of a figure


def all_pictures(diagnostics: Diagnostics, actions: Sequence[str], factors: Sequence[str] = ()) -> dict[str, Figure]:
    """
    :param diagnostics: see :func:`~sb3_eqr.visualize.diagnostics.diagnose`
    :param actions: names of the actions, (A,)
    :param factors: names of the true factors, (F,), if known
    :return: name of the file without suffix -> figure; those that say nothing about this agent are left out
    """
    with styled():
        figures = {"transition": transition_figure(diagnostics), "collapse": spectrum_figure(diagnostics)}
        if diagnostics.has_group:
            figures["motion"] = motion_figure(diagnostics, actions)
            figures["generators"] = generators_figure(diagnostics, actions)
        if diagnostics.compares_blocks:
            figures["disentanglement"] = disentanglement_figure(diagnostics, factors)
        if diagnostics.rewards_trained and not np.isnan(diagnostics.rewards.explained).all():  # NaN if rewards do not vary
            figures["rewards"] = rewards_figure(diagnostics)
        return figures


def write_pictures(figures: dict[str, Figure], folder: pathlib.Path) -> None:
    """Write each figure as PNG, to a temporary file that is renamed."""
    for name, figure in figures.items():
        with atomic_write(folder / f"{name}.png", "png") as file, styled():
            figure.savefig(file, format="png", dpi=DPI, metadata={"Software": None})


def transition_figure(diagnostics: Diagnostics) -> Figure:
    """Errors of the rollout per step ahead, compared with those of shuffled targets and of no motion."""
    figure = Figure(figsize=SIZE, layout="constrained")
    left, right = figure.subplots(1, 2)
    _errors(left, diagnostics.transition, "of latent states x̂, x")
    _errors(right, diagnostics.loss, "of unit vectors p(x̂), p(x), as trained")
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    left.set_ylabel("mean squared distance")
    figure.suptitle(f"Errors of the prediction (verdict, from the right panel: {diagnostics.verdict})", fontsize=10)
    return figure


def _errors(ax: Axes, errors: Transition, title: str) -> None:
    named = {"predicted": errors.error, "shuffled targets": errors.shuffled, "no motion": errors.still}
    _lines(ax, named)
    ax.set_title(title, loc="left")
    if max(np.nanmax(values, initial=0) for values in named.values()) > 0:
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter(PLAIN)
        ax.yaxis.set_minor_formatter(NullFormatter())
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5), numticks=12))


def _lines(ax: Axes, named: dict[str, np.ndarray]) -> None:
    for i, (name, values) in enumerate(named.items()):
        steps = np.arange(1, len(values) + 1)
        ax.plot(steps, values, color=COLORS[i], linestyle=LINES[i], marker=MARKERS[i], label=name)
    ax.set_xlabel("steps ahead")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=6))


def motion_figure(diagnostics: Diagnostics, actions: Sequence[str]) -> Figure:
    """How far each action moves each block: as predicted in every state, and as observed where it was taken."""
    figure = Figure(figsize=SIZE, layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    top = max(np.nanmax(values, initial=0) for values in diagnostics.motion) or 1.0  # one scale for both
    for ax, values, title in zip(axes, diagnostics.motion, ("predicted", "observed"), strict=True):
        image = _heat_map(ax, values, f"{title} motion", top)
        _block_ticks(ax, diagnostics.blocks)
    axes[0].set_yticks(range(len(actions)), actions, fontsize=8 if len(actions) < 12 else 6)
    axes[0].set_ylabel("action")
    label = "mean distance that an action moves a block (grey: the action was not played)"
    figure.colorbar(image, ax=axes, location="bottom", shrink=0.9, aspect=60, label=label)
    return figure


def _heat_map(ax: Axes, values: np.ndarray, title: str, top: float) -> AxesImage:
    ax.set_facecolor("#dddddd")  # for NaN
    image = ax.imshow(np.ma.masked_invalid(values), cmap="viridis", aspect="auto", interpolation="nearest", vmin=0, vmax=top)
    if values.size <= MAX_NUMBERS and values.shape[1] <= MAX_NUMBER_COLUMNS:
        for (row, column), value in np.ndenumerate(values):
            color = "white" if value < 0.6 * top else "black"
            ax.text(column, row, f"{value:.2g}", ha="center", va="center", color=color)
    ax.set_title(title, loc="left")
    return image


def _block_ticks(ax: Axes, blocks: Sequence[str]) -> None:
    shown = range(0, len(blocks), -(-len(blocks) // 12))
    ax.set_xticks(shown, [str(k) for k in shown])
    groups = list(dict.fromkeys(block.rsplit(" ", 1)[0] for block in blocks))
    ax.set_xlabel(f"block ({', '.join(groups)})")


def generators_figure(diagnostics: Diagnostics, actions: Sequence[str]) -> Figure:
    """A panel per block: the coordinates of κ(x, a) for every action, mean and standard deviation over states."""
    shown, part_of_all = _largest(diagnostics.motion.predicted.sum(axis=0), "it moves most")
    places = [(part, k) for part in diagnostics.generators for k in range(part.mean.shape[1])]
    figure = Figure(figsize=SIZE, layout="constrained")
    axes = make_axes(figure, len(shown), sharey=True)
    drawn: dict[str, Any] = {}
    for ax, block in zip(axes, shown, strict=True):
        _generator(ax, *places[block], drawn)
        ax.set_title(diagnostics.blocks[block], loc="left", pad=2)
        ax.set_xticks(range(len(actions)), [])
    labels = actions if len(actions) <= 6 else [str(a) for a in range(len(actions))]
    upright = max(map(len, labels)) * len(labels) * n_columns(len(axes)) > MAX_LETTERS
    for ax in axes[-n_columns(len(axes)) :]:
        ax.set_xlabel("action")
        ax.set_xticks(range(len(actions)), labels, rotation=90 if upright else 0, fontsize=7 if len(actions) <= 9 else 5)
    figure.legend(drawn.values(), drawn.keys(), loc="outside lower center", ncols=len(drawn) if len(drawn) < 5 else 3)
    kinds = {name.split(" ")[0] for part in diagnostics.generators for name in part.names}
    figure.supylabel("coordinate: " + ", ".join(text for kind, text in COORDINATES.items() if kind in kinds), fontsize=9)
    figure.suptitle(f"What each action does: coordinates of κ(x, a){part_of_all}", fontsize=10)
    return figure


def _generator(ax: Axes, part: Generators, k: int, drawn: dict[str, Any]) -> None:
    ax.axhline(0, color=GREY, linewidth=0.6)
    ax.set_xlim(-0.6, len(part.mean) - 0.4)
    largest = np.argsort(-np.abs(part.mean[:, k]).sum(axis=0), kind="stable")[:MAX_COORDINATES]
    for i, c in enumerate(sorted(largest)):
        shift = (i - (len(largest) - 1) / 2) * 0.6 / max(len(largest), 2)  # so that bars do not hide each other
        same = len(largest) == len(part.names) or part.mean.shape[1] == 1  # coordinates in all panels
        name = part.names[c] if same else f"{i + 1} of the {MAX_COORDINATES} largest"
        style = (list(drawn).index(name) if name in drawn else len(drawn)) % len(MARKERS)  # the same in all panels
        x, looks = np.arange(len(part.mean)) + shift, {"color": COLORS[style], "markersize": 3, "elinewidth": 1}
        bars = ax.errorbar(x, part.mean[:, k, c], part.std[:, k, c], fmt=MARKERS[style], **looks)  # type: ignore[arg-type]
        drawn.setdefault(name, bars)


def disentanglement_figure(diagnostics: Diagnostics, factors: Sequence[str] = ()) -> Figure:
    """Correlation between blocks and, if the true factors are known, each block's information about them."""
    found = diagnostics.disentanglement
    figure = Figure(figsize=SIZE, layout="constrained")
    axes = figure.subplots(1, 1 if found.information is None else 2, squeeze=False)[0]
    image = _heat_map(axes[0], found.redundancy, "correlation between blocks", 1)
    _block_ticks(axes[0], diagnostics.blocks)
    axes[0].set_yticks(axes[0].get_xticks())
    axes[0].set_ylabel("block")
    if found.information is not None:
        _heat_map(axes[1], found.information.T, "information about true factors", 1)
        _block_ticks(axes[1], diagnostics.blocks)
        n_factors = found.information.shape[1]
        axes[1].set_yticks(range(n_factors), names_of_factors(n_factors, factors))
    label = "0: independent, 1: one determines the other"
    figure.colorbar(image, ax=axes, location="bottom", shrink=0.9, aspect=60, label=label)
    return figure


def spectrum_figure(diagnostics: Diagnostics) -> Figure:
    """Standard deviations of the states along their principal axes."""
    found = diagnostics.collapse
    figure = Figure(figsize=SIZE, layout="constrained")
    ax = figure.subplots()
    seen = found.spectrum[found.spectrum > found.spectrum[0] * ROUNDING]  # the rest is rounding
    seen = seen if len(seen) else found.spectrum
    ax.plot(np.arange(1, len(seen) + 1), seen, color=COLORS[0], marker="o", markersize=3, linewidth=1)
    label = f"effective rank {found.effective_rank:.1f} of {found.dimensions}"
    ax.axvline(found.effective_rank, color=COLORS[1], linestyle="--", label=label)
    more = len(found.spectrum) - len(seen)
    ax.set(xlabel=f"principal axis{f' ({more} more are 0 up to rounding)' if more else ''}", ylabel="standard deviation")
    ax.set_xlim(0, len(seen) + 1)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    if seen[0] > 0:
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter(PLAIN)
        ax.set_ylim(seen[-1] / 2, 2 * seen[0])
    ax.legend()
    title = f"Spectrum of the latent states, whose spread is {found.spread:.1%} of their size;\n{found.dead_units:.0%} of the "
    title += f"trunk's {found.n_units} units are constant (dead), {found.dormant_units:.0%} nearly 0 (dormant)"
    ax.set_title(title, loc="left")
    return figure


def rewards_figure(diagnostics: Diagnostics) -> Figure:
    """Error of the predicted reward per step ahead, compared with that of the mean reward."""
    found = diagnostics.rewards
    figure = Figure(figsize=SIZE, layout="constrained")
    left, right = figure.subplots(1, 2)
    _lines(left, {"predicted": found.error, "mean reward": found.constant})
    left.set_title("mean squared error", loc="left")
    left.set_ylim(bottom=0)
    left.legend()
    _lines(right, {"explained": found.explained})
    right.axhline(0, color=GREY, linewidth=0.6)
    right.set_title("explained variance (1: exact)", loc="left")
    figure.suptitle("Reward prediction", fontsize=10)
    return figure


def latent_figure(
    model: EqROffPolicy, states: th.Tensor, values: np.ndarray | None = None, label: str = "time", period: float | None = None
) -> Figure:
    """
    A panel per block, for at most the 12 that vary most. SO(2) is a point on the circle (the image of the vector (1, 0), as in
    Figure 3 of the paper); SE(2) and T(2) are points in the plane, with the direction of any rotation; a single number is
    plotted over the windows; anything else is projected to its first two principal components.

    :param model: the agent
    :param states: see :func:`~sb3_eqr.visualize.latents.encode`, (N, D)
    :param values: values for the colours, (N,); default: the order of the states
    :param label: label of the colours
    :param period: of the values, if they are periodic: values that differ by it get the same colour
    """
    kept = np.unique(np.linspace(0, len(states) - 1, min(len(states), MAX_POINTS)).astype(int))
    colours = (np.arange(len(states)) if values is None else np.asarray(values))[kept]
    chosen = states[th.as_tensor(kept, device=states.device)].cpu()
    blocks = each_block(model, chosen)
    spreads = np.array([float(found.flatten(1).double().std(dim=0, correction=0).norm()) for *_, found in blocks])
    shown, part_of_all = _largest(spreads, "that vary most")
    with styled():
        figure = Figure(figsize=SIZE)  # a constrained layout would take longer than the drawing itself
        axes = make_axes(figure, len(shown))
        for ax, i in zip(axes, shown, strict=True):
            name, group, found = blocks[i]
            constant = spreads[i] <= ROUNDING * float(found.norm()) / len(found) ** 0.5
            drawn = _draw(ax, group, found, colours, period)
            about = " (constant)" if constant else _outside(ax, drawn.get_offsets())
            ax.set_title(f"{name}{about}", loc="left", fontsize=8, pad=3)
            ax.tick_params(labelsize=6, length=2, pad=1)
        figure.subplots_adjust(left=0.07, right=0.85, bottom=0.07, top=0.87, wspace=0.35, hspace=0.45)
        label = "time (steps)" if label == "time" else label
        figure.colorbar(drawn, cax=figure.add_axes((0.88, 0.12, 0.02, 0.7)), label=label)
        figure.suptitle(f"Latent states{part_of_all}", fontsize=10)
        figure.text(0.46, 0.005, ABOUT, ha="center", fontsize=7, color=GREY)
        return figure


def _largest(sizes: np.ndarray, which: str) -> tuple[list[int], str]:
    """The indices of the blocks with a panel, and the end of the title, given the size of each block, (K,)."""
    shown = sorted(np.argsort(-sizes, kind="stable")[:MAX_PANELS].tolist())
    return shown, "" if len(shown) == len(sizes) else f" ({len(shown)} of {len(sizes)} blocks, those {which})"


def n_columns(count: int) -> int:
    """Number of columns for a number of panels."""
    return 4 if count > 4 else min(count, 2)


def make_axes(figure: Figure, count: int, sharey: bool = False) -> list[Axes]:
    """A number of axes, in rows of at most four."""
    columns = n_columns(count)
    axes = figure.subplots(-(-count // columns), columns, squeeze=False, sharey=sharey).flatten().tolist()
    for unused in axes[count:]:
        unused.remove()
    return axes[:count]


def _draw(ax: Axes, group: Group, elements: th.Tensor, colours: np.ndarray, period: float | None) -> PathCollection:
    """Draw the elements of one block, (n, *element_shape), in colours, (n,); returns the points, for the colour bar."""
    low, high, cmap = float(colours.min()), float(colours.max()), "viridis" if period is None else "twilight"
    if period is not None:
        low, high = (low + high - period) / 2, (low + high + period) / 2
    matrix, vector = frame(group, elements)
    if isinstance(group, SO) and group.n == 2:
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
    else:  # the first two principal components
        x = elements.flatten(1).double()
        left, values, _ = th.linalg.svd(x - x.mean(dim=0), full_matrices=False)
        points = (left[:, :2] * values[:2]).numpy()
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
    low, high = np.transpose([ax.get_xlim(), ax.get_ylim()])
    count = int(((np.asarray(points) < low) | (np.asarray(points) > high)).any(axis=1).sum())
    return f" ({count} outside)" if count else ""
