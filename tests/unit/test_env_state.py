"""The state of an environment, captured and restored into another one built in the same way: both then behave the same."""

import dataclasses
import enum
import json
import random
from collections import deque
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

from sb3_eqr import envs
from sb3_eqr.common.saving.env_state import MissingObjectError, capture, restore
from sb3_eqr.envs.minatar import ChannelsFirstImage
from tests.toys import ChainEnv, ImageEnv

envs.register()


def atari(seed):
    pytest.importorskip("ale_py")
    return envs.make_atari100k_env("Pong", n_envs=2, seed=seed)


def minatar(seed):
    pytest.importorskip("minatar")
    return VecFrameStack(make_vec_env("MinAtar/SpaceInvaders-v1", 2, seed, wrapper_class=ChannelsFirstImage), 2)


WORLDS = {
    "cartpole": lambda seed: VecNormalize(make_vec_env("CartPole-v1", 3, seed)),
    "acrobot": lambda seed: make_vec_env("Acrobot-v1", 2, seed),
    "lake": lambda seed: make_vec_env("FrozenLake-v1", 2, seed),
    "chain": lambda seed: make_vec_env(ChainEnv, 2, seed),
    "images": lambda seed: VecFrameStack(make_vec_env(ImageEnv, 2, seed), 4),
    "torus": lambda seed: make_vec_env("SlidingBallTorus-v0", 2, seed, env_kwargs={"goal": [0.5, 0.5], "n_distractors": 2}),
    "pendulum": lambda seed: make_vec_env("PixelPendulum-v0", 2, seed),
    "minatar": minatar,
    "atari": atari,
}


def play(env, actions):
    seen = []
    for action in actions:
        observations, rewards, dones, infos = env.step(action)
        infos = [{key: value for key, value in info.items() if key != "episode"} for info in infos]  # has wall-clock times
        seen.append((observations.copy(), rewards.copy(), dones.copy(), [sorted(info) for info in infos]))
    return seen


@pytest.mark.parametrize("name", WORLDS)
def test_original_and_restored_environment_behave_the_same(name):
    first, second = WORLDS[name](0), WORLDS[name](7)
    rng = np.random.default_rng(0)
    actions = rng.integers(first.action_space.n, size=(90, first.num_envs))
    first.reset()
    second.reset()
    play(first, actions[:37])
    play(second, actions[50:61])
    state, hidden = capture(first)
    assert not hidden
    text = json.dumps(state)
    assert '": "pickle"' not in text
    restore(second, json.loads(text))
    for (a, b, c, d), (e, f, g, h) in zip(play(first, actions[37:]), play(second, actions[37:]), strict=True):
        assert np.array_equal(a, e) and np.array_equal(b, f) and np.array_equal(c, g) and d == h


class Phase(enum.Enum):
    DAY, NIGHT = "day", "night"


class Tool(enum.IntEnum):
    NONE, KEY = 0, 1


class Pair(NamedTuple):
    x: int
    y: int


START = np.zeros(2)


@dataclasses.dataclass(frozen=True)
class Settings:
    size: int
    field: np.ndarray


class Room:
    def __init__(self, name):
        self.name, self.light = name, 0


class House:
    """An environment with state of many kinds."""

    def __init__(self):
        self.rng, self.weights = random.Random(3), th.zeros(2)
        self.phase, self.tool = Phase.DAY, Tool.NONE
        self.settings = Settings(4, np.zeros(2))
        self.rooms = [Room("hall"), Room("kitchen")]
        self.room = self.rooms[0]
        self.grid = np.zeros(3)
        self.shown = self.grid
        self.by_phase = {None: 0, ("a", 1): 2}
        self.body, self.last, self.noise, self.name, self.visited = [], None, None, None, set()
        self.pair = Pair(0, 0)
        self.pieces = np.zeros((2, 2))
        self.row = self.pieces[1]
        self.space = spaces.Dict(x=spaces.Discrete(1000, seed=3))
        self.place = START
        self.myself = self

    def live(self):
        self.rng.random()
        self.weights = self.weights + 1.5
        self.phase, self.tool = Phase.NIGHT, Tool.KEY
        self.room = self.rooms[1]
        self.room.light += 1
        self.settings.field[:] = 7
        self.grid[1] = 5
        self.by_phase[None] = 9
        self.body.append((1, 2))
        self.body.append(self.body)
        self.last, self.noise, self.name = (3, b"ab"), deque([1, 2], maxlen=2), b"x"
        self.visited.add((1, 2))
        self.pair = Pair(4, 5)
        self.row[:] = 6
        self.space.sample()
        self.place = self.place + 1


def moved(house):
    text = json.dumps(capture(house)[0])
    assert '": "pickle"' not in text
    fresh = House()
    restore(fresh, json.loads(text))
    return fresh


