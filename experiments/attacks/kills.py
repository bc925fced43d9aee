"""Runs that are killed at random times, or stop and are resumed: nothing may be lost, and no result may change."""

import json
import multiprocessing
import os
import pathlib
import random
import shutil
import signal
from collections.abc import Callable
from functools import partial
from typing import Any

from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecFrameStack, VecNormalize

from experiments.attacks import Finding, are_equal, finish, partial_files
from sb3_eqr import EqRQRDQN, EqRRainbow
from sb3_eqr.benchmark.runs import RESULT, Run, Settings, plan_runs
from sb3_eqr.benchmark.suites import load_suite
from sb3_eqr.benchmark.training import execute
from sb3_eqr.common.saving.checkpoints import find_checkpoints
from sb3_eqr.envs import ResumableWrapper, make_atari100k_env
from sb3_eqr.envs.minatar import ChannelsFirstImage

STEPS, SAVE_FREQ = 30_000, 60  # several checkpoints per second
LONGEST = 1.5  # maximum seconds before a run is killed
KILLS_OF_ONE = 30  # short runs finish earlier
FORK = multiprocessing.get_context("fork")  # avoids importing everything again


def train(folder: pathlib.Path) -> None:
    """Start a run, or resume it from its last checkpoint, and finish it."""
    options: dict[str, Any] = {"train_freq": 8, "gradient_steps": 1, "learning_starts": 100, "buffer_size": 2_000}
    options["policy_kwargs"] = {"net_arch": [16], "latent_hidden_dim": 16}
    run = partial(finish, folder, make_vec_env("CartPole-v1"), STEPS, SAVE_FREQ, seed=0, **options)
    try:
        model = run()
    except ValueError as error:
        if "this run begins" not in str(error):  # all else is a finding
            raise
        model = run()  # another run was the first to write into the empty folder
    model.save(folder / "final.zip")


def kill_until_done(start: Callable[[], Any], kills: int, rng: random.Random, at_once: int = 1) -> tuple[list[Any], int]:
    """
    Start a run again and again, and kill it until ``kills`` kills have hit a running process; then let it finish.

    :return: exit codes other than 0 and that of the kill, and the number of kills
    """
    strange: list[Any] = []
    done = 0
    while True:
        processes = [FORK.Process(target=start) for _ in range(at_once)]
        for process in processes:
            process.start()
        is_last = done >= kills
        for process in processes:
            if not is_last:
                process.join(rng.uniform(0, LONGEST / at_once))
                if process.pid is not None and process.is_alive():
                    os.kill(process.pid, signal.SIGKILL)
            process.join()
            done += process.exitcode == -signal.SIGKILL
            strange += [process.exitcode] if process.exitcode not in (0, -signal.SIGKILL) else []
        if is_last or all(process.exitcode == 0 for process in processes):
            return strange, done


def killed_runs(folder: pathlib.Path, kills: int, rng: random.Random, at_once: int) -> Finding:
    """Compare a run that is killed repeatedly, or several at once in one folder, with an undisturbed run."""
    undisturbed, killed = folder / "undisturbed", folder / f"killed_{at_once}"
    if not (undisturbed / "final.zip").is_file():
        kill_until_done(partial(train, undisturbed), 0, rng)
    killed.mkdir(parents=True)
    strange, done = kill_until_done(partial(train, killed), kills, rng, at_once)
    bits = "lost"
    if (killed / "final.zip").is_file():
        states = [EqRQRDQN.load(place / "final.zip").policy.state_dict() for place in (undisturbed, killed)]
        bits = "equal bits" if are_equal(*states) else "other bits"
    left = partial_files(killed)
    wrong = [*([] if bits == "equal bits" else [bits]), *left, *map(str, strange)]
    found = f"{bits}, {len(left)} partial, {len(strange)} errors"
    name = f"{done} SIGKILLs of a run" if at_once == 1 else f"{done} SIGKILLs of {at_once} runs on one folder"
    return Finding(name, "equal bits, 0 partial files, 0 errors", found, wrong)


