"""MinAtar (Young and Tian 2019, https://arxiv.org/abs/1903.03176): five small Atari games of 10×10 pixels."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

PIXELS = 32  # size of one pixel of the game in the rendered image
GAMES = {game.title().replace("_", ""): game for game in ("asterix", "breakout", "freeway", "seaquest", "space_invaders")}
# The games under MinAtar's own names, "MinAtar/<Game>-v0" with all six actions and "-v1" with fewer, for gymnasium.register.
WORLDS = {
    f"MinAtar/{name}-{version}": {
        "entry_point": "minatar.gym:BaseEnv",
        "kwargs": {"game": game, "use_minimal_action_set": minimal},
    }
    for name, game in GAMES.items()
    for version, minimal in (("v0", False), ("v1", True))
}


class ChannelsFirstImage(gym.ObservationWrapper):
    """
    Convert MinAtar's observations to channels-first images, for ``CnnPolicy``.

    :param env: environment with observations of shape (height, width, channels), bool
    """

    def __init__(self, env: gym.Env):
        super().__init__(env)
        assert env.observation_space.shape is not None
        height, width, channels = env.observation_space.shape
        self.observation_space = spaces.Box(0, 255, (channels, height, width), np.uint8)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """
        :param observation: (height, width, channels), bool
        :return: (channels, height, width), uint8: 0 or 255
        """
        return np.moveaxis(observation, 2, 0).astype(np.uint8) * np.uint8(255)

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """:return: with ``render_mode="rgb_array"``: (320, 320, 3), uint8; MinAtar itself returns 10×10 floats in [0, 1]"""
        picture = self.env.render()
        if not isinstance(picture, np.ndarray) or self.render_mode != "rgb_array":
            return None
        return (255 * picture).astype(np.uint8).repeat(PIXELS, axis=0).repeat(PIXELS, axis=1)
