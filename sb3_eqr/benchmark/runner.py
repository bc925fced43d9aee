"""Running a benchmark: one task of Ray per run, and the table that shows where they are."""

import contextlib
import datetime
import logging
import os
import socket
import time
from collections import Counter, deque
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from sb3_eqr.benchmark.plan import State, seconds_left, state_of
from sb3_eqr.benchmark.run import ERROR, Run, Settings
from sb3_eqr.benchmark.training import execute
from sb3_eqr.common.files import atomic_write

ATTEMPTS = 2  # a run that crashes is retried once
REFRESH_SECONDS = 2.0
BUSY_SECONDS = 5.0  # before a run that another process has is asked for again


def make_table(runs: list[Run], states: list[State]) -> Table:
    """
    :param runs: of the benchmark
    :param states: as many
    :return: a row per agent, and one for all
    """
    table = Table(box=None, pad_edge=False, caption_justify="left")
    for column in ("agent", "done", "running", "waiting", "failed", "steps", "steps/s"):
        table.add_column(column, justify="left" if column == "agent" else "right")
    names = list(dict.fromkeys(run.agent.name for run in runs))
    for name in [*names, "all"]:
        rows = [(run, state) for run, state in zip(runs, states, strict=True) if name in (run.agent.name, "all")]
        counts = Counter(state.name for _, state in rows)
        share = sum(state.step for _, state in rows) / sum(run.protocol["steps"] for run, _ in rows)
        rate = sum(state.steps_per_second for _, state in rows)
        cells = [f"{counts['done']}/{len(rows)}", *(str(counts[key] or "") for key in ("running", "waiting", "failed"))]
        table.add_row(name, *cells, f"{share:.0%}", f"{rate:.0f}" if rate else "")
    left = seconds_left(runs, states)
    if left is not None:
        table.caption = f"about {datetime.timedelta(seconds=round(left))} left" if left >= 1 else "in the last evaluations"
    return table


def start_ray(address: str | None) -> Any:
    """
    :param address: of a cluster; ``None``: start Ray on this machine
    :return: the module
    :raises ImportError: without Ray
    :raises ConnectionError: if there is no cluster at the address
    """
    try:
        import ray
    except ImportError as error:
        raise ImportError('benchmark run needs Ray: pip install "sb3-eqr[benchmark]"') from error
    check_address(address)
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # what Ray's own warning asks for
    local: dict[str, Any] = {} if address else {"include_dashboard": False}
    ray.init(address=address or "local", logging_level=logging.ERROR, log_to_driver=False, **local)
    return ray


def check_address(address: str | None) -> None:
    """
    :raises ConnectionError: if nothing answers at HOST:PORT, for which Ray would wait minutes and then end the process
    """
    host, _, port = (address or "").rpartition(":")
    if not host or not port.isdigit() or "/" in host:
        return  # none, "auto", or another form of Ray's
    try:
        socket.create_connection((host, int(port)), timeout=5).close()
    except OSError as error:
        raise ConnectionError(
            f"--address: no Ray cluster answers at {address} ({error}). Start one: ray start --head"
        ) from error


def run_benchmark(
    runs: list[Run],
    settings: Settings,
    address: str | None = None,
    cpus_per_run: float = 1.0,
    gpus_per_run: float = 0.0,
    console: Console | None = None,
) -> list[Run]:
    """
    Finish all runs: those that are finished are skipped, broken ones go on from their last checkpoint, those that another
    process has are waited for, one that crashes twice is left while the others go on.

    :param runs: of the benchmark
    :param settings: of all runs
    :param address: of a Ray cluster that sees the benchmark's folder; ``None``: this machine
    :param cpus_per_run: CPUs that Ray reserves for a run
    :param gpus_per_run: GPUs, such as 0.1 for ten runs on each
    :param console: where the table is shown
    :return: the runs that failed
    :raises ImportError: without Ray
    :raises ConnectionError: if there is no cluster at the address
    """
    console = console or Console()
    states = [state_of(run) for run in runs]
    waiting = deque(index for index, state in enumerate(states) if state.name != "done")
    if len(waiting) < len(runs):
        console.print(f"{len(runs) - len(waiting)} of {len(runs)} runs are finished already.")
    if not waiting:
        return []
    console.print("Connecting to Ray ..." if address else "Starting Ray ...")
    ray = start_ray(address)
    try:
        task = ray.remote(num_cpus=cpus_per_run, num_gpus=gpus_per_run, max_retries=0)(execute)
        check_resources(ray, cpus_per_run, gpus_per_run)
        return Dispatcher(ray, task, runs, states, settings, console).finish(waiting)
    finally:
        ray.shutdown()


