"""Observations as images."""

import colorsys
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space

ROW, HALF = 22, 170  # height of a row with a bar, and half the width of an image, in pixels
MAX_ROWS = 16
BAR, MIDDLE = (20, 70, 160), (160, 160, 160)


def observed_pictures(observations: Any, space: spaces.Space, frame_stack: int) -> list[np.ndarray]:
    """
    :param observations: (T, *obs_shape), or a dict of these
    :param space: observation space
    :param frame_stack: number of frames stacked along the first axis of an image
    :return: T of (height, width, 3), uint8: the newest of stacked frames; planes other than RGB each in their own colour;
        numbers as bars; of a dict the first image
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
    Numbers as bars that start at 0, in the middle, each with its own fixed scale.

    :param values: (T, n), only the first :data:`MAX_ROWS` of n are shown
    :return: T of (height, width, 3), uint8
    """
    shown = values[:, :MAX_ROWS]
    ends = HALF * shown / np.maximum(np.abs(shown).max(axis=0), 1e-9)  # (T, n)
    place = np.arange(-HALF, HALF + 1)  # of a pixel
    inside = (place >= np.minimum(ends, 0)[..., None]) & (place <= np.maximum(ends, 0)[..., None])  # (T, n, width)
    pictures = np.full((*inside.shape[:2], ROW, len(place), 3), 255, dtype=np.uint8)
    pictures[:, :, 3:-3][np.broadcast_to(inside[:, :, None], (*inside.shape[:2], ROW - 6, len(place)))] = BAR
    pictures[:, :, :, HALF] = MIDDLE
    return list(pictures.reshape(len(shown), -1, len(place), 3))


def _coloured(planes: np.ndarray) -> np.ndarray:
    """(T, channels, height, width), 0 to 255 -> (T, height, width, 3)"""
    n = planes.shape[1]
    if n == 3:
        return planes.transpose(0, 2, 3, 1)
    colours = np.array([(1.0, 1.0, 1.0) if n == 1 else colorsys.hsv_to_rgb(i / n, 0.75, 1.0) for i in range(n)])
    return (planes[..., None] * colours[:, None, None]).max(axis=1)
