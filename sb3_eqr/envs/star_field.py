"""Flight among stars: a three-dimensional environment whose state space is SE(3), or SO(3)."""

from math import cos, pi, sin
from typing import Any

import numpy as np

from sb3_eqr.common.checks.arguments import check, integer
from sb3_eqr.envs.pixels import PixelEnv, check_position

TURN = pi / 16  # rad, about 0.2; 32 turns make a full one
MOVE = 0.05  # fraction of the cube's side; 20 moves along an edge lead back to the start
STAR_RADIUS = 0.04  # fraction of the cube's side
VIEW = 0.5  # range of the camera, as a fraction of the side: beyond it, another copy of a star would be nearer
NEAR = 0.05  # stars nearer to the camera than this are invisible; up to twice this distance they fade
TURNS = ["PITCH UP", "PITCH DOWN", "YAW RIGHT", "YAW LEFT", "ROLL RIGHT", "ROLL LEFT"]
MOVES = ["FORWARD", "BACK", "RIGHT", "LEFT", "UP", "DOWN"]


class StarField(PixelEnv):
    """
    A camera among coloured balls at fixed positions in a periodic cube of side 1. Only the nearest copy of each ball is
    visible, and light fades to zero at half the side, so the camera can fly on forever and no ball pops up.

    The pose is a rotation R, (3, 3), whose columns are the camera's axes in world coordinates (right, down, forward), and a
    position t in [0, 1)³. An action moves along or turns about the camera's own axes: it multiplies the pose (R, t), as a
    matrix of SE(3), from the right, and its inverse, the world-to-camera transform, from the left, as in EqR (§4), by a
    matrix that does not depend on the state. The observation is the image of a pinhole camera with a field of view of 90°:
    (size, size, 3), uint8.

    Actions: 0 pitch up, 1 pitch down, 2 yaw right, 3 yaw left, 4 roll right (clockwise), 5 roll left, each by π/16 rad;
    and with translations 6 forward, 7 back, 8 right, 9 left, 10 up, 11 down, each by 0.05.
    ``info`` holds the true "rotation", (3, 3), and "translation", (3,). The reward is 0 and no episode terminates. Options of
    ``reset``: {"rotation": (3, 3); "translation": three numbers in [0, 1), only if ``translations``}. Missing values are drawn
    uniformly.

    :param translations: ``False``: SO(3) only; the camera stays in the middle of the cube
    :param size: height and width of the image, in pixels; at least 36
    :param n_stars: number of balls, at least 1
    :param layout_seed: seed for the positions and colours of the balls; it does not affect the camera
    :param render_mode: "rgb_array": the enlarged image
    :raises ValueError: if an argument is out of range
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10, "periods": {"translation": 1.0}}

    def __init__(
        self,
        translations: bool = True,
        size: int = 48,
        n_stars: int = 60,
        layout_seed: int = 0,
        render_mode: str | None = None,
    ):
        actions, options = (TURNS + MOVES, ["rotation", "translation"]) if translations else (TURNS, ["rotation"])
        super().__init__(size, 3, actions, options, render_mode)
        check("n_stars", n_stars, integer(1))
        check("layout_seed", layout_seed, integer(0))
        self.translations = translations
        layout = np.random.default_rng(layout_seed)
        self.places = layout.random((n_stars, 3))
        colours = layout.uniform(0.2, 1, (n_stars, 3))
        self.colours = colours / colours.max(axis=1, keepdims=True)  # (n_stars, 3), in (0, 1]
        self.rotation = np.eye(3)
        self.translation = np.full(3, 0.5)
        # Right, down, forward form a right-handed system: rotations about them are pitch up, yaw right, roll right.
        self._turns = [axis_rotation(axis, sign * TURN) for axis in range(3) for sign in (1, -1)]
        self._moves = MOVE * np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, -1, 0], [0, 1, 0]])

    def _begin(self, options: dict[str, Any]) -> None:
        # Always draw both, so that setting one option does not change the other draw.
        quaternion, place = self.np_random.standard_normal(4), self.np_random.random(3)
        given = options.get("rotation")
        self.rotation = quaternion_rotation(quaternion) if given is None else check_rotation(given)
        if self.translations:
            self.translation = check_position("translation", options.get("translation", place), 3)

    def _move(self, action: int) -> tuple[float, bool]:
        if action < len(self._turns):
            self.rotation = orthonormalized(self.rotation @ self._turns[action])
        else:
            moved = self.translation + self.rotation @ self._moves[action - len(self._turns)]
            self.translation = np.mod(np.mod(moved, 1), 1)  # twice, because one call maps a tiny negative number to 1.0
        return 0.0, False

    def _seen(self) -> tuple[np.ndarray, dict[str, Any]]:
        info = {"rotation": self.rotation.copy(), "translation": self.translation.copy()}
        return self.draw(self.rotation, self.translation), info

    def draw(self, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
        """
        :param rotation: right, down and forward axis of the camera in world coordinates, as columns, (3, 3)
        :param translation: position of the camera, (3,)
        :return: the camera's image, (size, size, 3), uint8
        """
        offset = self.places - translation
        offset -= np.rint(offset)  # to the nearest copy, (n_stars, 3)
        distance = np.linalg.norm(offset, axis=1)
        x, y, depth = (offset @ rotation).T  # in camera coordinates, (n_stars,) each
        # Inside the field of view of 90°, plus a margin for the star's radius.
        seen = (distance < VIEW) & (depth > NEAR) & (np.maximum(np.abs(x), np.abs(y)) < depth + 2 * STAR_RADIUS)
        order = np.flatnonzero(seen)[np.argsort(distance[seen])]  # near to far, (n_seen,)
        x, y, depth, distance = x[order], y[order], depth[order], distance[order]
        scale = self.size / 2 / depth  # pixels per unit at that depth
        alpha = self._discs(x * scale, y * scale, STAR_RADIUS * scale) * np.clip(depth / NEAR - 1, 0, 1)[:, None, None]
        colours = self.colours[order] * (1 - (distance / VIEW) ** 4)[:, None]
        # Alpha compositing in one product: of each star, only the light that nearer ones transmit reaches the camera.
        passed = np.cumprod(1 - alpha, axis=0)
        passed[1:], passed[:1] = passed[:-1].copy(), 1.0
        picture = (alpha * passed).reshape(len(order), self.size**2).T @ colours  # (size², 3); black if no star is seen
        return np.rint(255 * picture).astype(np.uint8).reshape(self.size, self.size, 3)

    def _discs(self, x: np.ndarray, y: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Coverage of each pixel by each disc, (n, size, size), from positions relative to the centre and radii, in pixels."""
        centred = np.arange(self.size) + 0.5 - self.size / 2
        squares = (centred - y[:, None])[:, :, None] ** 2 + (centred - x[:, None])[:, None, :] ** 2
        return np.clip(radius[:, None, None] + 0.5 - np.sqrt(squares), 0, 1)


