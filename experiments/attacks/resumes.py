"""Runs that stop and are resumed in a new process: they end with the parameters of runs that did not stop."""

import multiprocessing
import pathlib
import shutil
from collections.abc import Callable
from functools import partial
from typing import Any

import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecFrameStack, VecNormalize

from experiments.attacks import Finding, are_equal, make
from sb3_eqr import EqRQRDQN, EqRRainbow, ExactCheckpointCallback
from sb3_eqr.common.saving.checkpoints import find_checkpoints
from sb3_eqr.envs import ResumableWrapper, make_atari100k_env, register
from sb3_eqr.envs.minatar import ChannelsFirstImage

AGENTS: dict[str, Any] = {"EqRQRDQN": EqRQRDQN, "EqRRainbow": EqRRainbow}
STEPS, STOP = 1_200, 600
IMAGES: dict[str, Any] = {"features_extractor_kwargs": {"layers": [[4, 3, 2]]}}


def normalized(n_envs: int) -> VecEnv:
    """CartPole with ``VecNormalize``."""
    return VecNormalize(make_vec_env("CartPole-v1", n_envs))


def parallel(n_envs: int) -> VecEnv:
    """CartPole in processes of its own."""
    return make_vec_env("CartPole-v1", n_envs, vec_env_cls=SubprocVecEnv, wrapper_class=ResumableWrapper)


def minatar(n_envs: int) -> VecEnv:
    """MinAtar's Breakout, two frames stacked."""
    return VecFrameStack(make_vec_env("MinAtar/Breakout-v1", n_envs, wrapper_class=ChannelsFirstImage), 2)


# name -> environments of a given number; all but CartPole's are images
WORLDS: dict[str, Callable[..., VecEnv]] = {
    "CartPole (Monitor, TimeLimit)": partial(make_vec_env, "CartPole-v1"),
    "CartPole (VecNormalize)": normalized,
    "CartPole (SubprocVecEnv)": parallel,
    "MinAtar Breakout (VecFrameStack)": minatar,
    "Atari's Breakout (VecFrameStack)": partial(make_atari100k_env, "Breakout"),
    "sliding ball": partial(make_vec_env, "SlidingBallTorus-v0"),
}


def train(agent: str, world: str, n_envs: int, folder: pathlib.Path, is_resumed: bool) -> None:
    """Train an agent to the end, or resume it from the checkpoint in ``folder``, and save it there."""
    th.set_num_threads(1)
    register()
    env = WORLDS[world](n_envs=n_envs)
    if is_resumed:
        model = AGENTS[agent].resume(folder, env)
    else:
        policy, networks = ("MlpPolicy", {}) if world.startswith("CartPole") else ("CnnPolicy", IMAGES)
        options: dict[str, Any] = {"buffer_size": 2_000, "batch_size": 8, "learning_starts": 40, "n_steps": 3, "train_freq": 4}
        model = make(AGENTS[agent], env, policy, **options, policy_kwargs=networks, seed=3, device="cpu")
    name = folder / ("resumed" if is_resumed else "whole")
    callback = ExactCheckpointCallback(STOP, folder, keep=2)
    model.learn(STEPS - model.num_timesteps, callback, reset_num_timesteps=False).save(name)
    env.close()
    for later in find_checkpoints(folder)[1:]:  # as if the run had stopped after its first checkpoint
        shutil.rmtree(later)


def resumed_runs(folder: pathlib.Path) -> Finding:
    """Each agent in each world, with one environment and with four."""
    context = multiprocessing.get_context("spawn")
    runs = [(agent, world, n_envs) for agent in AGENTS for world in WORLDS for n_envs in (1, 4)]
    wrong = []
    for i, (agent, world, n_envs) in enumerate(runs):
        for is_resumed in (False, True):
            process = context.Process(target=train, args=(agent, world, n_envs, folder / str(i), is_resumed))
            process.start()
            process.join()
        whole, resumed = (AGENTS[agent].load(folder / str(i) / name) for name in ("whole", "resumed"))
        if resumed._n_updates != whole._n_updates or not are_equal(whole.policy.state_dict(), resumed.policy.state_dict()):
            wrong.append(f"{agent}, {world}, {n_envs} environments")
    name = f"{len(runs)} runs, stopped half-way and resumed in a new process ({', '.join(WORLDS)}; 1 and 4 environments)"
    return Finding(name, "equal bits", f"{len(runs) - len(wrong)} of {len(runs)} equal bits", wrong)
