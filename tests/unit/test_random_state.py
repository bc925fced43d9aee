"""The random generators of training."""

import random

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_eqr.common.saving.random_state import preserved_rng_state


def test_all_generators_are_restored():
    space = spaces.Discrete(10**9, seed=0)

    def draws():
        return random.random(), np.random.rand(), th.rand(1).item(), int(space.sample())

    with preserved_rng_state(space):
        inside = draws()
        draws()
    after = draws()
    assert after == inside
    assert all(a != b for a, b in zip(after, draws(), strict=True))
