"""One run of a benchmark: one agent on one game with one seed, from its beginning or last checkpoint to its scores."""

import argparse
import contextlib
import dataclasses
import datetime
import importlib.metadata
import json
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
from stable_baselines3.common.logger import KVWriter, Logger

from sb3_eqr import envs
from sb3_eqr.benchmark.agents import Agent
from sb3_eqr.benchmark.checkpoints import find_checkpoints, load_checkpoint, remove_checkpoints, write_checkpoint
from sb3_eqr.benchmark.evaluation import evaluate
from sb3_eqr.common.safe_files import atomic_write
from sb3_eqr.zoo import register

RESULT, PLAN, PROGRESS, ERROR, LOCK = "result.json", "run.json", "progress.json", "error.txt", "lock"
STARTS = "starts.txt"  # a line whenever the run is begun or resumed
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
PROGRESS_SECONDS = 2.0  # between two notes of where a run is


@dataclasses.dataclass(frozen=True)
class Run:
    """
    :param folder: of the run
    :param agent: the agent
    :param suite: name of the suite
    :param game: name of the game
    :param seed: of everything
    :param protocol: of :meth:`~sb3_eqr.benchmark.suites.Suite.protocol`
    :param entry: of :func:`~sb3_eqr.benchmark.agents.hyperparameters`
    """

    folder: pathlib.Path
    agent: Agent
    suite: str
    game: str
    seed: int
    protocol: dict[str, Any]
    entry: dict[str, Any]

    def description(self) -> dict[str, Any]:
        """
        :return: what was asked for, for ``run.json``
        """
        return {
            "agent": self.agent.name,
            "game": self.game,
            "seed": self.seed,
            "suite": self.suite,
            "protocol": self.protocol,
            "entry": {"algo": self.agent.algo, "file": str(self.agent.file), "hyperparameters": self.entry},
        }


@dataclasses.dataclass(frozen=True)
class Settings:
    """
    What does not change a score.

    :param command: to repeat the benchmark
    :param device: of PyTorch
    :param n_threads: of PyTorch
    :param checkpoint_seconds: between two checkpoints
    """

    command: str = ""
    device: str = "auto"
    n_threads: int = 1
    checkpoint_seconds: float = 300.0


def to_json(value: Any) -> str:
    """
    :return: as it is written into files
    """
    return json.dumps(value, indent=1, default=str)


def write_json(path: pathlib.Path, value: Any) -> None:
    """Write a file beside ``path`` and rename it."""
    with atomic_write(path, "json") as file:
        file.write(to_json(value).encode())


def new_record() -> dict[str, Any]:
    """
    :return: what a run measures
    """
    return {
        "seconds": 0.0,
        "training_seconds": 0.0,
        "resumed_at": [],
        "resumed_exactly": True,
        "evaluations": [],
        "training": {"step": [], "score": [], "length": []},
        "losses": [],
    }


class LossWriter(KVWriter):
    """
    :param losses: a row is appended whenever SB3 dumps its log
    """

    def __init__(self, losses: list[dict[str, float]]):
        self._losses = losses

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """As SB3's writers."""
        row = {key[6:]: float(v) for key, v in key_values.items() if key.startswith("train/") and key.endswith("loss")}
        if row:
            self._losses.append({"step": step, **row})


class RunCallback(BaseCallback):
    """
    Notes training scores and progress, evaluates along the way, writes checkpoints, stops after exactly the steps asked for.

    :param run: the run
    :param record: what was measured so far
    :param settings: the settings
    """

    def __init__(self, run: Run, record: dict[str, Any], settings: Settings):
        super().__init__()
        self.run, self.record, self.settings = run, record, settings
        self.steps = run.protocol["steps"]
        curve = run.protocol["evaluation"]["curve"]
        self.due = [self.steps * point // curve["points"] for point in range(1, curve["points"])]
        self.curve_episodes = curve["episodes"]
        self.clock = Clock(record)
        self.noted = 0.0
        self.saved = time.monotonic()

    def _on_training_start(self) -> None:
        self.first_step, self.first_second = self.num_timesteps, self.record["training_seconds"]
        self.note_progress()

    def _on_rollout_start(self) -> None:
        if time.monotonic() - self.saved >= self.settings.checkpoint_seconds:
            self.clock.read("training_seconds")
            write_checkpoint(self.run.folder, self.model, self.record)
            self.clock.read("seconds")
            self.saved = time.monotonic()

    def _on_step(self) -> bool:
        for info in self.locals.get("infos", []):
            if "episode" in info:
                self.record["training"]["step"].append(self.num_timesteps)
                self.record["training"]["score"].append(float(info["episode"]["r"]))
                self.record["training"]["length"].append(int(info["episode"]["l"]))
        if time.monotonic() - self.noted >= PROGRESS_SECONDS:
            self.clock.read("training_seconds")
            self.note_progress()
        if self.is_due() and self.has_settled():
            self.clock.read("training_seconds")
            add_evaluation(self.model, self.run, self.record, "curve", self.curve_episodes)
            self.clock.read("seconds")
        return self.num_timesteps < self.steps

    def _on_training_end(self) -> None:
        self.clock.read("training_seconds")
        self.note_progress()

    def is_due(self) -> bool:
        """
        :return: whether a point of the learning curve has come since the last evaluation
        """
        last = max((row["step"] for row in self.record["evaluations"]), default=0)
        return any(last < step <= self.num_timesteps < self.steps for step in self.due)

    def has_settled(self) -> bool:
        """
        :return: whether half of the updates from one reset of the network to the next are done; a network that has just been
            reset plays like a new one
        """
        interval = getattr(self.model, "reset_interval", None)
        return interval is None or not self.model._resets or 2 * self.model._updates_since_reset >= interval  # type: ignore[attr-defined]

    def note_progress(self) -> None:
        """Write where the run is, for the table."""
        seconds = self.record["training_seconds"] - self.first_second
        rate = (self.num_timesteps - self.first_step) / seconds if seconds > 0 else 0.0
        progress = {"step": self.num_timesteps, "steps": self.steps, "steps_per_second": rate, "host": platform.node()}
        write_json(self.run.folder / PROGRESS, progress)
        self.noted = time.monotonic()


class Clock:
    """
    Adds the time since the last reading to what a record has.

    :param record: with "seconds", of everything, and "training_seconds", without evaluations and checkpoints
    """

    def __init__(self, record: dict[str, Any]):
        self._record = record
        self._last = time.monotonic()

    def read(self, what: str) -> None:
        """
        :param what: what the time was spent on: "training_seconds", or "seconds" for anything else
        """
        now = time.monotonic()
        for key in {what, "seconds"}:
            self._record[key] += now - self._last
        self._last = now


def add_evaluation(model: BaseAlgorithm, run: Run, record: dict[str, Any], kind: str, n_episodes: int) -> None:
    """
    :param kind: "curve" or "final"
    """
    scores, lengths = evaluate(model, run.protocol, n_episodes, run.seed)
    record["evaluations"].append({"step": model.num_timesteps, "kind": kind, "scores": scores, "lengths": lengths})


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
