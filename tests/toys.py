"""Small environments for the tests."""

from collections import OrderedDict

import gymnasium as gym
import numpy as np
from gymnasium import spaces

FORK = {"start_method": "fork"}  # of SubprocVecEnv: by default, each process imports PyTorch anew


class ChainEnv(gym.Env):
    """A noisy walk whose complete state can be read and set. Episodes end at either side or with a time-out."""

    def __init__(self, length: int = 20):
        self.observation_space = spaces.Box(-1, 1, (3,), np.float32)
        self.action_space = spaces.Discrete(3)
        self.length = length
        self.rng = np.random.default_rng(0)
        self.position, self.time = 0.0, 0

    def state_dict(self):
        return self.position, self.time, self.rng.bit_generator.state

    def load_state_dict(self, state):
        self.position, self.time, self.rng.bit_generator.state = state

    def observe(self):
        return np.array([self.position, np.sin(3 * self.position), self.time / self.length], dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.position, self.time = float(self.rng.uniform(-0.3, 0.3)), 0
        return self.observe(), {}

    def step(self, action):
        self.position = float(np.clip(self.position + 0.2 * (int(action) - 1) + self.rng.normal(0, 0.05), -1, 1))
        self.time += 1
        terminated = abs(self.position) >= 1
        return self.observe(), self.position, terminated, self.time >= self.length and not terminated, {}


class PoisonEnv(ChainEnv):
    """Returns a bad value at a chosen step: ``where`` is "obs", "reward", "terminal" or "reset"."""

    def __init__(self, where: str, value: float = np.nan, at: int = 50):
        super().__init__()
        self.where, self.value, self.at, self.steps = where, value, at, 0

    def reset(self, *, seed=None, options=None):
        obs, info = super().reset(seed=seed, options=options)
        return (obs * self.value if self.where == "reset" else obs), info

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        self.steps += 1
        if self.steps == self.at:
            if self.where in ("obs", "terminal"):
                obs, terminated = obs * self.value, terminated or self.where == "terminal"
            elif self.where == "reward":
                reward = self.value
        return obs, reward, terminated, truncated, info


class SampledEnv(gym.Env):
    """Samples of a space; episodes of a fixed length, every other one truncated. The reward grows to 1."""

    def __init__(self, space, length=10):
        self.observation_space, self.action_space = space, spaces.Discrete(3)
        self.length, self.n_episodes = length, 0

    def observe(self):
        return self.observation_space.sample()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.time = 0
        return self.observe(), {}

    def step(self, action):
        self.time += 1
        ends = self.time == self.length
        self.n_episodes += ends
        truncated = ends and self.n_episodes % 2 == 1
        return self.observe(), self.time / self.length, ends and not truncated, truncated, {}


class ImageEnv(SampledEnv):
    """Images, channels first or last."""

    def __init__(self, shape=(36, 36, 1), length=7, dtype=np.uint8):
        super().__init__(spaces.Box(0, 255 if dtype == np.uint8 else 1, shape, dtype), length)


class DictEnv(SampledEnv):
    """Numbers under keys that are not sorted."""

    def __init__(self, keys: tuple[str, ...] = ("velocity", "angle")):
        super().__init__(spaces.Dict(OrderedDict((key, spaces.Box(-1, 1, (1,))) for key in keys)))


class IntegerEnv(SampledEnv):
    """Integers, one of them Discrete and a Python int, as many environments return it."""

    def __init__(self):
        super().__init__(spaces.Dict({"count": spaces.Box(-9, 9, (2,), np.int64), "kind": spaces.Discrete(8)}), length=7)

    def observe(self):
        return {**super().observe(), "kind": self.time}
