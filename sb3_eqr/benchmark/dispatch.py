"""Execute all runs of a benchmark, each in a process of its own, and show a table of their progress."""

import contextlib
import datetime
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import Counter
from functools import partial
from multiprocessing import connection
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Column, Table

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
    """A pool of processes, one per run, which returns all memory of the run when it ends. A cluster has the same methods."""

    def __init__(self, settings: Settings, slots: int):
        self.slots = slots  # number of processes at once
        self._settings = settings
        self._open: dict[Any, Run] = {}
        os.environ["OMP_NUM_THREADS"] = str(settings.n_threads)  # inherited, and read by PyTorch when it is imported

    def start(self, run: Run) -> Any:
        """:return: a process that ignores Ctrl-C, which reaches every process of a terminal and is for the parent to handle"""
        process = SPAWN.Process(target=work, args=(run, self._settings))
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN)  # inherited
        try:
            process.start()
        finally:
            signal.signal(signal.SIGINT, handler)
        self._open[process] = run
        return process

    def wait(self, handles: list[Any], timeout: float) -> list[Any]:
        """:return: processes that have ended"""
        ended = connection.wait([process.sentinel for process in handles], timeout)
        return [process for process in handles if process.sentinel in ended]

    def outcome(self, handle: Any) -> str:
        """
        :return: what :func:`execute` returned
        :raises Crash: if a signal killed the process, or an exception ended it
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
    multiprocessing.parent_process().join()  # type: ignore[union-attr]
    os._exit(1)


def last_line(run: Run) -> str:
    """:return: the last line of what stopped a run, or of what it printed; "" without either"""
    for path in (run.folder / ERROR, run.folder / LOG):
        if path.is_file() and (text := path.read_text(encoding="utf-8", errors="replace").strip()):
            return text.split("\n")[-1].strip()
    return ""


def make_table(runs: list[Run], states: list[State]) -> Table:
    """:return: a row per agent, and one for all agents"""
    numbers = [Column(name, justify="right") for name in ("done", "running", "waiting", "failed", "steps", "steps/s")]
    table = Table("agent", *numbers, box=None, pad_edge=False, caption_justify="left")
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

    :param runs: all runs, for the table
    :param waiting: those that are not finished, in order
    :return: the runs that failed
    """
    states = [run.state() for run in runs]
    queue, running, failed = list(waiting), dict[Any, Run](), []
    busy_until: dict[str, float] = {}  # for runs that another process holds
    crashes: Counter[str] = Counter()
    say = partial(console.print, soft_wrap=True, markup=False, highlight=False)  # a line above the table
    with Live(make_table(runs, states), console=console, auto_refresh=False, transient=True) as live:
        while running or queue:
            if settings.is_over():
                queue.clear()
            for run in [run for run in queue if busy_until.get(run.label, 0) <= time.monotonic()]:
                if len(running) < pool.slots:
                    queue.remove(run)
                    running[pool.start(run)] = run
            if queue and not running:
                time.sleep(REFRESH_SECONDS)
            for handle in pool.wait(list(running), REFRESH_SECONDS) if running else []:
                run = running.pop(handle)
                try:
                    outcome = pool.outcome(handle)
                except Crash as crash:
                    crashes[run.label] += 1
                    if crashes[run.label] < ATTEMPTS:
                        say(f"{run.label}: crashed ({crash}). Retrying once.")
                        queue.insert(0, run)
                    else:
                        say(f"{run.label}: crashed ({crash}). See {run.folder / ERROR}")
                        _note_crash(run, crash)
                        failed.append(run)
                    continue
                if outcome == "busy":
                    busy_until[run.label] = time.monotonic() + BUSY_SECONDS
                    queue.append(run)
                else:
                    say(f"{run.label}: {outcome}")
            states = [state if state.name == "done" else run.state() for run, state in zip(runs, states, strict=True)]
            live.update(make_table(runs, states), refresh=console.is_terminal)
    console.print(make_table(runs, states))
    return failed


def _note_crash(run: Run, crash: Crash) -> None:
    """A run that is killed cannot write its error itself."""
    if not (run.folder / ERROR).is_file():
        with contextlib.suppress(OSError), atomic_write(run.folder / ERROR, "txt") as file:
            file.write(str(crash).encode())
