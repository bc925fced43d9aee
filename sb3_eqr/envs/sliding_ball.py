"""The sliding ball of the paper (Example 2): a world whose states are SO(2), or two of them."""

from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_eqr.common.validation import check_number

SMALLEST_PICTURE = 36  # of what the default convolutions of CnnPolicy accept
ENLARGED = 4  # how many pixels of a rendered picture one of an observation becomes


class SlidingBall(gym.Env):
    """
    A ball on a closed loop (EqR, §5, Example 2 and Figure 3): it leaves the picture at one edge and comes back at the
    opposite one. One dimension is the paper's; with two the loop is a torus. An action turns its axis by one angle,
    2π / ``n_steps``, wherever the ball is: SO(2) per axis.

    The observation is (size, size, 1), uint8: a white disc of radius size/8 on black ground, drawn across the edges.
    Actions: 0 up, 1 down, and on the torus 2 left, 3 right. ``info["position"]`` is the true state.

    :param dimensions: 1, a vertical loop, or 2, a torus
    :param size: of the picture, in pixels; at least 36
    :param n_steps: how many equal steps lead around the loop, at least 3
    :param goal: ``None``: the reward is always 0 and no episode ends. Or a position, ``dimensions`` numbers in [0, 1):
        reward 1 and the end within half a step of it in every axis; no episode is drawn to start there.
    :param render_mode: "rgb_array": the picture enlarged, the goal as a faint green ring
    :raises ValueError: for an argument outside these ranges
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        dimensions: int = 1,
        size: int = 48,
        n_steps: int = 16,
        goal: Sequence[float] | None = None,
        render_mode: str | None = None,
    ):
        check_number("dimensions", dimensions, 1, 2, whole=True)
        check_number("size", size, SMALLEST_PICTURE, whole=True)
        check_number("n_steps", n_steps, 3, whole=True)
        self.dimensions = dimensions
        self.size = size
        self.n_steps = n_steps
        self.goal = None if goal is None else check_position("goal", goal, dimensions)
        self.render_mode = render_mode
        self.observation_space = spaces.Box(0, 255, (size, size, 1), np.uint8)
        self.action_space = spaces.Discrete(2 * dimensions)
        self._start = np.zeros(dimensions)
        self._moved = np.zeros(dimensions, dtype=np.int64)  # steps since then: whole, so that a full turn is exact

    @property
    def position(self) -> np.ndarray:
        """
        :return: (dimensions,), fractions of the loop in [0, 1): from the top edge down, from the left edge to the right
        """
        return np.mod(self._start + self._moved / self.n_steps, 1.0)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """
        :param options: {"position": where the ball starts, ``dimensions`` numbers in [0, 1)}; drawn uniformly without
        :return: observation, (size, size, 1); {"position": (dimensions,)}
        :raises ValueError: for other options
        """
        super().reset(seed=seed)
        options = check_options(options, ["position"])
        self._moved[:] = 0
        if "position" in options:
            self._start = check_position("position", options["position"], self.dimensions)
        else:
            self._start = self.np_random.random(self.dimensions)
            while self._at_goal():
                self._start = self.np_random.random(self.dimensions)
        return self.draw(self.position), {"position": self.position}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        :param action: 0 up, 1 down, 2 left, 3 right
        :return: observation, (size, size, 1); 1 at the goal, else 0; whether it is there; no time-outs;
            {"position": (dimensions,)}
        :raises ValueError: for another action
        """
        check_action(self.action_space, action)
        axis, forwards = divmod(int(action), 2)
        self._moved[axis] = (self._moved[axis] + 2 * forwards - 1) % self.n_steps
        there = self._at_goal()
        return self.draw(self.position), float(there), there, False, {"position": self.position}

    def get_action_meanings(self) -> list[str]:
        """
        :return: a name per action, as ALE's environments have them
        """
        return ["UP", "DOWN", "LEFT", "RIGHT"][: 2 * self.dimensions]

    def _at_goal(self) -> bool:
        if self.goal is None:
            return False
        way = np.abs(self.position - self.goal)
        return bool(np.all(np.minimum(way, 1 - way) <= 0.5 / self.n_steps))

    def draw(self, position: Sequence[float] | np.ndarray) -> np.ndarray:
        """
        :param position: (dimensions,), in [0, 1)
        :return: what the agent sees there, (size, size, 1), uint8
        :raises ValueError: for another shape or range
        """
        distance = self._distance(check_position("position", position, self.dimensions))
        disc = np.clip(self.size / 8 + 0.5 - distance, 0, 1)  # (size, size), how much of each pixel is covered
        return np.rint(255 * disc).astype(np.uint8)[:, :, None]

    def _distance(self, position: np.ndarray) -> np.ndarray:
        """From every pixel's centre the shorter way around the edges to a position, in pixels: (size, size)."""
        centre = self.size * np.append(position, 0.5)[:2]  # one dimension: half-way across
        way = np.abs(np.arange(self.size) + 0.5 - centre[:, None])  # (2, size)
        rows, columns = np.minimum(way, self.size - way)
        return np.hypot(rows[:, None], columns[None, :])

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """
        :return: with ``render_mode="rgb_array"`` (4 size, 4 size, 3), uint8
        """
        if self.render_mode is None:
            return None
        picture = self.draw(self.position).repeat(3, axis=2)
        if self.goal is not None:
            ring = np.clip(1.5 - np.abs(self._distance(self.goal) - self.size / 8), 0, 1)
            picture[:, :, 1] = np.maximum(picture[:, :, 1], np.rint(110 * ring).astype(np.uint8))
        return enlarge(picture)


def check_position(name: str, position: Sequence[float] | np.ndarray, dimensions: int) -> np.ndarray:
    """
    :param name: of the argument
    :param position: fractions of a closed loop, one per axis
    :param dimensions: how many axes there are
    :return: (dimensions,), a copy
    :raises ValueError: if they are not so many numbers in [0, 1)
    """
    found = np.array(position)
    legal = found.shape == (dimensions,) and np.issubdtype(found.dtype, np.number) and np.isrealobj(found)
    if not legal or not np.all((found >= 0) & (found < 1)):
        raise ValueError(f"{name}: expected {dimensions} numbers in [0, 1), found {position!r}")
    return found.astype(np.float64)


def check_options(options: dict[str, Any] | None, names: Iterable[str]) -> dict[str, Any]:
    """
    :param options: of ``reset``
    :param names: those there are
    :return: the options, an empty dict for ``None``
    :raises ValueError: if there is another one
    """
    unknown = set(options or {}) - set(names)
    if unknown:
        raise ValueError(f"options: expected none but {', '.join(names)}, found {', '.join(map(repr, sorted(unknown)))}")
    return dict(options or {})


def check_action(space: spaces.Space, action: Any) -> None:
    """
    :param space: of actions
    :param action: a number or, as SB3's ``predict`` gives it, an array of shape ()
    :raises ValueError: if it is not in the space
    """
    if not space.contains(action):
        raise ValueError(f"action: expected one of {space}, found {action!r}")


def enlarge(picture: np.ndarray) -> np.ndarray:
    """
    :param picture: (height, width, 3)
    :return: (4 height, 4 width, 3)
    """
    return picture.repeat(ENLARGED, axis=0).repeat(ENLARGED, axis=1)
