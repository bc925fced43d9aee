"""Execute all runs of a benchmark, each in a process of its own, and show a table of their progress."""

import contextlib
import datetime
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import Counter, deque
from multiprocessing import connection
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from sb3_eqr.benchmark.runs import ERROR, Run, Settings, State
from sb3_eqr.benchmark.training import execute
from sb3_eqr.common.saving.files import atomic_write

ATTEMPTS = 2  # a run that crashes is retried once
REFRESH_SECONDS = 2.0
BUSY_SECONDS = 5.0  # before retrying a run that another process holds
LOG = "log.txt"  # in the folder of a run: what its process prints
SPAWN = multiprocessing.get_context("spawn")  # a forked process would inherit PyTorch's threads
EXIT_CODES = {"finished": 0, "busy": 75, "stopped": 76}


class Crash(Exception):
    """A run ended without an outcome; the message is the reason."""


class Processes:
    """
    A pool of processes, one per run, which returns all memory of the run when it ends. A cluster has the same methods.

    :param settings: settings of all runs
    :param slots: number of processes at once
    """

    def __init__(self, settings: Settings, slots: int):
        self.slots: float = slots
        self._settings = settings
        self._open: dict[Any, Run] = {}

    def start(self, run: Run) -> Any:
        """
        Start a process. It inherits its number of threads, which PyTorch reads when it is imported, and that Ctrl-C, which
        reaches every process of a terminal, is the parent's to handle.
        """
        process = SPAWN.Process(target=work, args=(run, self._settings))
        threads, handler = os.environ.get("OMP_NUM_THREADS"), signal.signal(signal.SIGINT, signal.SIG_IGN)
        os.environ["OMP_NUM_THREADS"] = str(self._settings.n_threads)
        try:
            process.start()
        finally:
            signal.signal(signal.SIGINT, handler)
            del os.environ["OMP_NUM_THREADS"]
            os.environ |= {} if threads is None else {"OMP_NUM_THREADS": threads}
        self._open[process] = run
        return process

    def wait(self, handles: list[Any], timeout: float) -> list[Any]:
        """:return: processes that have ended"""
        ended = connection.wait([process.sentinel for process in handles], timeout)
        return [process for process in handles if process.sentinel in ended]

    def outcome(self, handle: Any) -> str:
        """
        :return: what the run's process returned
        :raises Crash: if a signal killed it, or an exception ended it
        """
        handle.join()
        run = self._open.pop(handle)
        for outcome, code in EXIT_CODES.items():
            if handle.exitcode == code:
                return outcome
        if handle.exitcode < 0:
            raise Crash(f"killed by {signal.Signals(-handle.exitcode).name}")
        raise Crash(last_line(run) or f"exit status {handle.exitcode}")

    def close(self) -> None:
        """End the processes that still run. Their last checkpoints are complete."""
        for process in self._open:
            process.terminate()
        for process in self._open:
            process.join()


def work(run: Run, settings: Settings) -> None:
    """Execute a run as the whole life of this process."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    run.folder.mkdir(parents=True, exist_ok=True)
    log = os.open(run.folder / LOG, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 1)
    os.dup2(log, 2)
    sys.exit(EXIT_CODES[execute(run, settings)])


def _end_with_parent() -> None:
    """A parent that is killed cannot end its processes."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def last_line(run: Run) -> str:
    """:return: the last line of what stopped a run, or of what it printed; "" without either"""
    for path in (run.folder / ERROR, run.folder / LOG):
        lines = path.read_text(encoding="utf-8", errors="replace").split("\n") if path.is_file() else []
        if found := [line.strip() for line in lines if line.strip()]:
            return found[-1]
    return ""


def make_table(runs: list[Run], states: list[State]) -> Table:
    """:return: a row per agent, and one for all agents"""
    table = Table(box=None, pad_edge=False, caption_justify="left")
    for column in ("agent", "done", "running", "waiting", "failed", "steps", "steps/s"):
        table.add_column(column, justify="left" if column == "agent" else "right")
    for name in [*dict.fromkeys(run.agent.name for run in runs), "all"]:
        rows = [(run, state) for run, state in zip(runs, states, strict=True) if name in (run.agent.name, "all")]
        counts = Counter(state.name for _, state in rows)
        left = sum(run.protocol["steps"] - state.step for run, state in rows if state.name != "failed")
        share = sum(state.step for _, state in rows) / sum(run.protocol["steps"] for run, _ in rows)
        rate = sum(state.steps_per_second for _, state in rows)
        cells = [f"{counts['done']}/{len(rows)}", *(str(counts[key] or "") for key in ("running", "waiting", "failed"))]
        table.add_row(name, *cells, f"{share:.0%}", f"{rate:.0f}" if rate else "")
    if rate > 0:  # of all, the last row
        seconds = round(left / rate)
        table.caption = f"about {datetime.timedelta(seconds=seconds)} left" if seconds else "in the last evaluations"
    return table


def finish(pool: Any, runs: list[Run], waiting: list[Run], settings: Settings, console: Console) -> list[Run]:
    """
    Execute runs: interrupted ones resume from their last checkpoint, runs that another process holds are waited for. A run
    that crashes twice has failed; the others continue. When ``settings.stop_at`` has passed, no further run starts.

    :param pool: where to execute them
    :param runs: runs of the benchmark
    :param waiting: the runs that are not finished, in order
    :param settings: settings of all runs
    :param console: where to print the table
    :return: the runs that failed
    """
    states = [run.state() for run in runs]
    queue, running, failed = deque(waiting), dict[Any, Run](), []
    busy: list[tuple[float, Run]] = []  # when to retry
    crashes: Counter[str] = Counter()
    with Live(make_table(runs, states), console=console, auto_refresh=False, transient=True) as live:
        while running or queue or busy:
            if settings.is_over():
                queue.clear()
                busy.clear()
            queue.extend(run for when, run in busy if when <= time.monotonic())
            busy = [(when, run) for when, run in busy if run not in queue]
            while queue and len(running) < pool.slots:
                run = queue.popleft()
                running[pool.start(run)] = run
            if not running and busy:
                time.sleep(REFRESH_SECONDS)
            for handle in pool.wait(list(running), REFRESH_SECONDS) if running else []:
                run = running.pop(handle)
                try:
                    outcome = pool.outcome(handle)
                except Crash as crash:
                    crashes[run.label] += 1
                    is_lost = crashes[run.label] == ATTEMPTS
                    _note_crash(run, crash, is_lost, console)
                    if is_lost:
                        failed.append(run)
                    else:
                        queue.appendleft(run)
                    continue
                if outcome == "busy":
                    busy.append((time.monotonic() + BUSY_SECONDS, run))
                else:
                    _say(console, f"{run.label}: {outcome}")
            states = [state if state.name == "done" else run.state() for run, state in zip(runs, states, strict=True)]
            live.update(make_table(runs, states), refresh=console.is_terminal)
    console.print(make_table(runs, states))
    return failed


def _note_crash(run: Run, crash: Crash, is_lost: bool, console: Console) -> None:
    _say(console, f"{run.label}: crashed ({crash}). {f'See {run.folder / ERROR}' if is_lost else 'Retrying once.'}")
    if is_lost and not (run.folder / ERROR).is_file():  # killed before it could write one
        with contextlib.suppress(OSError), atomic_write(run.folder / ERROR, "txt") as file:
            file.write(str(crash).encode())


def _say(console: Console, text: str) -> None:
    """Print a line above the table."""
    console.print(text, soft_wrap=True, markup=False, highlight=False)
