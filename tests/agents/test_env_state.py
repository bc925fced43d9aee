"""The state of an environment, captured and restored into another one built in the same way: both then behave the same."""

import json
import os

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecMonitor, VecNormalize

from sb3_eqr.common.saving.env_state import ATTRIBUTES, capture, restore
from sb3_eqr.envs import ResumableWrapper
from sb3_eqr.envs.atari import Atari100kWrapper
from sb3_eqr.envs.minatar import GAMES, ChannelsFirstImage
from tests.toys import FORK, ChainEnv, DictEnv, ImageEnv

TORUS = {"goal": [0.5, 0.5], "n_distractors": 2}


def atari(seed):
    pytest.importorskip("ale_py")
    return VecFrameStack(make_vec_env("BreakoutNoFrameskip-v4", 2, seed, wrapper_class=Atari100kWrapper), 4)


def minatar(game):
    def make(seed):
        pytest.importorskip("minatar")
        return VecFrameStack(make_vec_env(f"MinAtar/{game}-v1", 2, seed, wrapper_class=ChannelsFirstImage), 2)

    return make


def timed(env):
    return wrappers.TimeAwareObservation(wrappers.RecordEpisodeStatistics(wrappers.FlattenObservation(env)))


MUJOCO = ("HalfCheetah-v5", "Ant-v5", "Humanoid-v5", "Reacher-v5")
IDS = ("Acrobot-v1", "MountainCar-v0", "FrozenLake-v1", "Taxi-v4", "CliffWalking-v1", "StarField-v0", *MUJOCO)
WORLDS = {
    "cartpole": lambda seed: VecNormalize(make_vec_env("CartPole-v1", 4, seed)),
    "processes": lambda seed: VecNormalize(
        make_vec_env("CartPole-v1", 2, seed, vec_env_cls=SubprocVecEnv, wrapper_class=ResumableWrapper)
    ),
    "statistics": lambda seed: VecMonitor(DummyVecEnv([lambda: timed(gym.make("CartPole-v1"))])),
    **{name: lambda seed, name=name: make_vec_env(name, 2, seed) for name in IDS},
    "chain": lambda seed: make_vec_env(ChainEnv, 2, seed),
    "torus": lambda seed: make_vec_env("SlidingBallTorus-v0", 2, seed, env_kwargs=TORUS),
    "pendulum": lambda seed: VecFrameStack(make_vec_env("PixelPendulum-v0", 2, seed), 4),
    "cliffwalk": lambda seed: make_vec_env("BlindCliffwalk-v0", 2, seed),
    **{f"minatar {game}": minatar(game) for game in GAMES},
    "planar body": lambda seed: make_vec_env("PlanarBodyNoise-v0", 2, seed),
    "atari": atari,
}


def play(env, actions):
    seen = []
    for action in actions:
        observations, rewards, dones, infos = env.step(action)
        infos = [{key: value for key, value in info.items() if key not in ("episode", "t")} for info in infos]  # wall-clock
        observations = observations if isinstance(observations, dict) else {"": observations}
        seen.append(({k: x.copy() for k, x in observations.items()}, rewards.copy(), dones.copy(), [sorted(i) for i in infos]))
    return seen


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "processes" else ()) for name in WORLDS]
)
def test_original_and_restored_environment_behave_the_same(name):
    first, second = WORLDS[name](0), WORLDS[name](7)
    rng, n_steps = np.random.default_rng(0), 190 if name == "atari" else 90  # five lives, and a new game
    if isinstance(first.action_space, gym.spaces.Box):
        actions = rng.uniform(-1, 1, (n_steps, first.num_envs, *first.action_space.shape)).astype(np.float32)
    else:
        actions = rng.integers(first.action_space.n, size=(n_steps, first.num_envs))
    first.reset()
    second.reset()
    play(first, actions[:37])
    play(second, actions[50:61])
    state, unknown = capture(first)
    assert not unknown
    text = json.dumps(state)
    assert '": "pickle"' not in text
    restore(second, json.loads(text), wrappers_only=False)
    for (a, b, c, d), (e, f, g, h) in zip(play(first, actions[37:]), play(second, actions[37:]), strict=True):
        assert all(np.array_equal(a[key], e[key]) for key in a | e)
        assert np.array_equal(b, f) and np.array_equal(c, g) and d == h
    first.close(), second.close()


@pytest.mark.parametrize("make", [DictEnv, ImageEnv])
def test_an_unknown_class_is_named_and_its_wrappers_are_restored(make):
    first, second = (VecNormalize(make_vec_env(make, 1), norm_obs=make is DictEnv) for _ in range(2))
    first.reset(), second.reset()
    play(first, [[0]] * 5)
    state, unknown = capture(first)
    assert unknown == [f"tests.toys.{make.__name__}"]
    restore(second, state, wrappers_only=True)
    assert second.ret_rms.count == first.ret_rms.count > 1
    hidden = SubprocVecEnv([make], **FORK)
    assert capture(hidden)[1] == ["stable_baselines3.common.vec_env.subproc_vec_env.SubprocVecEnv"]
    hidden.close()


