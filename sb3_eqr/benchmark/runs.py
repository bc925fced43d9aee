"""The runs of a benchmark as folders, which hold each run's plan and state for every process."""

import dataclasses
import json
import pathlib
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

from filelock import FileLock, Timeout

from sb3_eqr.benchmark.agents import Agent, defaults, find_agent, hyperparameters
from sb3_eqr.benchmark.evaluation import check_game
from sb3_eqr.benchmark.selection import ABSENT, flatten
from sb3_eqr.benchmark.suites import Strict, Suite, merge, read_suite, write_suite
from sb3_eqr.common.saving.checkpoints import PREFIX, find_checkpoints
from sb3_eqr.common.saving.files import atomic_write
from sb3_eqr.zoo import register

SUITE = "suite.yml"  # in the folder of the benchmark
RESULT, PLAN, PROGRESS, ERROR, LOCK = "result.json", "run.json", "progress.json", "error.txt", "lock"  # in that of a run
STOPPED = "stopped.json"  # the row of a run that was stopped before its end; its checkpoint is next to it
MODELS = "models"  # RL Zoo's log folder of a run
STARTS = "starts.txt"  # a line for each time that a run starts or resumes


class Settings(Strict):
    """Settings that do not affect the scores."""

    device: str = "auto"
    n_threads: int = 1  # of PyTorch
    checkpoint_seconds: float = 300.0  # between checkpoints
    gym_packages: list[str] = []  # which register environments
    save_models: bool = False  # of trained agents, in the format of RL Zoo
    stop_at: float | None = None  # in seconds since the epoch; None: never

    def is_over(self) -> bool:
        """:return: whether the time to stop has passed"""
        return self.stop_at is not None and time.time() >= self.stop_at


class State(NamedTuple):
    """The progress of a run."""

    name: str  # "done", "running", "failed" or "waiting"
    step: int  # training steps done
    steps_per_second: float = 0.0  # while it is running


@dataclasses.dataclass(frozen=True)
class Run:
    """
    One agent on one game with one seed, in a folder of its own.

    For ``protocol``, ``entry`` and ``defaults`` see :meth:`~sb3_eqr.benchmark.suites.Suite.protocol`,
    :func:`~sb3_eqr.benchmark.agents.hyperparameters` and :func:`~sb3_eqr.benchmark.agents.defaults`.
    """

    folder: pathlib.Path
    agent: Agent
    suite: str  # its name
    game: str
    seed: int  # of agent, environments and evaluation
    protocol: dict[str, Any]
    entry: dict[str, Any]
    command: str = ""  # that planned the run, with its suite and agents
    defaults: dict[str, Any] = dataclasses.field(default_factory=dict)  # empty in plans of versions that did not record them

    @property
    def label(self) -> str:
        """The name of the run in messages."""
        return f"{self.agent.name}, {self.game}, seed {self.seed}"

    def description(self) -> dict[str, Any]:
        """:return: the content of ``run.json``: what was requested"""
        return {
            "agent": self.agent.name,
            "game": self.game,
            "seed": self.seed,
            "suite": self.suite,
            "protocol": self.protocol,
            "entry": {"algo": self.agent.algo, "file": str(self.agent.file), "hyperparameters": self.entry},
            "defaults": self.defaults,
            "command": self.command,
        }

    def state(self) -> State:
        """:return: the progress of the run"""
        if (self.folder / RESULT).is_file():
            return State("done", self.protocol["steps"])
        if self.is_locked():
            try:
                progress = json.loads((self.folder / PROGRESS).read_text(encoding="utf-8"))
            except FileNotFoundError:  # not written yet, or removed with the lock, because the run has just finished
                progress = {}
            return State("running", progress.get("step", 0), progress.get("steps_per_second", 0.0))
        kept = find_checkpoints(self.folder)  # from which it resumes
        step = int(kept[-1].name.removeprefix(PREFIX)) if kept else 0
        return State("failed" if (self.folder / ERROR).is_file() else "waiting", step)

    def has_begun(self) -> bool:
        """:return: whether the plan says how it was started: there is a result, or something that more steps would continue"""
        is_planned = (self.folder / PLAN).is_file()
        return is_planned and ((self.folder / RESULT).is_file() or bool(find_checkpoints(self.folder)) or self.is_locked())

    def write_plan(self) -> None:
        """Write ``run.json``, unless the run has begun."""
        if not self.has_begun():
            write_json(self.folder / PLAN, self.description())

    def check_plan(self) -> None:
        """:raises ValueError: if the run has begun with other settings"""
        if not self.has_begun():
            return
        old = json.loads((self.folder / PLAN).read_text(encoding="utf-8"))
        new = json.loads(to_json(self.description()))
        for what in ("protocol", "entry", "defaults"):
            if not old.get(what):
                continue  # begun by a version that did not record the defaults
            before, now = flatten(old[what]), flatten(new[what])
            absent = ABSENT if what == "entry" else None  # versions may add defaults
            for key in sorted((before.keys() | now.keys()) - {"file"}):
                was, is_now = before.get(key, absent), now.get(key, absent)
                if was != is_now:
                    raise ValueError(
                        f"{self.folder}: {key} must be {was!r}, as when the run was started, got {is_now!r}. "
                        "Scores of different settings are not comparable: use another folder, or the same settings."
                    )

    def is_locked(self) -> bool:
        """:return: whether a process holds the run"""
        if not (self.folder / LOCK).is_file():
            return False
        try:
            with FileLock(self.folder / LOCK, blocking=False):
                return False
        except Timeout:
            return True


