"""Drawing with Pillow alone: hundreds of frames in seconds, the same on every machine and matplotlib backend."""

import pathlib
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from sb3_eqr.visualize.sketches import ROOM, Panel, Shape

WIDTH, HEIGHT = 900, 500  # even: H.264 asks for it
TITLE, FOOTER, LEFT, GAP = 34, 28, 356, 6
SMOOTH = 2  # drawn so many times as large and shrunk
TRAIL = 12  # steps

Colour = tuple[int, int, int]
PAPER: Colour = (255, 255, 255)
PANEL: Colour = (246, 247, 249)
LINE: Colour = (218, 222, 227)
INK: Colour = (33, 37, 41)
FAINT: Colour = (112, 120, 128)
BLUE: Colour = (20, 70, 160)
AXES: tuple[Colour, ...] = ((200, 40, 40), (30, 140, 50), (30, 80, 200))  # x, y, z
GHOST: Colour = (244, 152, 64)
GHOST_AXES: tuple[Colour, ...] = ((242, 178, 178), (172, 220, 180), (178, 198, 244))


class Line(NamedTuple):
    """What is said above a frame."""

    step: int
    action: str
    reward: float
    score: float


@cache
def font(size: int) -> Any:
    """
    :param size: in pixels
    :return: the font that comes with matplotlib
    """
    return ImageFont.truetype(str(pathlib.Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"), size)


class Painter:
    """
    Draws the frames of one video.

    :param panels: one per block
    :param starts: the frame at which the episode of each frame began, (T,)
    :param depth: M, for the legend
    :param about: what the agent is, at the foot
    """

    def __init__(self, panels: Sequence[Panel], starts: np.ndarray, depth: int, about: str):
        self.panels = panels
        self.starts = starts
        area = (WIDTH - LEFT - 2 * GAP, HEIGHT - TITLE - FOOTER)
        columns = max(range(1, len(panels) + 1), key=lambda n: _side(area, n, len(panels)))
        self.side = _side(area, columns, len(panels)) - GAP  # of a panel, in pixels
        rows = -(-len(panels) // columns)
        x = LEFT + GAP + (area[0] - columns * (self.side + GAP)) // 2
        y = TITLE + (area[1] - rows * (self.side + GAP)) // 2
        self.corners = [
            (x + k % columns * (self.side + GAP), y + k // columns * (self.side + GAP)) for k in range(len(panels))
        ]
        self.grounds = [self._ground(panel) for panel in panels]
        self.page = self._page(depth, about)

    def paint(self, t: int, picture: np.ndarray, line: Line) -> np.ndarray:
        """
        :param t: which moment
        :param picture: of the game, (height, width, 3), uint8
        :param line: for the title
        :return: (HEIGHT, WIDTH, 3), uint8
        """
        page = self.page.copy()
        page.paste(*_fitted(picture))
        for panel, ground, corner in zip(self.panels, self.grounds, self.corners, strict=True):
            page.paste(self._paint_panel(panel, ground, t), corner)
        draw = ImageDraw.Draw(page)
        texts = (f"step {line.step}", line.action, f"reward {line.reward:+.3g}", f"score {line.score:.4g}")
        for x, text in zip((12, 124, 372, 560), texts, strict=True):  # columns that stay where they are
            draw.text((x, 8), text, INK, font(16))
        return np.asarray(page)

    def _page(self, depth: int, about: str) -> Image.Image:
        """What is the same on every frame."""
        page = Image.new("RGB", (WIDTH, HEIGHT), PAPER)
        draw = ImageDraw.Draw(page)
        y = HEIGHT - FOOTER // 2
        ghost = "1 step before" if depth == 1 else f"{depth} steps before"
        beyond = any(p.ghost.dots is not None and (np.abs(p.ghost.dots) > 1).any() for p in self.panels)
        axes = any(p.kind == "axes" for p in self.panels)
        words = ("solid: now", "pale: predicted") if axes else ("now", "predicted")
        last = f"{words[1]} {ghost}{' (at an edge: beyond it)' if beyond else ''}"
        marked = any(p.kind != "axes" or p.truth.dots is not None for p in self.panels)  # axes alone have no dots
        x = WIDTH - 12
        for text, is_ghost in ((last, True), (words[0], False)):
            draw.text((x, y), text, FAINT, font(12), anchor="rm")
            x -= round(font(12).getlength(text)) + (24 if marked else 0)
            if marked:
                page.paste(_symbol(is_ghost), (x, y - 10))
            x -= 12
        for letter, colour in zip("zyx", AXES[::-1], strict=True) if axes else ():
            draw.text((x, y), letter, colour, font(12), anchor="rm")
            x -= 12
        while font(12).getlength(about) > x - 12:
            about = f"{about.removesuffix('...')[:-1]}..."
        draw.text((12, y), about, FAINT, font(12), anchor="lm")
        return page

    def _ground(self, panel: Panel) -> Image.Image:
        """A panel without its block, drawn large."""
        side = self.side * SMOOTH
        image = Image.new("RGB", (side, side), PANEL)
        draw = ImageDraw.Draw(image)
        if panel.truth.dots is None:
            draw.line([(0, side // 2), (side, side // 2)], LINE, SMOOTH)
            draw.line([(side // 2, 0), (side // 2, side)], LINE, SMOOTH)
        if panel.kind == "arrow" and panel.truth.dots is None:  # where its tip may be
            edge = (1 - ROOM) / 2 * side
            draw.ellipse([edge, edge, side - edge, side - edge], outline=LINE, width=SMOOTH)
        draw.rectangle([0, 0, side - 1, side - 1], outline=LINE, width=SMOOTH)
        size = SMOOTH * (11 if self.side > 90 else 9)
        draw.text((4 * SMOOTH, 3 * SMOOTH), panel.name, FAINT, font(size))
        if panel.half_width is not None:
            draw.text((side - 4 * SMOOTH, side - 3 * SMOOTH), f"±{panel.half_width:.2g}", FAINT, font(size), anchor="rs")
        return image

    def _paint_panel(self, panel: Panel, ground: Image.Image, t: int) -> Image.Image:
        image = ground.copy()
        pen = Pen(ImageDraw.Draw(image), image.width)
        if panel.truth.dots is not None:
            first = max(int(self.starts[t]), t - TRAIL)
            pen.trail(panel.truth.dots[first : t + 1])
        _paint_shape(pen, panel.ghost, panel.kind, t, ghost=True)
        _paint_shape(pen, panel.truth, panel.kind, t, ghost=False)
        return image.reduce(SMOOTH)


class Pen:
    """
    Draws in a square panel.

    :param draw: where
    :param side: of the panel, in pixels
    :param least: how small its lines get in a small panel
    """

    def __init__(self, draw: ImageDraw.ImageDraw, side: int, least: float = 0.7):
        self.draw = draw
        self.side = side
        self.unit = SMOOTH * min(max(side / SMOOTH / 140, least), 1.8)  # a pixel, larger in a large panel

    def at(self, point: np.ndarray) -> tuple[float, float]:
        """Pixels of a point in the panel's units; far outside is outside."""
        x, y = np.clip(point, -9, 9)
        return (1 + x) / 2 * self.side, (1 - y) / 2 * self.side

    def arrow(self, start: np.ndarray, end: np.ndarray, colour: Colour, width: float) -> None:
        """
        :param width: of the shaft, in units of the pen
        """
        a, b = np.array(self.at(start)), np.array(self.at(end))
        length = float(np.linalg.norm(b - a))
        if length < 1:
            return
        along = (b - a) / length
        across = np.array([-along[1], along[0]])
        head = min((2.2 * width + 3) * self.unit, length)
        neck = b - head * along
        self.draw.line([tuple(a), tuple(neck)], colour, round(width * self.unit))
        self.draw.polygon([tuple(b), tuple(neck + head / 2 * across), tuple(neck - head / 2 * across)], colour)

    def disc(self, centre: tuple[float, float], colour: Colour, radius: float) -> None:
        """
        :param centre: in pixels of the panel
        :param radius: in units of the pen
        """
        (x, y), r = centre, radius * self.unit
        self.draw.ellipse([x - r, y - r, x + r, y + r], colour)

    def ring(self, centre: tuple[float, float], colour: Colour, radius: float) -> None:
        """As :meth:`disc`, hollow."""
        (x, y), r = centre, radius * self.unit
        self.draw.ellipse([x - r, y - r, x + r, y + r], outline=colour, width=round(2 * self.unit))

    def mark_beyond(self, point: np.ndarray, colour: Colour) -> None:
        """
        A triangle at the edge that a point lies beyond.

        :param point: in the panel's units
        """
        tip = point / np.abs(point).max() * (1 - 2 * SMOOTH / self.side)
        along = tip / np.linalg.norm(tip) * 14 * SMOOTH / self.side
        across = np.array([-along[1], along[0]]) / 1.5
        self.draw.polygon([self.at(p) for p in (tip, tip - along + across, tip - along - across)], colour)

    def trail(self, points: np.ndarray) -> None:
        """
        :param points: oldest first, (n, 2)
        """
        for age, (a, b) in enumerate(zip(points[-2::-1], points[:0:-1], strict=True)):
            fade = 0.25 + 0.65 * age / TRAIL
            colour = tuple(round(fade * paper + (1 - fade) * blue) for paper, blue in zip(PANEL, BLUE, strict=True))
            self.draw.line([self.at(a), self.at(b)], colour, round(1.5 * self.unit))


def _symbol(ghost: bool) -> Image.Image:
    """For the legend."""
    image = Image.new("RGB", (20 * SMOOTH, 20 * SMOOTH), PAPER)
    pen = Pen(ImageDraw.Draw(image), image.width, least=1.0)
    _paint_shape(pen, Shape(None, np.zeros((1, 2))), "dot", 0, ghost)
    return image.reduce(SMOOTH)


def _paint_shape(pen: Pen, shape: Shape, kind: str, t: int, ghost: bool) -> None:
    """What lies above is thinner, so that a prediction that came true is still seen around it."""
    arrows, dots = (None if part is None else part[t] for part in shape)
    if not all(part is None or np.isfinite(part).all() for part in (arrows, dots)):
        return
    foot = np.zeros(2) if dots is None else dots
    colour = GHOST if ghost else BLUE
    if np.abs(foot).max() > 1:
        pen.mark_beyond(foot, colour)
        return
    if arrows is not None:
        tips = foot + arrows  # (A, 2)
        if kind == "parallelogram":
            corners = [pen.at(p) for p in (foot, tips[0], tips.sum(axis=0) - foot, tips[1], foot)]
            pen.draw.line(corners, colour, round((3 if ghost else 1.5) * pen.unit), joint="curve")
        colours = (GHOST_AXES if ghost else AXES) if kind == "axes" else (colour, colour)
        for i, tip in enumerate(tips):
            pen.arrow(foot, tip, colours[i], (5 if ghost else 2) - (0.5 if kind == "parallelogram" else 0))
    if dots is not None:
        (pen.ring if ghost else pen.disc)(pen.at(dots), colour, 5.5 if ghost else 3.5)


def _side(area: tuple[int, int], columns: int, n: int) -> int:
    return min(area[0] // columns, area[1] // -(-n // columns))


def _fitted(picture: np.ndarray) -> tuple[Image.Image, tuple[int, int]]:
    """The game's picture as large as fits, small ones by a whole factor with hard edges; and its corner."""
    image = Image.fromarray(picture)
    room = LEFT - 2 * GAP, HEIGHT - TITLE - FOOTER
    factor = min(room[0] / image.width, room[1] / image.height)
    hard = factor >= 3
    factor = int(factor) if hard else factor
    size = max(round(image.width * factor), 1), max(round(image.height * factor), 1)
    image = image.resize(size, Image.Resampling.NEAREST if hard else Image.Resampling.LANCZOS)
    return image, (GAP + (room[0] - size[0]) // 2, TITLE + (room[1] - size[1]) // 2)
