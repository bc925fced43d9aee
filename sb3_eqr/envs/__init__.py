"""Environments. Importing this needs no extra; making an Atari environment needs ``pip install sb3-eqr[atari]``."""

import gymnasium as gym

from sb3_eqr.envs.atari import make_atari100k_env
from sb3_eqr.envs.blind_cliffwalk import BlindCliffwalk
from sb3_eqr.envs.minatar import register_minatar


def register() -> None:
    """Register with gymnasium: BlindCliffwalk-v0, and MinAtar's games (making one needs ``pip install minatar``)."""
    if "BlindCliffwalk-v0" not in gym.registry:
        gym.register("BlindCliffwalk-v0", entry_point="sb3_eqr.envs.blind_cliffwalk:BlindCliffwalk")
    register_minatar()


__all__ = ["BlindCliffwalk", "make_atari100k_env", "register"]
