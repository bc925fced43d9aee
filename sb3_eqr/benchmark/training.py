"""Execute one run of a benchmark, from its start or last checkpoint to its scores, and record measurements."""

import argparse
import contextlib
import datetime
import importlib.metadata
import os
import pathlib
import platform
import re
import shutil
import tempfile
import time
import traceback
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch as th
import yaml
from filelock import FileLock, Timeout
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import get_device, should_collect_more_steps

from sb3_eqr import envs
from sb3_eqr.benchmark.agents import WORLD
from sb3_eqr.benchmark.evaluation import evaluate
from sb3_eqr.benchmark.runs import ERROR, LOCK, MODELS, PROGRESS, RESULT, STARTS, STOPPED, Run, Settings, write_json
from sb3_eqr.common.resets import Resets
from sb3_eqr.common.saving import checkpoints
from sb3_eqr.common.saving.checkpoints import PREFIX, find_checkpoints, write_checkpoint
from sb3_eqr.common.saving.files import atomic_write
from sb3_eqr.common.saving.models import SafeFiles
from sb3_eqr.common.saving.plain_data import decode
from sb3_eqr.zoo import AGENTS, register

LOGGED = r"train/.*(loss|state_gradient.*)|latent/.*"
PROGRESS_SECONDS = 2.0  # between writes of a run's progress
PACKAGES = "sb3-eqr stable-baselines3 sb3-contrib rl_zoo3 torch gymnasium ale-py minatar numpy ray".split()


def new_record() -> dict[str, Any]:
    """:return: an empty record of a run; "seconds" is total time, "training_seconds" excludes evaluations and checkpoints"""
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
    Collects the losses and the gradients at the state that SB3 logs, and what LatentCallback does.

    :param losses: a row is appended at each dump of the log; keys without "train/"
    """

    def __init__(self, losses: list[dict[str, float]]):
        self._losses = losses

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Append what was logged; the interface of SB3's writers."""
        numbers = {key: float(value) for key, value in key_values.items() if isinstance(value, (int, float, np.number))}
        row = {key.removeprefix("train/"): value for key, value in numbers.items() if re.fullmatch(LOGGED, key)}
        if row:
            self._losses.append({"step": step, **row})


class Clock:
    """
    Adds elapsed time to a record.

    :param record: see :func:`new_record`
    """

    def __init__(self, record: dict[str, Any]):
        self._record = record
        self._last = time.monotonic()

    def read(self, what: str) -> None:
        """
        Add the time since the last reading.

        :param what: what the time was spent on: "training_seconds", or "seconds" for anything else
        """
        now = time.monotonic()
        for key in {what, "seconds"}:
            self._record[key] += now - self._last
        self._last = now


class OutOfTime(Exception):
    """``settings.stop_at`` has passed, and the checkpoint is written."""


class RunCallback(BaseCallback):
    """
    Records training scores and progress, evaluates, writes checkpoints, and stops after exactly the requested steps; a rollout
    that these steps cut short is not trained on. Raises ``OutOfTime`` between two rollouts.

    :param run: the run
    :param record: the measurements so far
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
        is_over = self.settings.is_over()
        if is_over or time.monotonic() - self.saved >= self.settings.checkpoint_seconds:
            self.clock.read("training_seconds")
            write_checkpoint(self.run.folder, self.model, self.record)
            self.clock.read("seconds")
            self.saved = time.monotonic()
        if is_over:
            raise OutOfTime

    def _on_step(self) -> bool:
        for info in self.locals.get("infos", []):
            if "episode" in info:
                found = {"step": self.num_timesteps, "score": float(info["episode"]["r"]), "length": int(info["episode"]["l"])}
                for key, value in found.items():
                    self.record["training"][key].append(value)
        if time.monotonic() - self.noted >= PROGRESS_SECONDS:
            self.clock.read("training_seconds")
            self.note_progress()
        if self.is_due() and self.has_settled():
            self.clock.read("training_seconds")
            add_evaluation(self.model, self.run, self.record, "curve", self.curve_episodes)
            self.clock.read("seconds")
        return self.num_timesteps < self.steps or self.ends_rollout()

    def _on_training_end(self) -> None:
        self.clock.read("training_seconds")
        self.note_progress()

    def ends_rollout(self) -> bool:
        """
        :return: whether this step is the last of a rollout. Then ``learn`` ends by itself, after the updates that belong to
            the rollout, which it leaves out if the callback stops it.
        """
        if isinstance(self.model, OffPolicyAlgorithm):
            n_episodes = self.locals["num_collected_episodes"] + int(np.sum(self.locals["dones"]))
            frequency: Any = self.model.train_freq
            return not should_collect_more_steps(frequency, self.locals["num_collected_steps"], n_episodes)
        return self.locals.get("n_steps", 0) + 1 == self.locals.get("n_rollout_steps")

    def is_due(self) -> bool:
        """:return: whether a point of the learning curve has been reached since the last evaluation"""
        last = max((row["step"] for row in self.record["evaluations"]), default=0)
        return any(last < step <= self.num_timesteps < self.steps for step in self.due)

    def has_settled(self) -> bool:
        """
        :return: whether half of the updates between two resets of the network are done; right after a reset, the agent
            performs like an untrained one
        """
        resets: Resets | None = getattr(self.model, "_resets", None)
        if resets is None or resets.schedule.interval is None or not resets.done:
            return True
        return 2 * resets.updates_since(self.model._n_updates) >= resets.schedule.interval  # type: ignore[attr-defined]

    def note_progress(self) -> None:
        """Write the run's progress, for the table."""
        seconds = self.record["training_seconds"] - self.first_second
        rate = (self.num_timesteps - self.first_step) / seconds if seconds > 0 else 0.0
        progress = {"step": self.num_timesteps, "steps": self.steps, "steps_per_second": rate, "host": platform.node()}
        write_json(self.run.folder / PROGRESS, progress)
        self.noted = time.monotonic()