def killed_benchmark(folder: pathlib.Path, kills: int, rng: random.Random) -> Finding:
    """Compare killed runs of the suite smoke, as Ray's workers execute them, with undisturbed ones, seed by seed."""
    suite, settings = load_suite("smoke"), Settings(checkpoint_seconds=0.2)
    agents = ["eqr_qrdqn", "eqr_rainbow", "qrdqn:stock"]
    different: list[str] = []
    strange: list[Any] = []
    done, seeds = 0, 0
    while done < kills:
        seeds += 1
        plans = [plan_runs(folder / name, suite, agents, range(seeds)) for name in ("undisturbed", "killed")]
        for undisturbed, killed in zip(*plans, strict=True):
            if undisturbed.seed == seeds - 1:
                kill_until_done(partial(execute, undisturbed, settings), 0, rng)
                codes, hits = kill_until_done(partial(execute, killed, settings), KILLS_OF_ONE, rng)
                strange, done = strange + codes, done + hits
                found = scores(killed)
                different += [str(killed.folder)] if found is None or found != scores(undisturbed) else []
    left = partial_files(folder)
    result = f"{'other' if different else 'equal'} scores, {len(left)} partial, {len(strange)} errors"
    name = f"{done} SIGKILLs of {seeds * len(agents)} runs of the benchmark (smoke)"
    wrong = [*different, *left, *map(str, strange)]
    return Finding(name, "equal scores, 0 partial files, 0 errors", result, wrong)


def scores(run: Run) -> Any:
    """The measurements of a finished run."""
    path = run.folder / RESULT
    result = json.loads(path.read_text()) if path.is_file() else None
    return None if result is None else (result["evaluations"], result["training"])


AGENTS: dict[str, Any] = {"EqRQRDQN": EqRQRDQN, "EqRRainbow": EqRRainbow}
LENGTH, STOP = 1_200, 600


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


def train_in(agent: str, world: str, n_envs: int, folder: pathlib.Path) -> None:
    """Train an agent to the end, or resume it from the checkpoint in ``folder``, and save it there."""
    name, env = "resumed" if find_checkpoints(folder) else "whole", WORLDS[world](n_envs=n_envs)
    options: dict[str, Any] = {"buffer_size": 2_000, "batch_size": 8, "learning_starts": 40, "n_steps": 3, "train_freq": 4}
    if not world.startswith("CartPole"):
        options |= {"policy": "CnnPolicy", "policy_kwargs": {"features_extractor_kwargs": {"layers": [[4, 3, 2]]}}}
    finish(folder, env, LENGTH, STOP, AGENTS[agent], **options, seed=3, device="cpu").save(folder / name)
    env.close()
    for later in find_checkpoints(folder)[1:]:  # as if the run had stopped after its first checkpoint
        shutil.rmtree(later)


def resumed_runs(folder: pathlib.Path) -> Finding:
    """Each agent in each world, with one environment and with four."""
    context = multiprocessing.get_context("spawn")
    runs = [(agent, world, n_envs) for agent in AGENTS for world in WORLDS for n_envs in (1, 4)]
    wrong = []
    for i, (agent, world, n_envs) in enumerate(runs):
        for _ in range(2):
            process = context.Process(target=train_in, args=(agent, world, n_envs, folder / str(i)))
            process.start()
            process.join()
        whole, resumed = (AGENTS[agent].load(folder / str(i) / name) for name in ("whole", "resumed"))
        if resumed._n_updates != whole._n_updates or not are_equal(whole.policy.state_dict(), resumed.policy.state_dict()):
            wrong.append(f"{agent}, {world}, {n_envs} environments")
    name = f"{len(runs)} runs, stopped half-way and resumed in a new process ({', '.join(WORLDS)}; 1 and 4 environments)"
    return Finding(name, "equal bits", f"{len(runs) - len(wrong)} of {len(runs)} equal bits", wrong)
