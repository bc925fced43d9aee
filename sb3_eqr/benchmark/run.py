"""One run of a benchmark, as it is asked for: one agent on one game with one seed."""

import dataclasses
import json
import pathlib
from typing import Any

from sb3_eqr.benchmark.agents import Agent
from sb3_eqr.common.files import atomic_write

RESULT, PLAN, PROGRESS, ERROR, LOCK = "result.json", "run.json", "progress.json", "error.txt", "lock"
STARTS = "starts.txt"  # a line whenever the run is begun or resumed


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