def check_resources(ray: Any, cpus_per_run: float, gpus_per_run: float) -> None:
    """
    :raises ValueError: if no machine of the cluster can hold a run, which would wait forever
    """
    for name, flag, needed in (("CPU", "--cpus-per-run", cpus_per_run), ("GPU", "--gpus-per-run", gpus_per_run)):
        there = max((node["Resources"].get(name, 0) for node in ray.nodes() if node["Alive"]), default=0)
        if needed > there:
            raise ValueError(f"{flag}: expected at most the {there:g} {name}s of the largest machine, found {needed:g}")


class Dispatcher:
    """
    Hands runs to Ray and takes in what became of them.

    :param ray: the module, connected
    :param task: the remote function of a run
    :param runs: of the benchmark
    :param states: as many, as they were at the start
    :param settings: of all runs
    :param console: where the table is shown
    """

    def __init__(self, ray: Any, task: Any, runs: list[Run], states: list[State], settings: Settings, console: Console):
        self.ray, self.task = ray, task
        self.runs, self.states, self.settings = runs, states, settings
        self.console = console
        self.attempts: Counter[int] = Counter()
        self.failed: list[int] = []
        self.running: dict[Any, int] = {}  # reference -> index of the run
        self.busy: deque[tuple[float, int]] = deque()  # when to ask again, index

    def finish(self, waiting: deque[int]) -> list[Run]:
        """
        :param waiting: indices of the runs that are not finished
        :return: the runs that failed
        """
        with Live(make_table(self.runs, self.states), console=self.console, auto_refresh=False, transient=True) as live:
            for index in waiting:
                self.submit(index)
            while self.running or self.busy:
                now = time.monotonic()
                while self.busy and self.busy[0][0] <= now:
                    self.submit(self.busy.popleft()[1])
                if self.running:
                    ready, _ = self.ray.wait(list(self.running), timeout=REFRESH_SECONDS)
                    for reference in ready:
                        self.take_in(reference)
                else:
                    time.sleep(REFRESH_SECONDS)
                self.look()
                live.update(make_table(self.runs, self.states), refresh=self.console.is_terminal)
        self.console.print(make_table(self.runs, self.states))
        return [self.runs[index] for index in self.failed]

    def submit(self, index: int) -> None:
        """Hand a run to Ray."""
        self.running[self.task.remote(self.runs[index], self.settings)] = index

    def take_in(self, reference: Any) -> None:
        """What became of a run: finished, busy elsewhere, or crashed."""
        index = self.running.pop(reference)
        run = self.runs[index]
        label = f"{run.agent.name}, {run.game}, seed {run.seed}"
        try:
            outcome = self.ray.get(reference)
        except self.ray.exceptions.RayError as error:
            self.attempts[index] += 1
            cause = getattr(error, "cause", None) or error
            reason = " ".join([type(cause).__name__, *str(cause).strip().splitlines()[-1:]])
            again = self.attempts[index] < ATTEMPTS
            what_next = "Trying once more." if again else f"See {run.folder / ERROR}"
            self.say(f"{label}: crashed ({reason}). {what_next}")
            if again:
                self.submit(index)
            else:
                self.failed.append(index)
                if not (run.folder / ERROR).is_file():  # it was killed before it could say anything
                    with contextlib.suppress(OSError), atomic_write(run.folder / ERROR, "txt") as file:
                        file.write(str(error).encode())
            return
        if outcome == "busy":
            self.busy.append((time.monotonic() + BUSY_SECONDS, index))
        else:
            self.say(f"{label}: finished")

    def say(self, text: str) -> None:
        """A line above the table."""
        self.console.print(text, soft_wrap=True, markup=False, highlight=False)

    def look(self) -> None:
        """Where the runs stand now; what is done is not looked at again."""
        for index, state in enumerate(self.states):
            if state.name != "done":
                self.states[index] = state_of(self.runs[index])
