"""The pendulum of the paper (Example 1) with image observations: it has the symmetries of O(2) without gravity."""

from math import cos, pi, remainder, sin
from typing import Any

import numpy as np

from sb3_eqr.common.checks.arguments import check, integer, number
from sb3_eqr.envs.pixels import PixelEnv

# The constants of gymnasium's Pendulum-v1; mass and length are 1.
GRAVITY = 10.0  # m/s²
TIME_STEP = 0.05  # s
MAX_SPEED = 8.0  # rad/s
MAX_TORQUE = 2.0  # N m
FREE_MAX_TORQUE = 5.0  # N m; in one step, this moves the tip of the rod by 0.7 of 48 pixels; 2 N m would move it by 0.3


class PixelPendulum(PixelEnv):
    """
    A rod that turns about the centre of the image (EqR, §5, Example 1 and Figure 2), with the dynamics of
    gymnasium's Pendulum-v1 and discrete torques.

    The angle is in radians, 0 upright, positive anticlockwise, in [−π, π]; the angular velocity in rad/s, in [−8, 8].
    A step of 0.05 s is semi-implicit: ω' = ω + (15 sin θ + 3 u) 0.05, clipped, then θ' = θ + 0.05 ω'. Without gravity, the
    sine term vanishes: rotating the system does not change the effect of an action, and mirroring it,
    (θ, ω, u) → (−θ, −ω, −u), negates the torque. With gravity, only the reflection about the vertical remains a symmetry.

    The observation is (size, size, 2), uint8: the previous and the current frame, so that the velocity is observable.
    ``info`` holds the true "angle" and "velocity". No episode terminates. Options of ``reset``: {"angle": any angle in
    radians; "velocity": in [−8, 8] rad/s}. Missing values are drawn uniformly as in Pendulum-v1: from [−π, π] and [−1, 1].

    :param gravity: whether gravity acts. If so, torques are at most 2 N m, too weak to lift the rod at once, and the reward
        is that of Pendulum-v1, −(θ² + 0.1 ω² + 0.001 u²) of the state before the step, in [−16.3, 0]. Otherwise torques are
        at most 5 N m, and the reward is 0, because any preferred state would break the symmetry.
    :param size: height and width of the image, in pixels; at least 36
    :param n_torques: number of actions, evenly spaced from the most negative torque (action 0, clockwise) to the most
        positive one; odd, at least 3: the middle one is no torque
    :param render_mode: "rgb_array": the current frame, enlarged
    :raises ValueError: if an argument is out of range
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20, "periods": {"angle": 2 * pi}}

    def __init__(self, gravity: bool = True, size: int = 48, n_torques: int = 3, render_mode: str | None = None):
        check("n_torques", n_torques, integer(3))
        if n_torques % 2 == 0:
            raise ValueError(f"n_torques must be odd, so that the middle torque is 0, got {n_torques}.")
        middle = n_torques // 2
        # Not linspace, so that the two halves are exact negatives of each other.
        self.torques = (MAX_TORQUE if gravity else FREE_MAX_TORQUE) * (np.arange(n_torques) - middle) / middle
        super().__init__(size, 2, [f"{torque:+.3g}" for torque in self.torques], ["angle", "velocity"], render_mode)  # in N m
        self.gravity = gravity
        self.angle = 0.0
        self.velocity = 0.0

    def _begin(self, options: dict[str, Any]) -> None:
        # Always draw both, so that setting one option does not change the other draw.
        drawn = {"angle": self.np_random.uniform(-pi, pi), "velocity": self.np_random.uniform(-1, 1)}
        state = {**drawn, **options}
        check("angle", state["angle"], number())
        check("velocity", state["velocity"], number(-MAX_SPEED, MAX_SPEED))
        self.angle = remainder(state["angle"], 2 * pi)
        self.velocity = float(state["velocity"])

    def _move(self, action: int) -> tuple[float, bool]:
        torque = float(self.torques[action])
        cost = self.angle**2 + 0.1 * self.velocity**2 + 0.001 * torque**2
        weight = 1.5 * GRAVITY * sin(self.angle) if self.gravity else 0.0
        velocity = self.velocity + (weight + 3 * torque) * TIME_STEP
        self.velocity = min(max(velocity, -MAX_SPEED), MAX_SPEED)
        # remainder, unlike %, is exact and odd, so mirrored states stay mirrored.
        self.angle = remainder(self.angle + self.velocity * TIME_STEP, 2 * pi)
        return -cost if self.gravity else 0.0, False

    def _seen(self) -> tuple[np.ndarray, dict[str, Any]]:
        return self.draw(self.angle, self.velocity), {"angle": self.angle, "velocity": self.velocity}

    def draw(self, angle: float, velocity: float) -> np.ndarray:
        """
        :param angle: any angle, in radians
        :param velocity: in rad/s; the previous angle is ``angle`` − 0.05 ``velocity``, which is exact after a step
        :return: the observation in that state, (size, size, 2), uint8
        """
        return np.stack([self._rod(angle - velocity * TIME_STEP), self._rod(angle)], axis=2)

    def _rod(self, angle: float) -> np.ndarray:
        """An image of the rod at an angle: (size, size), uint8."""
        along = np.array([-cos(angle), -sin(angle)])  # rows count downwards, so upright is −1
        centred = np.arange(self.size) + 0.5 - self.size / 2
        rows, columns = centred[:, None], centred[None, :]
        # The nearest point of the rod, then the distance to it, in pixels.
        nearest = np.clip(rows * along[0] + columns * along[1], 0, 0.4 * self.size)
        distance = np.hypot(rows - nearest * along[0], columns - nearest * along[1])
        return np.rint(255 * np.clip(self.size / 24 + 0.5 - distance, 0, 1)).astype(np.uint8)
