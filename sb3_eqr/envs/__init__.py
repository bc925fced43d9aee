"""Environments. Importing this needs no extra; making an Atari environment needs ``pip install sb3-eqr[atari]``."""

from sb3_eqr.envs.atari import make_atari100k_env
from sb3_eqr.envs.blind_cliffwalk import BlindCliffwalk

__all__ = ["BlindCliffwalk", "make_atari100k_env"]
