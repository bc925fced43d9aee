"""The state of all random generators used in training."""

import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces


def get_rng_state(action_space: spaces.Space) -> dict[str, Any]:
    """The state of all generators used in training, including the action space's, from which SB3 draws random actions."""
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if th.cuda.is_available() else [],
        "action_space": action_space.np_random.bit_generator.state,
    }


def set_rng_state(state: dict[str, Any], action_space: spaces.Space) -> None:
    """Restore a state returned by :func:`get_rng_state`."""
    random.setstate(state["python"])
    if not 0 <= state["numpy"][2] <= 624:  # NumPy does not check it, and reads beyond its array
        raise ValueError(f"numpy must have a position in 0 to 624, got {state['numpy'][2]}.")
    np.random.set_state(state["numpy"])
    th.set_rng_state(state["torch"])
    if len(state["cuda"]) == th.cuda.device_count():
        th.cuda.set_rng_state_all(state["cuda"])
    action_space.np_random.bit_generator.state = state["action_space"]


@contextmanager
def preserved_rng_state(*action_spaces: spaces.Space) -> Iterator[None]:
    """Restore the state of all generators after the ``with`` block."""
    states = [get_rng_state(space) for space in action_spaces]
    try:
        yield
    finally:
        for state, space in zip(states, action_spaces, strict=True):
            set_rng_state(state, space)
