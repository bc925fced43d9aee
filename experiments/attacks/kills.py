"""Runs that are killed at random times: nothing may be lost, and no result may change."""

import json
import multiprocessing
import os
import pathlib
import random
import signal
from collections.abc import Callable
from functools import partial
from typing import Any

from stable_baselines3.common.env_util import make_vec_env

from experiments.attacks import Finding, are_equal, finish, partial_files
from sb3_eqr import EqRQRDQN
from sb3_eqr.benchmark.runs import RESULT, Run, Settings, plan_runs
from sb3_eqr.benchmark.suites import load_suite
from sb3_eqr.benchmark.training import execute

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
