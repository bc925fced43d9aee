"""What the environments with small images share."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_eqr.common.checks.arguments import check, integer

SMALLEST_PICTURE = 36  # smallest image that the default convolutions of CnnPolicy accept
ENLARGED = 4  # scale factor from an observation to a rendered image


class PixelEnv(gym.Env):
    """
    An environment whose observation is a small image, and whose ``info`` holds the true state. A subclass defines how an
    episode begins, what an action does, and what is seen; its docstring lists the actions and the options of ``reset``.

    :param size: height and width of the image, in pixels; at least 36
    :param channels: number of channels of the observation
    :param actions: the name of each action
    :param options: names of the options of ``reset``
    :param render_mode: "rgb_array" or ``None``
    :raises ValueError: if ``size`` is out of range
    """

    def __init__(self, size: int, channels: int, actions: Sequence[str], options: Sequence[str], render_mode: str | None):
        check("size", size, integer(SMALLEST_PICTURE))
        self.size = size
        self.render_mode = render_mode
        self.observation_space = spaces.Box(0, 255, (size, size, channels), np.uint8)
        self.action_space: spaces.Discrete = spaces.Discrete(len(actions))
        self._actions, self._options = actions, options

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """
        :param options: what is known of the first state; the rest is drawn
        :return: observation, (size, size, channels), uint8; the true state
        :raises ValueError: if an option is unknown or its value is invalid
        """
        super().reset(seed=seed)
        unknown = set(options or {}) - set(self._options)
        if unknown:
            legal = ", ".join(self._options)
            raise ValueError(f"options must only contain {legal}, got {', '.join(map(repr, sorted(unknown)))}.")
        self._begin(options or {})
        return self._seen()

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        :param action: a number or, as returned by SB3's ``predict``, an array of shape ()
        :return: observation, (size, size, channels), uint8; reward; terminated; truncated, always ``False``; the true state
        :raises ValueError: if the action is not in the action space
        """
        if not self.action_space.contains(action):
            raise ValueError(f"action must be in {self.action_space}, got {action!r}.")
        reward, terminated = self._move(int(action))
        observation, info = self._seen()
        return observation, reward, terminated, False, info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """:return: with ``render_mode="rgb_array"``: (4 size, 4 size, 3), uint8"""
        if self.render_mode is None:
            return None
        return self._picture().repeat(ENLARGED, axis=0).repeat(ENLARGED, axis=1)

    def get_action_meanings(self) -> list[str]:
        """:return: the name of each action, as in ALE's environments"""
        return list(self._actions)

    def _begin(self, options: dict[str, Any]) -> None:
        """Set the first state of an episode."""
        raise NotImplementedError

    def _move(self, action: int) -> tuple[float, bool]:
        """Change the state. Returns the reward and whether the episode terminates."""
        raise NotImplementedError

    def _seen(self) -> tuple[np.ndarray, dict[str, Any]]:
        """The observation and ``info`` of the present state."""
        raise NotImplementedError

    def _picture(self) -> np.ndarray:
        """What ``render`` enlarges, (size, size, 3), uint8: the observation, if it has colours, or its last channel."""
        observation, _ = self._seen()
        return observation if observation.shape[2] == 3 else observation[:, :, -1:].repeat(3, axis=2)


def check_position(name: str, position: Sequence[float] | np.ndarray, dimensions: int) -> np.ndarray:
    """
    :param position: fractions of a closed loop, one per axis
    :return: a copy, (dimensions,)
    :raises ValueError: if ``position`` is not ``dimensions`` numbers in [0, 1)
    """
    found = np.array(position)
    legal = found.shape == (dimensions,) and np.issubdtype(found.dtype, np.number) and np.isrealobj(found)
    if not legal or not np.all((found >= 0) & (found < 1)):
        raise ValueError(f"{name} must be an array of shape ({dimensions},) with values in [0, 1), got {position!r}.")
    return found.astype(np.float64)