def axis_rotation(axis: int, angle: float) -> np.ndarray:
    """:return: the right-handed rotation about axis 0, 1 or 2 by an angle in radians, (3, 3)"""
    about_first = np.array([[1, 0, 0], [0, cos(angle), -sin(angle)], [0, sin(angle), cos(angle)]])
    return np.roll(about_first, axis, axis=(0, 1))


def quaternion_rotation(quaternion: np.ndarray) -> np.ndarray:
    """
    :param quaternion: (4,), real part first, of any norm; Gaussian quaternions give uniform rotations
    :return: (3, 3)
    """
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def orthonormalized(matrix: np.ndarray) -> np.ndarray:
    """
    :param matrix: nearly a rotation, (3, 3)
    :return: one step of Newton's iteration towards the nearest rotation: it squares the error, so rounding errors never add up
    """
    return 1.5 * matrix - 0.5 * matrix @ matrix.T @ matrix


def check_rotation(rotation: Any) -> np.ndarray:
    """
    :return: a copy, (3, 3)
    :raises ValueError: if it is not a rotation matrix to six digits
    """
    found = np.array(rotation, dtype=np.float64)
    legal = found.shape == (3, 3) and np.allclose(found.T @ found, np.eye(3), atol=1e-6) and np.linalg.det(found) > 0
    if not legal:
        raise ValueError(f"rotation must be a (3, 3) rotation matrix, orthonormal with determinant 1, got {rotation!r}.")
    return orthonormalized(found)