def to_json(value: Any) -> str:
    """:return: the text that goes into files"""
    return json.dumps(value, indent=1, default=str)


def write_json(path: pathlib.Path, value: Any) -> None:
    """Write a temporary file next to ``path`` and rename it."""
    with atomic_write(path, "json") as file:
        file.write(to_json(value).encode())


def plan_runs(folder: pathlib.Path, suite: Suite, agents: list[str], seeds: Sequence[int], command: str = "") -> list[Run]:
    """
    Plan the runs of a benchmark, without writing anything. The seed is the outermost loop, so that an interrupted benchmark
    has complete tables of fewer seeds.

    :raises ValueError: for two agents of the same name, or for runs that exist with other settings
    """
    found = [find_agent(text) for text in agents]
    names = [agent.name for agent in found]
    if twice := {name for name in names if names.count(name) > 1}:
        raise ValueError(f"--agents must be different agents, got {', '.join(sorted(twice))} more than once.")
    runs = []
    for game in suite.games:
        protocol = suite.protocol(game)
        action_space = check_game(protocol)
        for agent in found:
            entry = hyperparameters(agent, protocol, action_space)
            place = folder / "runs" / agent.name.replace(":", "-") / game.replace("/", "-")
            settings = protocol, entry, command, defaults(agent, entry)
            runs += [Run(place / str(seed), agent, suite.name, game, seed, *settings) for seed in seeds]
    for run in runs:
        run.check_plan()
    return sorted(runs, key=lambda run: seeds.index(run.seed))


def with_present_defaults(runs: list[Run]) -> list[Run]:
    """
    :return: the same, where those without a result have the defaults of this version of the package
    :raises ValueError: if a run that has begun was started with others
    """
    register()
    found = []
    for run in runs:
        if not (run.folder / RESULT).is_file():
            run = dataclasses.replace(run, defaults=defaults(run.agent, run.entry))
        run.check_plan()
        run.write_plan()
        found.append(run)
    return found


def write_plan(folder: pathlib.Path, suite: Suite, runs: list[Run]) -> None:
    """
    Write the plan of the benchmark into its folder. Games that the folder already has are kept.

    :raises ValueError: if the folder is for another suite
    """
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / f".{SUITE}.lock"):  # two commands may add games at once
        path = folder / SUITE
        write_suite(merge(read_suite(path), suite) if path.is_file() else suite, path)
    for run in runs:
        run.write_plan()


def read_plan(folder: pathlib.Path) -> list[Run]:
    """
    :return: the runs in a folder
    :raises ValueError: if there are none
    """
    runs = []
    for path in sorted(folder.glob(f"runs/*/*/*/{PLAN}"), key=lambda path: (int(path.parent.name), path)):
        try:
            plan = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"{path} must be the plan of a run, got a damaged file ({error}). Remove its folder.") from error
        agent = Agent(plan["agent"], plan["entry"]["algo"], pathlib.Path(plan["entry"]["file"]))
        settings = plan["protocol"], plan["entry"]["hyperparameters"], plan.get("command", ""), plan.get("defaults", {})
        runs.append(Run(path.parent, agent, plan["suite"], plan["game"], plan["seed"], *settings))
    if not runs:
        raise ValueError(
            f"{folder} must be the folder of a benchmark, got one without runs. Start a benchmark with "
            "sb3-eqr benchmark run DIR --suite SUITE --agents AGENT ..."
        )
    return runs
