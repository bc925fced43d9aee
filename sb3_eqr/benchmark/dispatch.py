"""Execute all runs of a benchmark, each as a Ray task, and show a table of their progress."""

import contextlib
import datetime
import logging
import os
import socket
import time
from collections import Counter
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


def make_table(runs: list[Run], states: list[State]) -> Table:
    """
    :param runs: runs of the benchmark
    :param states: their states
    :return: a row per agent, and one for all agents
    """
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


def run_benchmark(
    runs: list[Run],
    settings: Settings,
    address: str | None = None,
    cpus_per_run: float = 1.0,
    gpus_per_run: float = 0.0,
    console: Console | None = None,
) -> list[Run]:
    """
    Execute all runs: finished runs are skipped, interrupted ones resume from their last checkpoint, runs that another
    process holds are waited for. A run that crashes twice has failed; the others continue.

    :param runs: runs of the benchmark
    :param settings: settings of all runs
    :param address: address of a Ray cluster that can access the benchmark's folder; ``None``: this machine
    :param cpus_per_run: CPUs that Ray reserves for a run
    :param gpus_per_run: GPUs that Ray reserves for a run, such as 0.1 for ten runs per GPU
    :param console: where to print the table
    :return: the runs that failed
    :raises ImportError: if Ray is not installed
    :raises ConnectionError: if no cluster answers at the address
    :raises ValueError: if no machine of the cluster has the resources of a run, which would wait forever
    """
    console = console or Console()
    waiting = [run for run in runs if run.state().name != "done"]
    if len(waiting) < len(runs):
        console.print(f"{len(runs) - len(waiting)} of {len(runs)} runs are already finished.")
    if not waiting:
        return []
    console.print("Connecting to Ray ..." if address else "Starting Ray ...")
    ray = _start_ray(address)
    try:
        for name, flag, needed in (("CPU", "--cpus-per-run", cpus_per_run), ("GPU", "--gpus-per-run", gpus_per_run)):
            there = max((node["Resources"].get(name, 0) for node in ray.nodes() if node["Alive"]), default=0)
            if needed > there:
                raise ValueError(f"{flag} must be <= {there:g}, the {name}s of the largest machine, got {needed:g}.")
        task = ray.remote(num_cpus=cpus_per_run, num_gpus=gpus_per_run, max_retries=0)(execute)
        return finish(ray, task, runs, waiting, settings, console)
    finally:
        ray.shutdown()


def _start_ray(address: str | None) -> Any:
    """:return: the module ``ray``, connected to the cluster at the address, or to a new one on this machine"""
    try:
        import ray
    except ImportError as error:
        raise ImportError('Ray is not installed. Run pip install ".[benchmark]" in a clone of the repository') from error
    host, _, port = (address or "").rpartition(":")
    if host and port.isdigit() and "/" not in host:  # else "auto", or another of Ray's forms
        try:
            socket.create_connection((host, int(port)), timeout=5).close()
        except OSError as error:  # Ray would wait for minutes and then exit the process
            raise ConnectionError(
                f"--address: no Ray cluster answers at {address} ({error}). Start one with ray start --head."
            ) from error
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # as Ray's own warning recommends
    local: dict[str, Any] = {} if address else {"include_dashboard": False}
    try:
        ray.init(address=address or "local", logging_level=logging.ERROR, log_to_driver=False, **local)
    except ConnectionError as error:
        raise ConnectionError(f"{error}. If it asks for a token, set RAY_AUTH_MODE=token (docs/benchmark.md).") from error
    return ray


def finish(ray: Any, task: Any, runs: list[Run], waiting: list[Run], settings: Settings, console: Console) -> list[Run]:
    """
    :param ray: the module, connected to a cluster
    :param task: the remote function that executes a run
    :param runs: runs of the benchmark
    :param waiting: the runs that are not finished
    :param settings: settings of all runs
    :param console: where to print the table
    :return: the runs that failed
    """
    states = [run.state() for run in runs]
    running = {task.remote(run, settings): run for run in waiting}
    busy: list[tuple[float, Run]] = []  # when to retry
    crashes: Counter[str] = Counter()
    failed = []
    with Live(make_table(runs, states), console=console, auto_refresh=False, transient=True) as live:
        while running or busy:
            now = time.monotonic()
            running |= {task.remote(run, settings): run for when, run in busy if when <= now}
            busy = [(when, run) for when, run in busy if when > now]
            if not running:
                time.sleep(REFRESH_SECONDS)
            for reference in ray.wait(list(running), timeout=REFRESH_SECONDS)[0] if running else []:
                run = running.pop(reference)
                try:
                    is_busy = ray.get(reference) == "busy"
                except ray.exceptions.RayError as error:
                    crashes[run.label] += 1
                    is_lost = crashes[run.label] == ATTEMPTS
                    _note_crash(run, error, is_lost, console)
                    if is_lost:
                        failed.append(run)
                    else:
                        running[task.remote(run, settings)] = run
                    continue
                if is_busy:
                    busy.append((time.monotonic() + BUSY_SECONDS, run))
                else:
                    _say(console, f"{run.label}: finished")
            states = [state if state.name == "done" else run.state() for run, state in zip(runs, states, strict=True)]
            live.update(make_table(runs, states), refresh=console.is_terminal)
    console.print(make_table(runs, states))
    return failed


def _note_crash(run: Run, error: Exception, is_lost: bool, console: Console) -> None:
    cause = getattr(error, "cause", None) or error
    reason = " ".join([type(cause).__name__, *str(cause).strip().splitlines()[-1:]])
    _say(console, f"{run.label}: crashed ({reason}). {f'See {run.folder / ERROR}' if is_lost else 'Retrying once.'}")
    if is_lost and not (run.folder / ERROR).is_file():  # killed before it could write one
        with contextlib.suppress(OSError), atomic_write(run.folder / ERROR, "txt") as file:
            file.write(str(error).encode())


def _say(console: Console, text: str) -> None:
    """Print a line above the table."""
    console.print(text, soft_wrap=True, markup=False, highlight=False)
