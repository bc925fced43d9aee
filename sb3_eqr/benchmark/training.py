"""Execute one run of a benchmark, from its start or last checkpoint to its scores, and record measurements."""

import argparse
import contextlib
import datetime
import importlib.metadata
import io
import pathlib
import platform
import re
import shutil
import tempfile
import time
import traceback
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
from stable_baselines3.common.utils import should_collect_more_steps

from sb3_eqr.benchmark.agents import WORLD
from sb3_eqr.benchmark.evaluation import evaluate
from sb3_eqr.benchmark.runs import ERROR, LOCK, MODELS, PROGRESS, RESULT, STARTS, STOPPED, Run, Settings, write_json
from sb3_eqr.common.saving import checkpoints
from sb3_eqr.common.saving.checkpoints import PREFIX, find_checkpoints, write_checkpoint
from sb3_eqr.common.saving.files import atomic_write
from sb3_eqr.common.saving.models import SafeFiles
from sb3_eqr.common.saving.plain_data import decode
from sb3_eqr.envs import import_packages
from sb3_eqr.zoo import register

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
    :param losses: gets a row at each dump of SB3's log: the losses, the gradients at the state and what LatentCallback does
    """

    def __init__(self, losses: list[dict[str, float]]):
        self._losses = losses

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Append what was logged; the interface of SB3's writers."""
        numbers = {key: float(value) for key, value in key_values.items() if isinstance(value, (int, float, np.number))}
        row = {key.removeprefix("train/"): value for key, value in numbers.items() if re.fullmatch(LOGGED, key)}
        if row:
            self._losses.append({"step": step, **row})


class OutOfTime(Exception):
    """``settings.stop_at`` has passed, and the checkpoint is written."""


class RunCallback(BaseCallback):
    """
    Records training scores and progress, evaluates, writes checkpoints, and stops after exactly the requested steps; a rollout
    that these steps cut short is not trained on. Raises ``OutOfTime`` between two rollouts.

    :param record: the measurements so far
    :param started: when the process took up the run, by the monotonic clock
    """

    def __init__(self, run: Run, record: dict[str, Any], settings: Settings, started: float):
        super().__init__()
        self.run, self.record, self.settings = run, record, settings
        self.steps, self.curve = run.protocol["steps"], run.protocol["evaluation"]["curve"]
        self.counted = started
        self.count_time()
        self.noted = 0.0
        self.saved = time.monotonic()

    def _on_training_start(self) -> None:
        self.first_step, self.first_second = self.num_timesteps, self.record["training_seconds"]
        self.note_progress()

    def _on_rollout_start(self) -> None:
        is_over = self.settings.is_over()
        if is_over or time.monotonic() - self.saved >= self.settings.checkpoint_seconds:
            self.count_time("training_seconds")
            write_checkpoint(self.run.folder, self.model, self.record)
            self.count_time()
            self.saved = time.monotonic()
        if is_over:
            raise OutOfTime

    def _on_step(self) -> bool:
        training = self.record["training"]
        for episode in [info["episode"] for info in self.locals.get("infos", []) if "episode" in info]:
            training["step"].append(self.num_timesteps)
            training["score"].append(float(episode["r"]))
            training["length"].append(int(episode["l"]))
        if time.monotonic() - self.noted >= PROGRESS_SECONDS:
            self.note_progress()
        if self.is_due() and self.has_settled():
            self.count_time("training_seconds")
            add_evaluation(self.model, self.run, self.record, "curve", self.curve["episodes"])
            self.count_time()
        return self.num_timesteps < self.steps or self.ends_rollout()

    def _on_training_end(self) -> None:
        self.note_progress()

    def count_time(self, what: str = "seconds") -> None:
        """Add the time since the last call to the record's "seconds" and, if it was training, to its "training_seconds"."""
        now = time.monotonic()
        for key in {what, "seconds"}:
            self.record[key] += now - self.counted
        self.counted = now

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
        points = self.curve["points"]
        last = max((row["step"] for row in self.record["evaluations"]), default=0)
        return any(last < self.steps * point // points <= self.num_timesteps < self.steps for point in range(1, points))

    def has_settled(self) -> bool:
        """
        :return: whether half of the updates between two resets of the network are done; right after a reset, the agent
            performs like an untrained one
        """
        resets: Any = getattr(self.model, "_resets", None)
        if resets is None or not resets.done:
            return True
        return 2 * resets.updates_since(self.model._n_updates) >= resets.schedule.interval  # type: ignore[attr-defined]

    def note_progress(self) -> None:
        """Write the run's progress, for the table."""
        self.count_time("training_seconds")
        seconds = self.record["training_seconds"] - self.first_second
        rate = (self.num_timesteps - self.first_step) / seconds if seconds > 0 else 0.0
        progress = {"step": self.num_timesteps, "steps": self.steps, "steps_per_second": rate, "host": platform.node()}
        write_json(self.run.folder / PROGRESS, progress)
        self.noted = time.monotonic()


def add_evaluation(model: BaseAlgorithm, run: Run, record: dict[str, Any], kind: str, n_episodes: int) -> None:
    """Evaluate the agent and add the scores to the record; ``kind`` is "curve" or "final"."""
    scores, lengths = evaluate(model, run.protocol, n_episodes, run.seed)
    record["evaluations"].append({"step": model.num_timesteps, "kind": kind, "scores": scores, "lengths": lengths})


def build(run: Run, settings: Settings, logs: pathlib.Path) -> tuple[BaseAlgorithm, ExperimentManager]:
    """
    Build the agent as RL Zoo does, on environments that write no files.

    :return: the agent, and RL Zoo's manager, which has the callbacks of its entry and saves the agent
    """
    env_id, kwargs = run.protocol["env_id"], run.entry.get("env_kwargs")
    args = argparse.Namespace(env=env_id, env_kwargs=kwargs, gym_packages=settings.gym_packages, seed=run.seed)
    with tempfile.TemporaryDirectory() as aside, contextlib.redirect_stdout(io.StringIO()):  # RL Zoo prints
        config = pathlib.Path(aside) / "entry.yml"
        entry = {key: value for key, value in run.entry.items() if value is not None or key not in WORLD}  # null: none
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
            trained_agent=str(logs / "none"),  # beside it, RL Zoo looks for statistics of VecNormalize
        )
        model, _ = manager.setup_experiment()  # type: ignore[misc]
        logged = model.get_env()
        model.set_env(manager.create_envs(manager.n_envs, no_log=True))
        logged.close()  # type: ignore[union-attr]
    return model, manager


