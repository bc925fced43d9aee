"""The toy environment of prioritised replay: one successful transition among exponentially many failures."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_eqr.common.checks.arguments import check, integer


class BlindCliffwalk(gym.Env):
    """
    The blind cliffwalk (Schaul et al. 2016, Figure 1, https://arxiv.org/abs/1511.05952): in each of n states, one of two
    actions leads to the next state and the other ends the episode; only the right action in the last state is rewarded,
    with 1. A random policy succeeds once in 2ⁿ episodes.

    :param n_states: n ≥ 1
    :param seed: seed for drawing the right action of each state
    :param render_mode: "rgb_array": a row of squares with the current state in white
    :raises ValueError: if ``n_states`` is below 1
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}

    def __init__(self, n_states: int = 10, seed: int = 0, render_mode: str | None = None):
        check("n_states", n_states, integer(1))
        self.n_states = n_states
        self.render_mode = render_mode
        self.observation_space = spaces.Discrete(n_states)
        self.action_space = spaces.Discrete(2)
        self.right_actions = np.random.default_rng(seed).integers(0, 2, n_states)
        self.state = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
        """:return: the first state, 0, and an empty info"""
        super().reset(seed=seed)
        self.state = 0
        return self.state, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        """
        :param action: 0 or 1
        :return: next state (or the current one at the end of the episode), reward, terminated, truncated (always ``False``)
            and an empty info
        """
        if action != self.right_actions[self.state]:
            return self.state, 0.0, True, False, {}
        if self.state == self.n_states - 1:
            return self.state, 1.0, True, False, {}
        self.state += 1
        return self.state, 0.0, False, False, {}

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """:return: with ``render_mode="rgb_array"``: (32, 32 n_states, 3), uint8"""
        if self.render_mode is None:
            return None
        row = np.where(np.arange(self.n_states) == self.state, 255, 60).astype(np.uint8)
        return row[None, :, None].repeat(32, axis=0).repeat(32, axis=1).repeat(3, axis=2)

    def q_values(self, gamma: float) -> np.ndarray:
        """
        :param gamma: γ
        :return: the optimal Q values, (n_states, 2)
        """
        values = np.zeros((self.n_states, 2))
        values[np.arange(self.n_states), self.right_actions] = gamma ** np.arange(self.n_states)[::-1]
        return values
