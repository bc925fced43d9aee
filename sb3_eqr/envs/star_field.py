"""Flight among stars: a three-dimensional world whose states are SE(3), or SO(3)."""

from math import cos, pi, sin
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_eqr.common.validation import check_number
from sb3_eqr.envs.sliding_ball import SMALLEST_PICTURE, check_action, check_options, check_position, enlarge

TURN = pi / 16  # rad, about 0.2; 32 turns are a full one
MOVE = 0.05  # of the side of the cube; 20 moves along an edge are once around
STAR_RADIUS = 0.04  # of the side of the cube
VIEW = 0.5  # how far the camera sees, as fraction of the side: beyond it the nearest copy of a star changes
NEAR = 0.05  # in front of the camera: what is nearer than this is not seen, up to twice that it fades


class StarField(gym.Env):
    """
    A camera among coloured balls at fixed places of a periodic cube of side 1. Of each ball the nearest copy is seen, and
    light fades to nothing at half the side, so translating never ends and no ball pops up.

    The pose is a rotation R, (3, 3), whose columns are the camera's own axes in the world (right, down, forward), and a
    place t in [0, 1)³. An action moves along or turns about the camera's own axes: the pose (R, t), as a matrix of SE(3),
    is multiplied from the right, and its inverse, from world to camera, from the left as EqR has it (§4), by a matrix
    that does not depend on the state. A pinhole camera with a field of view of 90° sees it: (size, size, 3), uint8.

    Actions: 0 pitch up, 1 pitch down, 2 yaw right, 3 yaw left, 4 roll right (clockwise), 5 roll left, each by π/16 rad;
    and with translations 6 forward, 7 back, 8 right, 9 left, 10 up, 11 down, each by 0.05.
    ``info`` holds the true "rotation", (3, 3), and "translation", (3,). The reward is 0 and no episode ends.

    :param translations: ``False``: SO(3) only; the camera stays in the middle of the cube
    :param size: of the picture, in pixels; at least 36
    :param n_stars: how many balls there are, at least 1
    :param layout_seed: draws their places and colours, not the camera's
    :param render_mode: "rgb_array": the picture, enlarged
    :raises ValueError: for an argument outside these ranges
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        translations: bool = True,
        size: int = 48,
        n_stars: int = 60,
        layout_seed: int = 0,
        render_mode: str | None = None,
    ):
        check_number("size", size, SMALLEST_PICTURE, whole=True)
        check_number("n_stars", n_stars, 1, whole=True)
        check_number("layout_seed", layout_seed, 0, whole=True)
        self.translations = translations
        self.size = size
        self.render_mode = render_mode
        self.observation_space = spaces.Box(0, 255, (size, size, 3), np.uint8)
        self.action_space = spaces.Discrete(12 if translations else 6)
        layout = np.random.default_rng(layout_seed)
        self.places = layout.random((n_stars, 3))
        colours = layout.uniform(0.2, 1, (n_stars, 3))
        self.colours = colours / colours.max(axis=1, keepdims=True)  # (n_stars, 3), in (0, 1]
        self.rotation = np.eye(3)
        self.translation = np.full(3, 0.5)
        # Right, down, forward are right-handed: turning about them is pitch up, yaw right, roll right.
        self._turns = [axis_rotation(axis, sign * TURN) for axis in range(3) for sign in (1, -1)]
        self._moves = MOVE * np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, -1, 0], [0, 1, 0]])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """
        :param options: {"rotation": (3, 3); "translation": three numbers in [0, 1), not where the camera stays in place}.
            What is not given is drawn uniformly.
        :return: observation, (size, size, 3); {"rotation": (3, 3), "translation": (3,)}
        :raises ValueError: for other options
        """
        super().reset(seed=seed)
        options = check_options(options, ["rotation", "translation"] if self.translations else ["rotation"])
        # Both are drawn in any case: an option leaves the other draw as it was.
        quaternion, place = self.np_random.standard_normal(4), self.np_random.random(3)
        given = options.get("rotation")
        self.rotation = quaternion_rotation(quaternion) if given is None else check_rotation("rotation", given)
        if self.translations:
            self.translation = check_position("translation", options.get("translation", place), 3)
        return self.draw(self.rotation, self.translation), self._info()

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        :param action: see above, 0 … 5 or 0 … 11
        :return: observation, (size, size, 3); 0; no end; no time-outs; {"rotation": (3, 3), "translation": (3,)}
        :raises ValueError: for another action
        """
        check_action(self.action_space, action)
        self._move(int(action))
        return self.draw(self.rotation, self.translation), 0.0, False, False, self._info()

    def _move(self, action: int) -> None:
        if action < len(self._turns):
            self.rotation = orthonormalized(self.rotation @ self._turns[action])
        else:
            moved = self.translation + self.rotation @ self._moves[action - len(self._turns)]
            self.translation = np.mod(np.mod(moved, 1), 1)  # twice: once makes 1.0 of a negative rounding error

    def _info(self) -> dict[str, Any]:
        return {"rotation": self.rotation.copy(), "translation": self.translation.copy()}

    def draw(self, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
        """
        :param rotation: right, down and forward axis of the camera in the world, as columns, (3, 3)
        :param translation: where it is, (3,)
        :return: what it sees, (size, size, 3), uint8
        """
        offset = self.places - translation
        offset -= np.rint(offset)  # to the nearest copy, (n_stars, 3)
        distance = np.linalg.norm(offset, axis=1)
        x, y, depth = (offset @ rotation).T  # in the camera's axes, (n_stars,) each
        # Within 90° about the axis, and a star's radius more.
        seen = (distance < VIEW) & (depth > NEAR) & (np.maximum(np.abs(x), np.abs(y)) < depth + 2 * STAR_RADIUS)
        order = np.flatnonzero(seen)[np.argsort(distance[seen])]  # near to far, (n_seen,)
        x, y, depth, distance = x[order], y[order], depth[order], distance[order]
        scale = self.size / 2 / depth  # pixels per unit there
        alpha = self._discs(x * scale, y * scale, STAR_RADIUS * scale) * np.clip(depth / NEAR - 1, 0, 1)[:, None, None]
        colours = self.colours[order] * (1 - (distance / VIEW) ** 4)[:, None]
        # Painted far to near, in one product: what reaches the camera is what the nearer ones let through.
        passed = np.cumprod(1 - alpha, axis=0)
        passed[1:], passed[:1] = passed[:-1].copy(), 1.0
        picture = (alpha * passed).reshape(len(order), self.size**2).T @ colours  # (size², 3); black if no star is seen
        return np.rint(255 * picture).astype(np.uint8).reshape(self.size, self.size, 3)

    def _discs(self, x: np.ndarray, y: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """How much of each pixel each disc covers, (n, size, size), from places about the centre and radii in pixels."""
        centred = np.arange(self.size) + 0.5 - self.size / 2
        squares = (centred - y[:, None])[:, :, None] ** 2 + (centred - x[:, None])[:, None, :] ** 2
        return np.clip(radius[:, None, None] + 0.5 - np.sqrt(squares), 0, 1)

    def get_action_meanings(self) -> list[str]:
        """
        :return: a name per action, as ALE's environments have them
        """
        turns = ["PITCH UP", "PITCH DOWN", "YAW RIGHT", "YAW LEFT", "ROLL RIGHT", "ROLL LEFT"]
        moves = ["FORWARD", "BACK", "RIGHT", "LEFT", "UP", "DOWN"]
        return (turns + moves)[: int(self.action_space.n)]  # type: ignore[attr-defined]

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """
        :return: with ``render_mode="rgb_array"`` (4 size, 4 size, 3), uint8
        """
        return None if self.render_mode is None else enlarge(self.draw(self.rotation, self.translation))


def axis_rotation(axis: int, angle: float) -> np.ndarray:
    """
    :param axis: 0, 1 or 2
    :param angle: in radians, right-handed
    :return: the rotation about that axis, (3, 3)
    """
    rotation = np.eye(3)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    rotation[first, first] = rotation[second, second] = cos(angle)
    rotation[second, first], rotation[first, second] = sin(angle), -sin(angle)
    return rotation


def quaternion_rotation(quaternion: np.ndarray) -> np.ndarray:
    """
    :param quaternion: (4,), real part first, of any length; Gaussian ones give uniform rotations
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
    :return: one step of Newton's iteration towards the nearest rotation: the error is squared, so rounding never adds up
    """
    return 1.5 * matrix - 0.5 * matrix @ matrix.T @ matrix


def check_rotation(name: str, rotation: Any) -> np.ndarray:
    """
    :param name: of the argument
    :param rotation: what was given
    :return: (3, 3), a copy
    :raises ValueError: if it is no rotation matrix to six digits
    """
    found = np.array(rotation, dtype=np.float64)
    legal = found.shape == (3, 3) and np.allclose(found.T @ found, np.eye(3), atol=1e-6) and np.linalg.det(found) > 0
    if not legal:
        raise ValueError(f"{name}: expected a rotation matrix, (3, 3), orthonormal with determinant 1, found {rotation!r}")
    return orthonormalized(found)