def save_model(model: BaseAlgorithm, manager: ExperimentManager, run: Run) -> None:
    """Save the agent in the folder of :func:`build` as ``sb3-eqr train`` does, without its log of episodes; then rename it."""
    with contextlib.redirect_stdout(io.StringIO()):
        manager.save_trained_model(model)
    pathlib.Path(manager.params_path, "command.txt").write_text(run.command, encoding="utf-8")
    logs = pathlib.Path(manager.log_folder)
    for log in logs.rglob("*.monitor.csv"):
        log.unlink()
    shutil.rmtree(run.folder / MODELS, ignore_errors=True)
    logs.rename(run.folder / MODELS)


def load_checkpoint(checkpoint: pathlib.Path, model: BaseAlgorithm) -> tuple[BaseAlgorithm, dict[str, Any], bool]:
    """
    Like an EqR agent's ``resume``, for all agents of Stable-Baselines3. The class, device and environment are the model's.

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
    return model, decode(manifest["notes"]), is_exact and not checkpoints.drawn_anew(model)


def clean_up(folder: pathlib.Path) -> None:
    """Remove what only an unfinished run needs, and partial files that a killed one left."""
    for checkpoint in find_checkpoints(folder):
        checkpoints.discard(checkpoint)
    for path in [*folder.glob(f".{PREFIX}*"), folder / f".{MODELS}"]:
        shutil.rmtree(path, ignore_errors=True)
    for name in (STARTS, STOPPED):
        (folder / name).unlink(missing_ok=True)


def make_row(run: Run, model: BaseAlgorithm, record: dict[str, Any]) -> dict[str, Any]:
    """:return: the content of ``result.json``: what was requested, versions and machine, times, and measurements"""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    captured: Any = getattr(model, "_captured", None)  # as a CUDA graph
    machine = {
        "device": th.cuda.get_device_name(model.device) if model.device.type == "cuda" else model.device.type,
        "updates": "eager" if captured is None else f"eager: {captured.failure}" if captured.failure else "captured",
        "threads": th.get_num_threads(),
        "platform": platform.platform(),
        "host": platform.node(),
    }
    starts = (run.folder / STARTS).read_text(encoding="utf-8").split()
    times = {
        "started": starts[0],
        "attempts": len(starts),
        "wall_clock_s": round(record["seconds"], 2),
        "steps_per_second": round(model.num_timesteps / max(record["training_seconds"], 1e-9), 2),
    }
    measured = {key: value for key, value in record.items() if key != "seconds"}
    return {**run.description(), "versions": versions, "machine": machine, **times, **measured}


def train(run: Run, settings: Settings) -> str:
    """
    Train, evaluate, write ``result.json``; an interrupted run resumes from its last checkpoint.

    :return: "finished", or "stopped" if ``settings.stop_at`` came first: then a checkpoint and ``stopped.json`` are written
    """
    started = time.monotonic()
    register()
    import_packages(settings.gym_packages)
    with open(run.folder / STARTS, "a", encoding="utf-8") as file:
        file.write(datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds") + "\n")
    logs = run.folder / f".{MODELS}"
    shutil.rmtree(logs, ignore_errors=True)  # of a killed run
    model, manager = build(run, settings, logs)
    record = new_record()
    found = find_checkpoints(run.folder)
    if found:
        model, record, is_exact = load_checkpoint(found[-1], model)
        record["resumed_at"].append(model.num_timesteps)
        record["resumed_exactly"] &= is_exact
    callback = RunCallback(run, record, settings, started)
    if (left := run.protocol["steps"] - model.num_timesteps) > 0:
        model.set_logger(Logger(folder=None, output_formats=[LossWriter(record["losses"])]))
        try:
            model.learn(left, [*manager.callbacks, callback], reset_num_timesteps=not found)
        except OutOfTime:
            write_json(run.folder / STOPPED, {"stopped_at": model.num_timesteps, **make_row(run, model, record)})
            return "stopped"
        write_checkpoint(run.folder, model, record, with_buffer=False)
    add_evaluation(model, run, record, "final", run.protocol["evaluation"]["episodes"])
    callback.count_time()
    if settings.save_models:
        save_model(model, manager, run)
    write_json(run.folder / RESULT, make_row(run, model, record))
    model.get_env().close()  # type: ignore[union-attr]
    clean_up(run.folder)
    return "finished"


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
                clean_up(run.folder)  # of a process that was killed after writing the result
                return "finished"
            th.set_num_threads(settings.n_threads)
            (run.folder / ERROR).unlink(missing_ok=True)  # of an earlier attempt
            try:
                outcome = train(run, settings)
            except Exception:
                with contextlib.suppress(OSError), atomic_write(run.folder / ERROR, "txt") as file:
                    file.write(traceback.format_exc().encode())
                raise
            (run.folder / PROGRESS).unlink(missing_ok=True)
            return outcome
    except Timeout:
        return "busy"
