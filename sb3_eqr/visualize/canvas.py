"""Draw the frames of a video with matplotlib: the environment on the left, a panel per block on the right."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sb3_eqr.plot_style import GREY, INK, styled
from sb3_eqr.visualize.sketches import ROOM, Panel, Shape

WIDTH, HEIGHT = 900, 500  # pixels; even, as H.264 requires
DPI = 100
TRAIL = 12  # steps
NOW, PREDICTED = "#1446a0", "#f49840"
AXES = ("#c82828", "#1e8c32", "#1e50c8")  # x, y, z
PREDICTED_AXES = ("#f2b2b2", "#acdcb4", "#b2c6f4")


class Line(NamedTuple):
    """The line of text above a frame."""

    step: int
    action: str
    reward: float
    score: float


class Block:
    """
    One block in its panel: an arrow, axes or a parallelogram, a dot, and a triangle at the edge if it is beyond the edge.

    :param ax: axes with limits of ±1
    :param panel: panel of the block
    :param shape: the panel's true or predicted shape
    :param is_predicted: whether the shape is predicted, which is drawn differently
    """

    def __init__(self, ax: Axes, panel: Panel, shape: Shape, is_predicted: bool):
        color, width = (PREDICTED, 3) if is_predicted else (NOW, 1.5)
        self.shape = shape
        look: dict[str, Any] = {"mfc": "none"} if is_predicted else {}
        size = 7 if is_predicted else 4.5
        (self.dot,) = ax.plot([], [], "o", color=color, markersize=size, animated=True, **look)
        (self.beyond,) = ax.plot([], [], color=color, linestyle="", markersize=7, animated=True)
        (self.sides,) = ax.plot([], [], color=color, linewidth=width, animated=True)
        self.arrows: Any = None
        if shape.arrows is not None:
            n = shape.arrows.shape[1]
            colors = (PREDICTED_AXES if is_predicted else AXES)[:n] if panel.kind == "axes" else color
            placed: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1}
            zeros = np.zeros(n)
            self.arrows = ax.quiver(
                zeros, zeros, zeros, zeros, color=colors, width=0.026 if is_predicted else 0.018, animated=True, **placed
            )
        self.is_parallelogram = panel.kind == "parallelogram"

    def move(self, t: int) -> list[Artist]:
        """:return: the artists to draw at step t; none where the shape is NaN"""
        arrows, foot = (None if part is None else part[t] for part in self.shape)
        if not all(part is None or np.isfinite(part).all() for part in (arrows, foot)):
            return []
        at = np.zeros(2) if foot is None else foot
        if np.abs(at).max() > 1:
            self.beyond.set_data(*(0.95 * at / np.abs(at).max())[:, None])
            self.beyond.set_marker((3, 0, round(np.degrees(np.arctan2(at[1], at[0]))) - 90))  # a triangle, its tip outwards
            return [self.beyond]
        drawn: list[Artist] = []
        if arrows is not None:
            self.arrows.set_offsets(np.repeat(at[None], len(arrows), axis=0))
            self.arrows.set_UVC(*arrows.T)
            drawn.append(self.arrows)
        if arrows is not None and self.is_parallelogram:
            self.sides.set_data(*np.stack([at, at + arrows[0], at + arrows[0] + arrows[1], at + arrows[1], at]).T)
            drawn.append(self.sides)
        if foot is not None:
            self.dot.set_data(*foot[:, None])
            drawn.append(self.dot)
        return drawn


class Painter:
    """
    Draws the frames of one video.

    :param panels: one per block
    :param starts: the frame at which each frame's episode began, (T,)
    :param depth: M, for the legend
    :param about: description of the agent, at the bottom
    """

    def __init__(self, panels: Sequence[Panel], starts: np.ndarray, depth: int, about: str):
        self.panels, self.starts = panels, starts
        n = len(panels)
        columns = max(range(1, n + 1), key=lambda columns: min(1.3 / columns, 1 / -(-n // columns)))  # the largest squares
        rows = -(-n // columns)
        with styled():
            self.figure = Figure((WIDTH / DPI, HEIGHT / DPI), dpi=DPI)
            self.canvas = FigureCanvasAgg(self.figure)
            self.game = self.figure.add_axes((0.01, 0.08, 0.37, 0.84))
            self.game.set_axis_off()
            side = min(0.59 * WIDTH / columns, 0.82 * HEIGHT / rows)  # of a panel, in pixels
            x, y = columns * side / WIDTH / 2, rows * side / HEIGHT / 2  # half of all panels, as fractions of the frame
            ends = {"left": 0.695 - x, "right": 0.695 + x, "bottom": 0.51 - y, "top": 0.51 + y}
            grid = self.figure.add_gridspec(rows, columns, wspace=0.05, hspace=0.05, **ends)
            self.axes = [
                self._panel(self.figure.add_subplot(grid[k // columns, k % columns]), p) for k, p in enumerate(panels)
            ]
            self.blocks = [
                (Block(ax, panel, panel.ghost, is_predicted=True), Block(ax, panel, panel.truth, is_predicted=False))
                for ax, panel in zip(self.axes, panels, strict=True)
            ]
            self.trails = [ax.plot([], [], color=NOW, alpha=0.35, linewidth=1, animated=True)[0] for ax in self.axes]
            self.title = self.figure.text(0.012, 0.95, "", fontsize=11, color=INK, animated=True, family="monospace")
            self.figure.text(0.012, 0.025, about[:60], color=GREY, fontsize=8)
            self._legend(depth)
        self.picture: Any = None
        self.canvas.draw()
        self.ground = self.canvas.copy_from_bbox(self.figure.bbox)  # type: ignore[attr-defined]

    def _panel(self, ax: Axes, panel: Panel) -> Axes:
        ax.set(xlim=(-1, 1), ylim=(-1, 1), xticks=[], yticks=[], aspect="equal", facecolor="#f6f7f9")
        ax.spines[:].set(visible=True, color="#dadee3")
        if panel.truth.dots is None:
            ax.axhline(0, color="#dadee3", linewidth=1)
            ax.axvline(0, color="#dadee3", linewidth=1)
        if panel.kind == "arrow" and panel.truth.dots is None:  # a circle for the arrow's tip
            turn = np.linspace(0, 2 * np.pi, 100)
            ax.plot(ROOM * np.cos(turn), ROOM * np.sin(turn), color="#dadee3", linewidth=1)
        size = 8 if len(self.panels) < 13 else 6
        ax.text(-0.94, 0.94, panel.name, color=GREY, fontsize=size, va="top")
        if panel.half_width is not None:
            ax.text(0.94, -0.94, f"edge ±{panel.half_width:.2g}", color=GREY, fontsize=size, ha="right")
        return ax

    def _legend(self, depth: int) -> None:
        predicted = f"predicted {depth} step{'' if depth == 1 else 's'} before"
        dot: dict[str, Any] = {"marker": "o", "linestyle": ""}
        handles = [
            Line2D([], [], color=NOW, markersize=4.5, label="now", **dot),
            Line2D([], [], color=PREDICTED, markersize=7, mfc="none", label=predicted, **dot),
        ]
        if any(p.kind == "arrow" for p in self.panels):
            handles.append(Line2D([], [], color=NOW, marker=r"$\rightarrow$", linestyle="", markersize=9, label="rotation"))
        if any(p.truth.dots is not None for p in self.panels):
            handles.append(Line2D([], [], color=NOW, alpha=0.35, label=f"last {TRAIL} steps"))
        if any(p.kind == "axes" for p in self.panels):
            handles += [Line2D([], [], color=color, label=name) for name, color in zip("xyz", AXES, strict=True)]
            handles.append(Line2D([], [], color=PREDICTED_AXES[0], label="pale: predicted"))
        if any(p.ghost.dots is not None and (np.abs(p.ghost.dots) > 1).any() for p in self.panels):
            handles.append(Line2D([], [], color=PREDICTED, marker="^", linestyle="", label="beyond the edge"))
        self.figure.legend(handles=handles, loc="lower right", ncols=len(handles), fontsize=8, handlelength=1.5)

    def paint(self, t: int, picture: np.ndarray, line: Line) -> np.ndarray:
        """
        :param t: index of the step
        :param picture: the environment's image, (height, width, 3), uint8
        :param line: content of the title
        :return: (HEIGHT, WIDTH, 3), uint8
        """
        self.canvas.restore_region(self.ground)  # type: ignore[attr-defined]
        if self.picture is None:  # small images are enlarged without smoothing
            smooth = "antialiased" if min(picture.shape[:2]) > 100 else "nearest"
            self.picture = self.game.imshow(picture, interpolation=smooth, animated=True)
            self.game.apply_aspect()
        self.picture.set_data(picture)
        self.game.draw_artist(self.picture)
        action = line.action[:14]
        self.title.set_text(f"step {line.step:<5d} {action:<14s} reward {line.reward:<+8.3g} score {line.score:<8.4g}")
        self.figure.draw_artist(self.title)
        first = max(int(self.starts[t]), t - TRAIL)
        for ax, panel, trail, blocks in zip(self.axes, self.panels, self.trails, self.blocks, strict=True):
            if panel.truth.dots is not None:
                trail.set_data(*panel.truth.dots[first : t + 1].T)
                ax.draw_artist(trail)
            for block in blocks:
                for artist in block.move(t):
                    ax.draw_artist(artist)
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()
