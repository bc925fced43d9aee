"""The sliding ball of the paper (Example 2): an environment whose state space is SO(2), or SO(2) × SO(2)."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_eqr.common.checks.arguments import check, integer
from sb3_eqr.envs.pixels import PixelEnv, check_position

DISTRACTOR_BRIGHTNESS = 0.8  # relative to the ball


class SlidingBall(PixelEnv):
    """
    A ball on a closed loop (EqR, §5, Example 2 and Figure 3): it leaves the image at one edge and re-enters at the
    opposite one. The paper uses one dimension; with two, the state space is a torus. Each action rotates one axis by
    2π / ``n_steps``, independently of the position: SO(2) per axis.

    The observation is (size, size, 1), uint8: a white disc of radius size/8 on a black background, wrapped at the edges.
    Actions: 0 up, 1 down, and on the torus 2 left, 3 right. ``info["position"]`` is the true state. Option of ``reset``:
    {"position": ``dimensions`` numbers in [0, 1)}, drawn uniformly if not given.

    Distractors are light grey discs of the same size behind the ball. At every step, each jumps to a random place: they carry
    no information and cannot be predicted, so the state space and its symmetry are the same, but the ball is harder to see.

    :param dimensions: 1, a vertical loop, or 2, a torus
    :param size: height and width of the image, in pixels; at least 36
    :param n_steps: number of equal steps around the loop, at least 3
    :param goal: ``None``: the reward is always 0 and no episode terminates. Otherwise a position, ``dimensions`` numbers in
        [0, 1): within half a step of it in every axis, the reward is 1 and the episode terminates. Randomly drawn starts
        are never at the goal.
    :param n_distractors: number of distractors, at least 0
    :param render_mode: "rgb_array": the enlarged image, with the goal as a faint green ring
    :raises ValueError: if an argument is out of range
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10, "periods": {"position": 1.0}}

    def __init__(
        self,
        dimensions: int = 1,
        size: int = 48,
        n_steps: int = 16,
        goal: Sequence[float] | None = None,
        n_distractors: int = 0,
        render_mode: str | None = None,
    ):
        check("dimensions", dimensions, integer(1, 2))
        super().__init__(size, 1, ["UP", "DOWN", "LEFT", "RIGHT"][: 2 * dimensions], ["position"], render_mode)
        check("n_steps", n_steps, integer(3))
        check("n_distractors", n_distractors, integer(0))
        self.dimensions = dimensions
        self.n_steps = n_steps
        self.goal = None if goal is None else check_position("goal", goal, dimensions)
        self.n_distractors = n_distractors
        self._distractors = np.zeros((n_distractors, dimensions))  # their positions, drawn at every step
        self._start = np.zeros(dimensions)
        self._moved = np.zeros(dimensions, dtype=np.int64)  # steps since the start: integers, so that a full turn is exact

    @property
    def position(self) -> np.ndarray:
        """:return: (dimensions,), fractions of the loop in [0, 1), measured from the top edge and from the left edge"""
        return np.mod(self._start + self._moved / self.n_steps, 1.0)

    def _begin(self, options: dict[str, Any]) -> None:
        self._moved[:] = 0
        if "position" in options:
            self._start = check_position("position", options["position"], self.dimensions)
        else:
            self._start = self.np_random.random(self.dimensions)
            while self._at_goal():
                self._start = self.np_random.random(self.dimensions)
        self._move_distractors()

    def _move(self, action: int) -> tuple[float, bool]:
        axis, forwards = divmod(action, 2)
        self._moved[axis] = (self._moved[axis] + 2 * forwards - 1) % self.n_steps
        self._move_distractors()
        there = self._at_goal()
        return float(there), there

    def _move_distractors(self) -> None:
        self._distractors = self.np_random.random((self.n_distractors, self.dimensions))

    def _at_goal(self) -> bool:
        if self.goal is None:
            return False
        way = np.abs(self.position - self.goal)
        return bool(np.all(np.minimum(way, 1 - way) <= 0.5 / self.n_steps))

    def _seen(self) -> tuple[np.ndarray, dict[str, Any]]:
        return self.draw(self.position), {"position": self.position}

    def draw(self, position: Sequence[float] | np.ndarray) -> np.ndarray:
        """
        :param position: (dimensions,), in [0, 1)
        :return: the observation at that position, with the distractors of the last step, (size, size, 1), uint8
        :raises ValueError: if the position has the wrong shape or is out of range
        """
        disc = self._disc(check_position("position", position, self.dimensions))
        discs = [disc, *(DISTRACTOR_BRIGHTNESS * self._disc(place) for place in self._distractors)]
        return np.rint(255 * np.max(discs, axis=0)).astype(np.uint8)[:, :, None]

    def _disc(self, position: np.ndarray) -> np.ndarray:
        """How much of each pixel a disc at a position covers, in [0, 1]: (size, size)."""
        return np.clip(self.size / 8 + 0.5 - self._distance(position), 0, 1)

    def _distance(self, position: np.ndarray) -> np.ndarray:
        """The periodic distance from each pixel's centre to a position, in pixels: (size, size)."""
        centre = self.size * np.append(position, 0.5)[:2]  # in one dimension: horizontally centred
        way = np.abs(np.arange(self.size) + 0.5 - centre[:, None])  # (2, size)
        rows, columns = np.minimum(way, self.size - way)
        return np.hypot(rows[:, None], columns[None, :])

    def _picture(self) -> np.ndarray:
        picture = super()._picture()
        if self.goal is not None:
            ring = np.clip(1.5 - np.abs(self._distance(self.goal) - self.size / 8), 0, 1)
            picture[:, :, 1] = np.maximum(picture[:, :, 1], np.rint(110 * ring).astype(np.uint8))
        return picture
