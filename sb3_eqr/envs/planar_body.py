"""A body in the plane whose velocities are commanded in its own frame: the effect of an action is one element of SE(2)."""

from math import cos, pi, remainder, sin
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_eqr.common.checks.arguments import Rule, check, integer, number

SPEED = 0.2  # units of length per step, at full command
TURN = 0.5  # radians per step, at full command
START = 1.0  # bodies start in a square of this half-width
POSITION = Rule("two finite numbers", lambda value: len(value) == 2 and all(number().holds(part) for part in value))


class PlanarBody(gym.Env):
    """
    A body with position (x, y) and angle θ is driven to the origin. Its pose is the element g of SE(2), and a step multiplies
    it from the right by exp of the commanded velocity, g' = g exp(a): the body moves along an arc. So g⁻¹ is multiplied from
    the left by exp(−a), whatever the pose: a latent state g⁻¹ with κ(a) = exp(−a) predicts exactly.

    The action is (forward, turn), each in [-1, 1]: at 1, 0.2 units of length and 0.5 radians in a step. The observation is
    (x, y, cos θ, sin θ), followed by normal noise that the body does not control. The reward is the negative distance to the
    origin after the step. ``info`` holds the true "position", (2,), and "angle", in radians in [−π, π]. No episode terminates.
    Options of ``reset``: {"position": (2,), "angle": any}; missing values are drawn uniformly, from [−1, 1]² and [−π, π].

    :param n_noise: number of noise dimensions, ≥ 0
    :raises ValueError: if an argument is out of range
    """

    metadata = {"render_modes": [], "periods": {"angle": 2 * pi}}

    def __init__(self, n_noise: int = 0):
        check("n_noise", n_noise, integer(0))
        self.n_noise = n_noise
        self.observation_space = spaces.Box(-np.inf, np.inf, (4 + n_noise,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.position = np.zeros(2)
        self.angle = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """As in gymnasium."""
        super().reset(seed=seed)
        drawn = {"position": self.np_random.uniform(-START, START, 2), "angle": self.np_random.uniform(-pi, pi)}
        if unknown := set(options or {}) - set(drawn):
            raise ValueError(f"options must only contain position, angle, got {', '.join(map(repr, sorted(unknown)))}.")
        state = {**drawn, **(options or {})}
        check("angle", state["angle"], number())
        check("position", list(state["position"]), POSITION)
        self.position, self.angle = np.array(state["position"], dtype=float), remainder(state["angle"], 2 * pi)
        return self._seen()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """As in gymnasium; commands are clipped to [-1, 1]."""
        forward, turn = np.clip(action, -1.0, 1.0) * (SPEED, TURN)
        chord = forward * np.sinc(turn / (2 * pi))  # of the arc; sinc(x) = sin(πx) / (πx)
        heading = self.angle + turn / 2
        self.position = self.position + chord * np.array([cos(heading), sin(heading)])
        self.angle = remainder(self.angle + turn, 2 * pi)
        observation, info = self._seen()
        return observation, -float(np.hypot(*self.position)), False, False, info

    def _seen(self) -> tuple[np.ndarray, dict[str, Any]]:
        noise = self.np_random.normal(size=self.n_noise)
        observation = np.concatenate([self.position, [cos(self.angle), sin(self.angle)], noise])
        return observation.astype(np.float32), {"position": self.position.copy(), "angle": self.angle}
