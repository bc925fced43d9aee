"""
Figures of the diagnostics, at 6×4 inches. They need no display, and do not use matplotlib's ``pyplot``, so they need not be
closed.
"""

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from sb3_eqr.common.saving.files import atomic_write
from sb3_eqr.plot_style import COLORS, GREY, LINES, MARKERS, styled
from sb3_eqr.visualize.diagnostics import Diagnostics, Generators
from sb3_eqr.visualize.latent_figure import MAX_PANELS, SIZE, latent_figure, make_axes, n_columns
from sb3_eqr.visualize.measures import ROUNDING, Transition
from sb3_eqr.visualize.tables import factor_names

__all__ = ["all_pictures", "latent_figure", "write_pictures"]

DPI = 150
MAX_COORDINATES = 6  # of a block, in one panel
MAX_NUMBERS = 36  # printed in a heat map
MAX_NUMBER_COLUMNS = 6  # with more, the numbers would overlap
PLAIN = FuncFormatter(lambda value, _: f"{value:g}")  # instead of powers of ten
COORDINATES = {"angle": "angle in a plane (radians)", "a": "matrix entry a", "t": "translation t", "x": "entry x"}
MAX_LETTERS = 72  # of horizontal tick labels at the bottom of a figure


def all_pictures(diagnostics: Diagnostics, actions: Sequence[str], factors: Sequence[str] = ()) -> dict[str, Figure]:
    """
    :param diagnostics: see :func:`~sb3_eqr.visualize.diagnostics.diagnose`
    :param actions: names of the actions, (A,)
    :param factors: names of the true factors, (F,), if known
    :return: name of the file without suffix -> figure
    """
    with styled():
        return {
            "transition": transition_figure(diagnostics),
            "motion": motion_figure(diagnostics, actions),
            "generators": generators_figure(diagnostics, actions),
            "disentanglement": disentanglement_figure(diagnostics, factors),
            "collapse": spectrum_figure(diagnostics),
            **({"rewards": rewards_figure(diagnostics)} if has_rewards(diagnostics) else {}),
        }


def write_pictures(figures: dict[str, Figure], folder: pathlib.Path) -> None:
    """Write each figure as PNG, to a temporary file that is renamed."""
    for name, figure in figures.items():
        with atomic_write(folder / f"{name}.png", "png") as file, styled():
            figure.savefig(file, format="png", dpi=DPI, metadata={"Software": None})


def transition_figure(diagnostics: Diagnostics) -> Figure:
    """Errors of the rollout per step ahead, compared with those of shuffled targets and of standing still."""
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
    named = {"predicted": errors.error, "shuffled targets": errors.shuffled, "standing still": errors.still}
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
    bar = figure.colorbar(image, ax=axes, location="bottom", shrink=0.9, aspect=60)
    bar.set_label("mean distance that an action moves a block (grey: the action was not played)")
    return figure


def _heat_map(ax: Axes, values: np.ndarray, title: str, top: float) -> AxesImage:
    ax.set_facecolor("#dddddd")  # for NaN
    image = ax.imshow(np.ma.masked_invalid(values), cmap="viridis", aspect="auto", interpolation="nearest", vmin=0, vmax=top)
    if values.size <= MAX_NUMBERS and values.shape[1] <= MAX_NUMBER_COLUMNS:
        for (row, column), value in np.ndenumerate(values):
            dark = value < 0.6 * top
            ax.text(column, row, f"{value:.2g}", ha="center", va="center", color="white" if dark else "black")
    ax.set_title(title, loc="left")
    return image