def add_evaluation(model: BaseAlgorithm, run: Run, record: dict[str, Any], kind: str, n_episodes: int) -> None:
    """
    Evaluate the agent and add the scores to the record.

    :param kind: "curve" or "final"
    """
    scores, lengths = evaluate(model, run.protocol, n_episodes, run.seed)
    record["evaluations"].append({"step": model.num_timesteps, "kind": kind, "scores": scores, "lengths": lengths})


def build(run: Run, settings: Settings, logs: pathlib.Path) -> tuple[BaseAlgorithm, ExperimentManager]:
    """
    Build the agent as RL Zoo does, on environments that write no files.

    :return: the agent, and RL Zoo's manager, which has the callbacks of its entry and saves the agent
    """
    env_id, kwargs = run.protocol["env_id"], run.entry.get("env_kwargs")
    args = argparse.Namespace(env=env_id, env_kwargs=kwargs, gym_packages=settings.gym_packages, seed=run.seed)
    with tempfile.TemporaryDirectory() as aside, silence():
        config = pathlib.Path(aside) / "entry.yml"
        entry = {key: value for key, value in run.entry.items() if value is not None or key not in WORLD}  # null: none
        if run.agent.algo in AGENTS and get_device(settings.device).type == "cuda":
            entry = {"cuda_graph": True, **entry}
        config.write_text(yaml.safe_dump({env_id: entry}), encoding="utf-8")
        manager = ExperimentManager(
            args,
            run.agent.algo,
            env_id,
            str(logs),
            n_timesteps=run.protocol["steps"],
            eval_freq=-1,
            seed=run.seed,
            verbose=0,
            device=settings.device,
            config=str(config),
        )
        experiment = manager.setup_experiment()
        assert experiment is not None
        model = experiment[0]
        old = model.get_env()
        model.set_env(manager.create_envs(manager.n_envs, no_log=True))
        if old is not None:
            old.close()
    return model, manager


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Leave out what RL Zoo prints."""
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        yield


def save_model(model: BaseAlgorithm, manager: ExperimentManager, run: Run, logs: pathlib.Path) -> None:
    """Save the agent in the folder of :func:`build` as ``sb3-eqr train`` does, without its log of episodes."""
    with silence():
        manager.save_trained_model(model)
    pathlib.Path(manager.params_path, "command.txt").write_text(run.command, encoding="utf-8")
    for log in logs.rglob("*.monitor.csv"):
        log.unlink()


def load_checkpoint(checkpoint: pathlib.Path, model: BaseAlgorithm) -> tuple[BaseAlgorithm, dict[str, Any], bool]:
    """
    Like an EqR agent's ``resume``, for all agents of Stable-Baselines3.

    :param checkpoint: see :func:`~sb3_eqr.common.saving.checkpoints.write_checkpoint`
    :param model: a new agent, whose class, device and environment are used
    :return: the resumed agent, the measurements so far, and whether it resumes bit for bit; if not, with a new episode
    """
    checkpoint, manifest = checkpoints.read_manifest(checkpoint)
    is_exact = not manifest["unknown"] and not hasattr(model, "_last_lstm_states")  # SB3 does not save these
    trust: dict[str, Any] = {"trust": True} if isinstance(model, SafeFiles) else {}  # the entry may name its own classes
    model = type(model).load(
        checkpoint / checkpoints.MODEL, env=model.get_env(), device=model.device, force_reset=not is_exact, **trust
    )
    if isinstance(model, OffPolicyAlgorithm) and (checkpoint / checkpoints.BUFFER).is_file():
        model.load_replay_buffer(checkpoint / checkpoints.BUFFER, **trust)
    checkpoints.restore_run(model, manifest, is_exact)
    if not is_exact:
        buffer: Any = getattr(model, "replay_buffer", None)
        if hasattr(buffer, "timeouts") and buffer.size() > 0:  # no n-step return across the gap
            last = buffer.pos - 1
            buffer.timeouts[last] = np.maximum(buffer.timeouts[last], 1 - buffer.dones[last])  # a terminal state stays one
    is_exact &= not getattr(model, "use_sde", False)  # the noise of the next rollout was drawn before the checkpoint
    return model, decode(manifest["notes"]), is_exact


def remove_checkpoints(folder: pathlib.Path) -> None:
    """Remove the checkpoints of a finished run, and partial files that a killed run left."""
    for checkpoint in find_checkpoints(folder):
        checkpoints.discard(checkpoint)
    for path in [*folder.glob(f".{PREFIX}*"), folder / f".{MODELS}"]:
        shutil.rmtree(path, ignore_errors=True)


def provenance(run: Run, model: BaseAlgorithm, settings: Settings) -> dict[str, Any]:
    """:return: what was run, with versions and machine"""
    versions = {}
    for package in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    device = th.cuda.get_device_name(model.device) if model.device.type == "cuda" else model.device.type
    captured: Any = getattr(model, "_captured", None)  # as a CUDA graph
    updates = "eager" if captured is None else f"eager: {captured.failure}" if captured.failure else "captured"
    machine = {"device": device, "updates": updates, "threads": th.get_num_threads()}
    return {
        **run.description(),
        "versions": {"python": platform.python_version(), **versions},
        "machine": {**machine, "platform": platform.platform(), "host": platform.node()},
    }


def train(run: Run, settings: Settings) -> str:
    """
    Train, evaluate, write ``result.json``; an interrupted run resumes from its last checkpoint.

    :return: "finished", or "stopped" if ``settings.stop_at`` came first: then a checkpoint and ``stopped.json`` are written
    """
    started = time.monotonic()
    envs.register()
    envs.import_packages(settings.gym_packages)
    register()
    with open(run.folder / STARTS, "a", encoding="utf-8") as file:
        file.write(datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds") + "\n")
    models = run.folder / MODELS
    logs = models.with_name(f".{MODELS}")
    shutil.rmtree(logs, ignore_errors=True)  # of a killed run
    model, manager = build(run, settings, logs)
    record = new_record()
    found = find_checkpoints(run.folder)
    if found:
        model, record, is_exact = load_checkpoint(found[-1], model)
        record["resumed_at"].append(model.num_timesteps)
        record["resumed_exactly"] &= is_exact
    record["seconds"] += time.monotonic() - started
    steps = run.protocol["steps"]
    if model.num_timesteps < steps:
        model.set_logger(Logger(folder=None, output_formats=[LossWriter(record["losses"])]))
        callback = RunCallback(run, record, settings)
        try:
            model.learn(steps - model.num_timesteps, [*manager.callbacks, callback], reset_num_timesteps=not found)
        except OutOfTime:
            row = {
                "stopped_at": model.num_timesteps,
                **provenance(run, model, settings),
                **times(run, model, record),
                **record,
            }
            write_json(run.folder / STOPPED, row)
            return "stopped"
        write_checkpoint(run.folder, model, record, with_buffer=False)
    finishing = Clock(record)
    add_evaluation(model, run, record, "final", run.protocol["evaluation"]["episodes"])
    finishing.read("seconds")
    if settings.save_models:
        save_model(model, manager, run, logs)
        shutil.rmtree(models, ignore_errors=True)
        logs.rename(models)
    write_json(run.folder / RESULT, {**provenance(run, model, settings), **times(run, model, record), **record})
    model.get_env().close()  # type: ignore[union-attr]
    remove_checkpoints(run.folder)
    return "finished"


def times(run: Run, model: BaseAlgorithm, record: dict[str, Any]) -> dict[str, Any]:
    """:return: when the run started and how long it took; the record's "seconds" are moved into it"""
    starts = (run.folder / STARTS).read_text(encoding="utf-8").split()
    return {
        "started": starts[0],
        "attempts": len(starts),
        "wall_clock_s": round(record.pop("seconds"), 2),
        "steps_per_second": round(model.num_timesteps / max(record["training_seconds"], 1e-9), 2),
    }


def execute(run: Run, settings: Settings) -> str:
    """
    Start or resume a run and finish it. Only one process at a time can hold a run.

    :return: "finished", "stopped", or "busy" if another process holds the run
    :raises Exception: whatever stopped the run; the traceback is in ``error.txt``, and the last checkpoint is complete
    """
    run.folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(run.folder / LOCK, blocking=False):
            if (run.folder / RESULT).is_file():
                remove_checkpoints(run.folder)  # left by a process that was killed after writing the result
                return "finished"
            th.set_num_threads(settings.n_threads)
            (run.folder / ERROR).unlink(missing_ok=True)  # of an earlier attempt
            try:
                outcome = train(run, settings)
            except (Exception, SystemExit) as error:
                with contextlib.suppress(OSError), atomic_write(run.folder / ERROR, "txt") as file:
                    file.write(traceback.format_exc().encode())
                if isinstance(error, SystemExit):  # would also end Ray's worker
                    raise RuntimeError(f"{run.agent.file} cannot be used (exit {error.code})") from error
                raise
            for name in (PROGRESS, *((STARTS, STOPPED) if outcome == "finished" else ())):
                (run.folder / name).unlink(missing_ok=True)
            return outcome
    except Timeout:
        return "busy"