def test_values_of_many_kinds_are_restored():
    house = House()
    house.live()
    assert capture(house)[1] == []
    other = moved(house)
    assert other.rng.random() == house.rng.random()
    assert other.weights.tolist() == [1.5, 1.5]
    assert other.phase is Phase.NIGHT and other.tool is Tool.KEY and [phase.value for phase in Phase] == ["day", "night"]
    assert other.room is other.rooms[1] and [room.light for room in other.rooms] == [0, 1]
    assert other.settings.size == 4 and other.settings.field.tolist() == [7, 7]
    assert other.shown is other.grid and other.grid.tolist() == [0, 5, 0]
    assert other.by_phase == {None: 9, ("a", 1): 2} and other.myself is other
    assert other.body[0] == (1, 2) and type(other.body[0]) is tuple and other.body[1] is other.body
    assert (other.last, other.noise, other.name) == ((3, b"ab"), deque([1, 2]), b"x") and other.noise.maxlen == 2
    assert other.visited == {(1, 2)} and other.pair == Pair(4, 5) and type(other.pair) is Pair
    other.row[:] = 8
    assert other.pieces.tolist() == [[0, 0], [8, 8]]  # still a view
    assert other.space.sample() == house.space.sample()
    assert other.place.tolist() == [1, 1] and START.tolist() == [0, 0]


def test_objects_that_only_the_original_run_created_are_named():
    house = House()
    house.rooms.append(Room("attic"))
    with pytest.raises(MissingObjectError, match=r"House.rooms\[2\] must be the original object"):
        moved(house)


def test_objects_that_the_run_moved_to_the_place_of_others_are_named():
    class Flat:
        def __init__(self):
            self.room = None
            self.rooms = [Room("hall"), Room("kitchen")]
            self.room = self.rooms[0]

    flat, fresh = Flat(), Flat()
    state = capture(flat)[0]
    restore(fresh, state)
    assert fresh.room is fresh.rooms[0]
    flat.room = flat.rooms[1]
    with pytest.raises(MissingObjectError, match=r"Flat.rooms\[0\]"):
        restore(Flat(), capture(flat)[0])


def test_objects_with_state_in_c_are_named(tmp_path):
    class Queue(bytearray):
        pass

    class Generator(random.Random):
        pass

    class Slotted:
        __slots__ = ("__dict__", "speed")

    house = House()
    house.queue, house.slotted, house.plain = Queue(b"ab"), Slotted(), Room("x")
    house.generator, house.masked = Generator(3), np.ma.masked_array([1, 2], [True, False])
    (tmp_path / "steps.txt").write_text("1 2 3")
    with open(tmp_path / "steps.txt") as house.file:
        assert capture(house)[1] == [".queue", ".slotted", ".generator", ".masked", ".file"]
    assert ".file" not in capture(house)[1]  # a closed file has no state


def test_state_that_cannot_be_captured_is_named():
    pytest.importorskip("Box2D")
    env = make_vec_env("LunarLander-v3", 1)
    env.reset()
    _, hidden = capture(env)
    assert any("world" in path for path in hidden)


def test_a_different_environment_raises():
    first, second = (
        make_vec_env("CartPole-v1", 1),
        make_vec_env("CartPole-v1", 1, wrapper_class=gym.wrappers.FlattenObservation),
    )
    first.reset()
    second.reset()
    state, _ = capture(second)
    with pytest.raises(ValueError, match="must be an object, got nothing: the environment is not built as"):
        restore(first, state)


def attributes(number, **children):
    return {":kind:": "attributes", ":number:": number, **children}


@pytest.mark.parametrize("name", ["step", "render", "__class__", "__dict__", "spec", "unwrapped", "helper", "library"])
def test_a_file_reaches_no_method_function_or_module(name):
    """From any of them a file could reach ``os.system``; what is named like them is not replaced either."""
    env = ChainEnv()
    env.helper, env.library = np.zeros, json
    before = dict(vars(env))
    for child in (attributes(1, __globals__={":kind:": "dict", ":class:": "dict"}), {":kind:": "plain", "value": 1}):
        with pytest.raises(ValueError, match=rf"ChainEnv\.{name} must be state of an environment, got a method"):
            restore(env, attributes(0, **{name: child}))
    assert vars(env).keys() == before.keys() and all(vars(env)[key] is value for key, value in before.items())


def test_bytes_of_an_emulator_are_restored_into_an_emulator_only():
    class Trap:
        def cloneSystemState(self):
            raise AssertionError("was run")

    env = ChainEnv()
    env.trap = Trap()
    with pytest.raises(ValueError, match=r"ChainEnv\.trap must be an emulator of ale-py, got Trap"):
        restore(env, attributes(0, trap={":kind:": "emulator", "value": "00"}))