def test_parameters_belong_to_the_new_environment():
    def shorter(env):
        env.unwrapped.gravity = 25.0
        return env

    first = make_vec_env("CartPole-v1", 1)
    second = make_vec_env("CartPole-v1", 1, wrapper_class=shorter, env_kwargs={"max_episode_steps": 50})
    first.reset(), second.reset()
    play(first, [[0], [1], [0]])
    restore(second, capture(first)[0], wrappers_only=False)
    env = second.envs[0].unwrapped
    assert (env.gravity, second.envs[0].spec.max_episode_steps) == (25.0, 50)
    assert second.get_attr("_max_episode_steps") == [50] and second.get_attr("_elapsed_steps") == [3]


def test_a_different_environment_raises():
    first = make_vec_env("CartPole-v1", 1)
    flat = make_vec_env("CartPole-v1", 1, wrapper_class=gym.wrappers.FlattenObservation)
    for env in (first, flat):
        env.reset()
    with pytest.raises(ValueError, match=r"env must be FlattenObservation in .* got Monitor in .* is not built as in"):
        restore(first, capture(flat)[0], wrappers_only=False)
    with pytest.raises(ValueError, match="n_envs must be 1, as in the original run, got 2"):
        restore(make_vec_env("CartPole-v1", 2), capture(first)[0], wrappers_only=False)


def changed(state, name, value):
    """The state with another value of an attribute of the innermost environment or of a wrapper."""
    state = json.loads(json.dumps(state))
    for _, found in state["envs"][0]:
        if name in found:
            found[name] = value
    return state


OS = {":kind:": "object", "module": "os", "name": "system", "attributes": {}}
FORGED = [
    ("state", OS),
    ("state", "text"),
    ("state", {":kind:": "class", "module": "torch.nn", "name": "Linear"}),
    ("state", {":kind:": "array", "dtype": "<f8", "shape": [2], "data": "AAAAAAAAAAAAAAAAAAAAAA=="}),
    ("steps_beyond_terminated", [1]),
    ("_elapsed_steps", 1.5),
    ("np_random", {"bit_generator": "PCG64", "state": "x"}),
    ("np_random", [OS]),
]


@pytest.mark.parametrize(("name", "value"), FORGED, ids=str)
def test_a_value_of_another_kind_raises(name, value):
    env = make_vec_env("CartPole-v1", 1)
    env.reset()
    before = env.envs[0].unwrapped.state.copy()
    with pytest.raises(ValueError):
        restore(env, changed(capture(env)[0], name, value), wrappers_only=False)
    assert name == "np_random" or (env.envs[0].unwrapped.state == before).all()


@pytest.mark.parametrize("name", ["step", "render", "__class__", "__dict__", "spec", "gravity", "reset", "unwrapped"])
def test_a_file_names_no_other_attribute(name):
    """From a method, a file could reach ``os.system``."""
    env = make_vec_env("CartPole-v1", 1)
    env.reset()
    state, _ = capture(env)
    for layer in state["envs"][0]:
        before = dict(layer[1])
        layer[1][name] = {":kind:": "dict", "items": []}
        with pytest.raises(ValueError, match=r"must be restored from \["):
            restore(env, state, wrappers_only=False)
        layer[1] = before


def test_a_generators_position_outside_its_array_raises():
    pytest.importorskip("minatar")
    env = make_vec_env("MinAtar/Breakout-v1", 1)
    env.reset()
    state = json.loads(json.dumps(capture(env)[0]))
    state["envs"][0][-1][1]["game"]["random"]["state"]["pos"] = 10**6
    with pytest.raises(ValueError, match="pos of a generator must be in 0 to 624, got 1000000"):
        restore(env, state, wrappers_only=False)


def test_bytes_of_an_emulator_are_restored_into_an_emulator_only():
    pytest.importorskip("ale_py")
    env = atari(0)
    env.reset()
    for text in ("00", "ff" * 300, "zz", os.urandom(3000).hex()):
        with pytest.raises((ValueError, RuntimeError)):
            restore(env, changed(capture(env)[0], "ale", text), wrappers_only=False)


def test_state_dict_must_be_plain():
    env = ChainEnv()
    env.state_dict = lambda: [ChainEnv()]
    with pytest.raises(ValueError, match=r"ChainEnv\.state_dict must return numbers, strings, arrays and containers"):
        capture(make_vec_env(lambda: env, 1))


def test_a_mistake_in_load_state_dict_is_not_blamed_on_the_checkpoint():
    env = ChainEnv()
    env.state_dict, env.load_state_dict = dict, lambda state: state["position"]
    envs = make_vec_env(lambda: env, 1)
    with pytest.raises(
        ValueError, match=r"ChainEnv\.load_state_dict must load what its state_dict returned, got KeyError\('position'"
    ):
        restore(envs, capture(envs)[0], wrappers_only=False)


def test_the_table_names_only_known_types():
    kinds = {kind for row in ATTRIBUTES.values() for entry in row.values() for kind in entry.removesuffix("?").split("/")}
    assert kinds == {"int", "real", "bool", "array", "list", "tuple", "part"}


def test_the_generator_of_an_environment_with_state_dict_is_restored():
    env = make_vec_env(ChainEnv, 2, seed=3)
    env.reset()
    state, unknown = capture(env)
    drawn = [one.unwrapped.np_random.random() for one in env.envs]
    assert not unknown and [one.unwrapped.np_random.random() for one in env.envs] != drawn
    restore(env, state, wrappers_only=False)
    assert [one.unwrapped.np_random.random() for one in env.envs] == drawn
