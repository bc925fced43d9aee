"""What an agent sees, as pictures."""

import colorsys
from typing import Any

import numpy as np
from gymnasium import spaces
from PIL import Image, ImageDraw
from stable_baselines3.common.preprocessing import is_image_space

from sb3_eqr.visualize.canvas import BLUE, FAINT, LINE, PAPER, font

ROW = 22  # height of a bar, in pixels
MAX_ROWS = 16
BAR_WIDTH = 340


def observed_pictures(observations: Any, space: spaces.Space, frame_stack: int) -> list[np.ndarray]:
    """
    :param observations: (T, *obs_shape), or a dict of these
    :param space: of the observations
    :param frame_stack: how many frames are stacked along the first axis of an image
    :return: T of (height, width, 3), uint8: of a stack of frames the newest, planes that are no colours in colours of their
        own, of numbers a bar each; of a dict the first image
    """
    if isinstance(space, spaces.Dict):
        images = [key for key, part in space.spaces.items() if part.shape is not None and len(part.shape) == 3]
        if images:
            return observed_pictures(observations[images[0]], space[images[0]], frame_stack)
        return bars(np.concatenate([x.reshape(len(x), -1) for x in observations.values()], axis=1))
    if len(observations.shape) != 4:
        return bars(observations.reshape(len(observations), -1))
    planes = observations.astype(np.float64)  # (T, channels, height, width)
    if not is_image_space(space):  # floats
        low, high = planes.min(), planes.max()
        planes = 255 * (planes - low) / max(high - low, 1e-9)
        if space.shape is not None and space.shape[2] < space.shape[0]:  # SB3 transposes images only
            planes = planes.transpose(0, 3, 1, 2)
    newest = planes[:, -(planes.shape[1] // frame_stack) :]
    return list(_coloured(newest).astype(np.uint8))


def bars(values: np.ndarray) -> list[np.ndarray]:
    """
    Numbers as bars from 0, each on a scale of its own that stays the same.

    :param values: (T, n)
    :return: T of (height, width, 3), uint8
    """
    shown = values[:, :MAX_ROWS]
    scale = np.maximum(np.abs(shown).max(axis=0), 1e-9)
    more = values.shape[1] - shown.shape[1]
    return [_bar_picture(row, row / scale, more) for row in shown]


def _bar_picture(values: np.ndarray, lengths: np.ndarray, more: int) -> np.ndarray:
    image = Image.new("RGB", (BAR_WIDTH, ROW * (len(values) + (more > 0))), PAPER)
    draw = ImageDraw.Draw(image)
    middle = BAR_WIDTH * 9 // 16
    for i, (value, length) in enumerate(zip(values, lengths, strict=True)):
        y = i * ROW
        end = middle + round(float(length) * (BAR_WIDTH - middle - 8))
        draw.rectangle([min(middle, end), y + 5, max(middle, end), y + ROW - 6], BLUE)
        draw.text((4, y + ROW // 2), f"{value:+.3g}", FAINT, font(12), anchor="lm")
    draw.line([(middle, 0), (middle, ROW * len(values))], LINE, 1)
    if more > 0:
        draw.text((4, image.height - ROW // 2), f"and {more} more", FAINT, font(12), anchor="lm")
    return np.asarray(image)


def _coloured(planes: np.ndarray) -> np.ndarray:
    """(T, channels, height, width), 0 to 255 -> (T, height, width, 3)"""
    n = planes.shape[1]
    if n == 3:
        return planes.transpose(0, 2, 3, 1)
    colours = np.array([(1.0, 1.0, 1.0) if n == 1 else colorsys.hsv_to_rgb(i / n, 0.75, 1.0) for i in range(n)])
    return (planes[..., None] * colours[:, None, None]).max(axis=1)
