"""
Environments. Importing ``sb3_eqr`` registers those below and MinAtar's games with gymnasium, and needs no extra. Creating an
Atari environment needs ``pip install ".[atari]"`` in a clone of the repository, MinAtar's games ``pip install minatar``.
"""

import importlib
from collections.abc import Iterable
from typing import Any

import gymnasium as gym

from sb3_eqr.common.checks.arguments import nearest
from sb3_eqr.common.saving.env_state import ResumableWrapper
from sb3_eqr.envs import minatar
from sb3_eqr.envs.atari import make_atari100k_env
from sb3_eqr.envs.blind_cliffwalk import BlindCliffwalk
from sb3_eqr.envs.pixel_pendulum import PixelPendulum
from sb3_eqr.envs.planar_body import PlanarBody
from sb3_eqr.envs.sliding_ball import SlidingBall
from sb3_eqr.envs.star_field import StarField

# Keyword arguments for gymnasium.register. The goal in fractions of the loop, along both axes.
DISTRACTORS = {"dimensions": 2, "goal": [0.25, 0.25], "n_distractors": 8}
WORLDS: dict[str, dict[str, Any]] = {
    "BlindCliffwalk-v0": {"entry_point": "sb3_eqr.envs:BlindCliffwalk"},
    "SlidingBall-v0": {"entry_point": "sb3_eqr.envs:SlidingBall", "max_episode_steps": 100},
    "SlidingBallTorus-v0": {"entry_point": "sb3_eqr.envs:SlidingBall", "max_episode_steps": 100, "kwargs": {"dimensions": 2}},
    "SlidingBallDistractors-v0": {"entry_point": "sb3_eqr.envs:SlidingBall", "max_episode_steps": 100, "kwargs": DISTRACTORS},
    "PixelPendulum-v0": {"entry_point": "sb3_eqr.envs:PixelPendulum", "max_episode_steps": 200},
    "PlanarBody-v0": {"entry_point": "sb3_eqr.envs:PlanarBody", "max_episode_steps": 50},
    "PlanarBodyNoise-v0": {"entry_point": "sb3_eqr.envs:PlanarBody", "max_episode_steps": 50, "kwargs": {"n_noise": 20}},
    "StarField-v0": {"entry_point": "sb3_eqr.envs:StarField", "max_episode_steps": 100},
    "StarFieldRotations-v0": {
        "entry_point": "sb3_eqr.envs:StarField",
        "max_episode_steps": 100,
        "kwargs": {"translations": False},
    },
}


for env_id, arguments in {**WORLDS, **minatar.WORLDS}.items():
    if env_id not in gym.registry:
        gym.register(env_id, **arguments)


def import_packages(packages: Iterable[str]) -> None:
    """Import packages that register environments with gymnasium; raises ValueError if one cannot be imported."""
    for package in packages:
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise ValueError(
                f"--gym-packages: {package!r} cannot be imported ({error}). Install it, correct the name, or add its folder "
                "to PYTHONPATH."
            ) from error


def check_registered(env_id: str, where: str) -> None:
    """Raise ValueError, with ``where`` before its message, if an environment is unknown to gymnasium."""
    if env_id not in gym.registry:
        similar = nearest(env_id, gym.registry, cutoff=0.8)  # "-v0" alone makes any two alike
        raise ValueError(
            f"{where}: {env_id!r} is not registered with gymnasium.{similar} Environments of another package need "
            "--gym-packages PACKAGE, also to resume, and a file of yours its folder in PYTHONPATH; Atari needs pip install "
            '".[atari]" in a clone of the repository.'
        )


__all__ = [
    "BlindCliffwalk",
    "PixelPendulum",
    "PlanarBody",
    "ResumableWrapper",
    "SlidingBall",
    "StarField",
    "make_atari100k_env",
]