def _block_ticks(ax: Axes, blocks: Sequence[str]) -> None:
    every = -(-len(blocks) // 12)
    ax.set_xticks(range(0, len(blocks), every), [str(k) for k in range(0, len(blocks), every)])
    groups = list(dict.fromkeys(block.rsplit(" ", 1)[0] for block in blocks))
    ax.set_xlabel(f"block ({', '.join(groups)})")


def generators_figure(diagnostics: Diagnostics, actions: Sequence[str]) -> Figure:
    """A panel per block: the coordinates of κ(x, a) for every action, mean and standard deviation over states."""
    motion = diagnostics.motion.predicted.sum(axis=0)  # (K,)
    shown = sorted(np.argsort(-motion, kind="stable")[:MAX_PANELS])
    places = [(part, k) for part in diagnostics.generators for k in range(part.mean.shape[1])]
    figure = Figure(figsize=SIZE, layout="constrained")
    axes = make_axes(figure, len(shown), sharey=True)
    drawn: dict[str, Any] = {}
    for ax, block in zip(axes, shown, strict=True):
        part, k = places[block]
        _generator(ax, part, k, drawn)
        ax.set_title(diagnostics.blocks[block], loc="left", pad=2)
        ax.set_xticks(range(len(actions)), [])
    for ax in axes[-n_columns(len(axes)) :]:
        labels = actions if len(actions) <= 6 else [str(a) for a in range(len(actions))]
        upright = max(map(len, labels)) * len(labels) * n_columns(len(axes)) > MAX_LETTERS
        ax.set_xlabel("action")
        ax.set_xticks(range(len(actions)), labels, rotation=90 if upright else 0, fontsize=7 if len(actions) <= 9 else 5)
    figure.legend(drawn.values(), drawn.keys(), loc="outside lower center", ncols=len(drawn) if len(drawn) < 5 else 3)
    kinds = {name.split(" ")[0] for part in diagnostics.generators for name in part.names}
    figure.supylabel("coordinate: " + ", ".join(text for kind, text in COORDINATES.items() if kind in kinds), fontsize=9)
    part_of_all = "" if len(shown) == len(places) else f" ({len(shown)} of {len(places)} blocks, those it moves most)"
    figure.suptitle(f"What each action does: coordinates of κ(x, a){part_of_all}", fontsize=10)
    return figure


def _generator(ax: Axes, part: Generators, k: int, drawn: dict[str, Any]) -> None:
    ax.axhline(0, color=GREY, linewidth=0.6)
    ax.set_xlim(-0.6, len(part.mean) - 0.4)
    largest = np.argsort(-np.abs(part.mean[:, k]).sum(axis=0), kind="stable")[:MAX_COORDINATES]
    for i, c in enumerate(sorted(largest)):
        shift = (i - (len(largest) - 1) / 2) * 0.6 / max(len(largest), 2)  # so that bars do not hide each other
        name = part.names[c] if len(largest) == len(part.names) else f"coordinate {i + 1} of {MAX_COORDINATES}"
        x, looks = np.arange(len(part.mean)) + shift, {"color": COLORS[i], "markersize": 3, "elinewidth": 1}
        bars = ax.errorbar(x, part.mean[:, k, c], part.std[:, k, c], fmt=MARKERS[i], **looks)  # type: ignore[arg-type]
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
        names = factor_names(found.information.shape[1], factors)
        _heat_map(axes[1], found.information.T, "information about true factors", 1)
        _block_ticks(axes[1], diagnostics.blocks)
        axes[1].set_yticks(range(len(names)), names)
    bar = figure.colorbar(image, ax=axes, location="bottom", shrink=0.9, aspect=60)
    bar.set_label("0: independent, 1: one determines the other")
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
    units = f"{found.dead_units:.0%} of the trunk's {found.n_units} units are constant (dead)"
    ax.set_title(
        f"Spectrum of the latent states, whose spread is {found.spread:.1%} of their size;\n"
        f"{units}, {found.dormant_units:.0%} nearly 0 (dormant)",
        loc="left",
    )
    return figure


def has_rewards(diagnostics: Diagnostics) -> bool:
    """:return: whether the reward predictor was trained and rewards vary"""
    return diagnostics.rewards_trained and not np.isnan(diagnostics.rewards.explained).all()


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
