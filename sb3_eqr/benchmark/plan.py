"""What a benchmark is to run, and where it stands: folders of runs, the same for every process that looks at them."""

import json
import pathlib
from typing import Any, NamedTuple

from filelock import FileLock, Timeout

from sb3_eqr.benchmark.agents import Agent, find_agent, hyperparameters
from sb3_eqr.benchmark.checkpoints import find_checkpoints
from sb3_eqr.benchmark.evaluation import check_game
from sb3_eqr.benchmark.run import ERROR, LOCK, PLAN, PROGRESS, RESULT, Run, to_json, write_json
from sb3_eqr.benchmark.selection import flatten
from sb3_eqr.benchmark.suites import Suite, read_suite, write_suite

SUITE = "suite.yml"


class State(NamedTuple):
    """
    :param name: "done", "running", "failed" or "waiting"
    :param step: training steps done
    :param steps_per_second: 0 unless it is running
    """

    name: str
    step: int
    steps_per_second: float


def plan_runs(folder: pathlib.Path, suite: Suite, agents: list[str], n_seeds: int) -> list[Run]:
    """
    The runs of a benchmark; seeds come last, so that a benchmark that is stopped has whole tables of fewer seeds. Nothing
    is written.

    :param folder: of the benchmark
    :param suite: what is played and how
    :param agents: as users write them
    :param n_seeds: seeds count from 0
    :raises ValueError: for agents of the same name, or for runs that are there with another protocol
    """
    if n_seeds < 1:
        raise ValueError(f"--seeds: expected at least 1, found {n_seeds}")
    found = [find_agent(text) for text in agents]
    names = [agent.name for agent in found]
    if twice := {name for name in names if names.count(name) > 1}:
        raise ValueError(f"--agents: expected different agents, found {', '.join(sorted(twice))} more than once")
    entries = {}
    for game in suite.games:
        action_space = check_game(suite.protocol(game))
        for agent in found:
            entries[agent, game] = hyperparameters(agent, suite.protocol(game), action_space)
    runs = [
        Run(run_folder(folder, *key, seed), key[0], suite.name, key[1], seed, suite.protocol(key[1]), entry)
        for seed in range(n_seeds)
        for key, entry in entries.items()
    ]
    for run in runs:
        check_plan(run)
    return runs


def run_folder(folder: pathlib.Path, agent: Agent, game: str, seed: int) -> pathlib.Path:
    """
    :return: the folder of a run
    """
    return folder / "runs" / agent.name.replace(":", "-") / game / str(seed)


def check_plan(run: Run) -> None:
    """
    :raises ValueError: if the folder holds the same run, begun with other settings
    """
    path = run.folder / PLAN
    begun = (run.folder / RESULT).is_file() or find_checkpoints(run.folder) or is_locked(run)
    if not (path.is_file() and begun):
        return
    old, new = json.loads(path.read_text(encoding="utf-8")), json.loads(to_json(run.description()))
    for what in ("protocol", "entry"):
        before, now = (flatten({key: v for key, v in plan[what].items() if key != "file"}) for plan in (old, new))
        for key in sorted(before.keys() | now.keys()):
            if before.get(key) != now.get(key):
                raise ValueError(
                    f"{run.folder}: expected {key} {now.get(key)!r}, found a run with {before.get(key)!r}. "
                    "Scores of different settings do not compare: use another folder, or the same settings."
                )


def write_plan(folder: pathlib.Path, suite: Suite, runs: list[Run]) -> None:
    """
    Note in the folder what is to be run. Games that were there before stay.

    :raises ValueError: if the folder is of another suite
    """
    path = folder / SUITE
    if path.is_file():
        old = read_suite(path)
        if old.name != suite.name:
            raise ValueError(f"{folder}: expected a benchmark of suite {suite.name!r}, found one of {old.name!r}")
        games = [*old.games, *(game for game in suite.games if game not in old.games)]
        scores = old.normalisation.scores | suite.normalisation.scores
        normalisation = suite.normalisation.model_copy(update={"scores": scores})
        update = {"games": games, "steps": old.steps | suite.steps, "normalisation": normalisation}
        suite = suite.model_copy(update=update)
    write_suite(suite, path)
    for run in runs:
        run.folder.mkdir(parents=True, exist_ok=True)
        description = to_json(run.description())
        path = run.folder / PLAN
        if not (path.is_file() and path.read_text(encoding="utf-8") == description):
            write_json(path, run.description())


def read_plan(folder: pathlib.Path) -> list[Run]:
    """
    :return: the runs that a folder holds
    :raises ValueError: if it holds none
    """
    runs = []
    for path in sorted(folder.glob(f"runs/*/*/*/{PLAN}"), key=lambda path: (int(path.parent.name), path)):
        plan = json.loads(path.read_text(encoding="utf-8"))
        agent = Agent(plan["agent"], plan["entry"]["algo"], pathlib.Path(plan["entry"]["file"]))
        entry = plan["entry"]["hyperparameters"]
        runs.append(Run(path.parent, agent, plan["suite"], plan["game"], plan["seed"], plan["protocol"], entry))
    if not runs:
        raise ValueError(
            f"{folder}: expected the folder of a benchmark, found no runs in it. Start one: "
            "sb3-eqr benchmark run DIR --suite SUITE --agents AGENT ..."
        )
    return runs


def state_of(run: Run) -> State:
    """
    :return: where a run stands
    """
    steps = run.protocol["steps"]
    if (run.folder / RESULT).is_file():
        return State("done", steps, 0.0)
    progress = read_progress(run)
    if is_locked(run):
        return State("running", progress.get("step", 0), progress.get("steps_per_second", 0.0))
    return State("failed" if (run.folder / ERROR).is_file() else "waiting", progress.get("step", 0), 0.0)


def read_progress(run: Run) -> dict[str, Any]:
    """
    :return: step, steps, steps_per_second, host; empty before the first note
    """
    try:
        return json.loads((run.folder / PROGRESS).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}


def is_locked(run: Run) -> bool:
    """
    :return: whether a process has the run
    """
    if not (run.folder / LOCK).is_file():
        return False
    try:
        with FileLock(run.folder / LOCK, blocking=False):
            return False
    except Timeout:
        return True


def seconds_left(runs: list[Run], states: list[State]) -> float | None:
    """
    :return: at the speed of the runs that are running; ``None`` if none is
    """
    rate = sum(state.steps_per_second for state in states)
    left = sum(run.protocol["steps"] - state.step for run, state in zip(runs, states, strict=True) if state.name != "failed")
    return left / rate if rate > 0 else None
