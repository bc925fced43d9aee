"""What a run measures while it trains: scores, losses, evaluations, times; and its checkpoints."""

import platform
import time
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter

from sb3_eqr.benchmark.checkpoints import write_checkpoint
from sb3_eqr.benchmark.evaluation import evaluate
from sb3_eqr.benchmark.run import PROGRESS, Run, Settings, write_json
from sb3_eqr.common.resets import Resets

PROGRESS_SECONDS = 2.0  # between two notes of where a run is


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
        resets: Resets | None = getattr(self.model, "_resets", None)
        if resets is None or resets.schedule.interval is None or not resets.done:
            return True
        return 2 * resets.updates_since(self.model._n_updates) >= resets.schedule.interval  # type: ignore[attr-defined]

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
