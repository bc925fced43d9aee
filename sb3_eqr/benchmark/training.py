"""Doing one run of a benchmark, from its beginning or last checkpoint to its scores."""

import argparse
import contextlib
import datetime
import importlib.metadata
import os
import pathlib
import platform
import tempfile
import time
import traceback
from typing import Any

import torch as th
import yaml
from filelock import FileLock, Timeout
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from sb3_eqr import envs
from sb3_eqr.benchmark.checkpoints import find_checkpoints, load_checkpoint, remove_checkpoints, write_checkpoint
from sb3_eqr.benchmark.recording import Clock, LossWriter, RunCallback, add_evaluation, new_record
from sb3_eqr.benchmark.run import ERROR, LOCK, PROGRESS, RESULT, STARTS, Run, Settings, write_json
from sb3_eqr.common.files import atomic_write
from sb3_eqr.zoo import register

PACKAGES = (
    "sb3-eqr",
    "stable-baselines3",
    "sb3-contrib",
    "rl_zoo3",
    "torch",
    "gymnasium",
    "ale-py",
    "minatar",
    "numpy",
    "ray",
)


def build(run: Run, device: str) -> tuple[BaseAlgorithm, list[BaseCallback]]:
    """
    The agent as RL Zoo builds it, on environments that write no files.

    :return: the agent, the callbacks of its entry
    """
    with tempfile.TemporaryDirectory() as logs, open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        config = pathlib.Path(logs) / "entry.yml"
        config.write_text(yaml.safe_dump({run.protocol["env_id"]: run.entry}), encoding="utf-8")
        manager = ExperimentManager(
            argparse.Namespace(),
            run.agent.algo,
            run.protocol["env_id"],
            logs,
            n_timesteps=run.protocol["steps"],
            eval_freq=-1,
            seed=run.seed,
            verbose=0,
            device=device,
            config=str(config),
        )
        experiment = manager.setup_experiment()
        assert experiment is not None
        model = experiment[0]
        old = model.get_env()
        model.set_env(manager.create_envs(manager.n_envs, no_log=True))
        if old is not None:
            old.close()
    return model, manager.callbacks


def provenance(run: Run, model: BaseAlgorithm, settings: Settings) -> dict[str, Any]:
    """
    :return: what was run and on what
    """
    versions = {}
    for package in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    device = th.cuda.get_device_name(model.device) if model.device.type == "cuda" else model.device.type
    return {
        **run.description(),
        "versions": {"python": platform.python_version(), **versions},
        "machine": {"device": device, "threads": settings.n_threads, "platform": platform.platform(), "host": platform.node()},
        "command": settings.command,
    }


def train(run: Run, settings: Settings) -> None:
    """Train, evaluate, write ``result.json``; what was begun before goes on from its last checkpoint."""
    started = time.monotonic()
    envs.register()
    register()
    with open(run.folder / STARTS, "a", encoding="utf-8") as file:
        file.write(datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds") + "\n")
    model, callbacks = build(run, settings.device)
    record = new_record()
    checkpoints = find_checkpoints(run.folder)
    if checkpoints:
        model, record, is_exact = load_checkpoint(checkpoints[-1], model)
        record["resumed_at"].append(model.num_timesteps)
        record["resumed_exactly"] &= is_exact
    record["seconds"] += time.monotonic() - started
    steps = run.protocol["steps"]
    if model.num_timesteps < steps:
        model.set_logger(Logger(folder=None, output_formats=[LossWriter(record["losses"])]))
        callback = RunCallback(run, record, settings)
        model.learn(steps - model.num_timesteps, [*callbacks, callback], reset_num_timesteps=not checkpoints)
        write_checkpoint(run.folder, model, record, is_final=True)
    finishing = Clock(record)
    add_evaluation(model, run, record, "final", run.protocol["evaluation"]["episodes"])
    finishing.read("seconds")
    seconds = record.pop("seconds")
    rate = steps / max(record["training_seconds"], 1e-9)
    starts = (run.folder / STARTS).read_text(encoding="utf-8").split()
    times = {
        "started": starts[0],
        "attempts": len(starts),
        "wall_clock_s": round(seconds, 2),
        "steps_per_second": round(rate, 2),
    }
    write_json(run.folder / RESULT, {**provenance(run, model, settings), **times, **record})
    model.get_env().close()  # type: ignore[union-attr]
    remove_checkpoints(run.folder)


def execute(run: Run, settings: Settings) -> str:
    """
    A run from wherever it is to its end, by one process at a time.

    :return: "finished", or "busy" if another process has it
    :raises Exception: what stopped it; the traceback is in ``error.txt``, the last checkpoint is whole
    """
    run.folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(run.folder / LOCK, blocking=False):
            if (run.folder / RESULT).is_file():
                remove_checkpoints(run.folder)  # of a process that was killed at the very end
                return "finished"
            th.set_num_threads(settings.n_threads)
            try:
                train(run, settings)
            except (Exception, SystemExit) as error:
                with contextlib.suppress(OSError), atomic_write(run.folder / ERROR, "txt") as file:
                    file.write(traceback.format_exc().encode())
                if isinstance(error, SystemExit):  # would end Ray's worker, too
                    raise RuntimeError(f"{run.agent.file}: cannot be used (exit {error.code})") from error
                raise
            for name in (ERROR, PROGRESS, STARTS):
                (run.folder / name).unlink(missing_ok=True)
            return "finished"
    except Timeout:
        return "busy"
