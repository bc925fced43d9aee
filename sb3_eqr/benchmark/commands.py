"""The commands ``sb3-eqr benchmark run|status|report|pack``, apart from the parser, whose help needs none of these imports."""

import argparse
import contextlib
import os
import pathlib
import shlex
import sys
import time
from typing import Any

import gymnasium as gym
from rich.console import Console

from sb3_eqr.benchmark.agents import find_agent
from sb3_eqr.benchmark.dispatch import Processes, finish, last_line, make_table
from sb3_eqr.benchmark.packed import pack
from sb3_eqr.benchmark.runs import ERROR, Run, Settings, plan_runs, read_plan, with_present_defaults, write_plan
from sb3_eqr.benchmark.selection import never_learn
from sb3_eqr.benchmark.suites import choose, load_suite
from sb3_eqr.envs import check_registered, import_packages
from sb3_eqr.zoo.checks import check_device, fail


def check_resources(args: argparse.Namespace) -> str:
    """
    :return: the device of every run
    :raises ValueError: for resources that are invalid or not available
    """
    for name, is_right, needed in (
        ("cpus_per_run", args.cpus_per_run > 0, "> 0"),
        ("gpus_per_run", args.gpus_per_run >= 0, ">= 0"),
        ("checkpoint_every", args.checkpoint_every >= 0, ">= 0 seconds"),
        ("stop_after", args.stop_after is None or args.stop_after > 0, "> 0 seconds"),
        ("jobs", args.jobs is None or args.jobs >= 1, ">= 1"),
        ("steps", args.steps is None or args.steps >= 1, ">= 1"),
        ("episodes", args.episodes is None or args.episodes >= 1, ">= 1"),
    ):
        if not is_right:
            raise ValueError(f"--{name.replace('_', '-')} must be {needed}, got {getattr(args, name):g}.")
    if args.ray is None and args.gpus_per_run:
        raise ValueError(
            f"--gpus-per-run needs --ray, got {args.gpus_per_run:g} without it. --device cuda --jobs 16 shares a GPU."
        )
    if args.ray is not None and args.jobs is not None:
        raise ValueError("--jobs cannot be given with --ray, which starts as many runs as its CPUs and GPUs allow.")
    device = "cpu" if args.device == "auto" and args.gpus_per_run == 0 else args.device
    if args.ray is None:  # the machines of a cluster may have other devices
        check_device(device)
    elif device.startswith("cuda") and args.gpus_per_run == 0:
        raise ValueError(f"--gpus-per-run must be > 0 with --ray --device {device}, got 0. 0.1 puts ten runs on a GPU.")
    return device


def make_pool(args: argparse.Namespace, settings: Settings) -> Any:
    """
    :return: where the runs are executed
    :raises ImportError: if Ray is asked for and not installed
    """
    if args.ray is None:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        return Processes(settings, args.jobs or max(int(cores / args.cpus_per_run), 1))
    try:
        from sb3_eqr.benchmark.cluster import Cluster
    except ImportError as error:
        raise ImportError(f'--ray: {error}. Run pip install ".[cluster]" in a clone of the repository') from error
    print("Starting Ray ..." if args.ray == "local" else "Connecting to Ray ...", flush=True)
    return Cluster(settings, args.ray, args.cpus_per_run, args.gpus_per_run)


def _command() -> str:
    return shlex.join(["sb3-eqr", "benchmark", *sys.argv[1:]])


def make_plan(args: argparse.Namespace) -> list[Run]:
    """
    :return: the runs of the benchmark, whose plan is in its folder
    :raises ValueError: for invalid arguments
    """
    if args.suite is None and args.agents is None:
        for name in ("suite_file", "games", "seeds", "first_seed", "steps", "episodes"):
            if getattr(args, name):
                flag = name.replace("_", "-")
                raise ValueError(f"--{flag} needs --suite and --agents. FOLDER alone resumes the runs in it.")
        runs = with_present_defaults(read_plan(args.folder))
        for planned in runs:
            check_registered(planned.protocol["env_id"], f"suite {planned.suite!r}")
        return runs
    if args.suite is None or args.agents is None:
        raise ValueError("--suite and --agents must be given together. Without both, FOLDER resumes the runs in it.")
    suite = choose(load_suite(args.suite, args.suite_file), args.games, args.steps, args.episodes)
    seeds = read_seeds(args.seeds or str(args.default_seeds), args.first_seed)
    runs = plan_runs(args.folder, suite, args.agents, seeds, _command())
    write_plan(args.folder, suite, runs)
    for agent in dict.fromkeys(args.agents):
        print(f"{agent}: hyperparameters of {find_agent(agent).file}")
    return runs


def read_seeds(text: str, first: int) -> list[int]:
    """
    :param text: a number of seeds, or seeds separated by commas
    :param first: the first seed, where ``text`` is a number of them
    :raises ValueError: for anything else, or a seed that is given twice
    """
    found = [int(part) if part.isdecimal() else -1 for part in text.split(",")]
    if min(found) < 0 or len(set(found)) < len(found) or (len(found) == 1 and found[0] == 0) or first < 0:
        raise ValueError(f"--seeds must be >= 1, or different seeds >= 0 such as 1,3; got {text} from --first-seed {first}.")
    if len(found) > 1 and first:
        raise ValueError(f"--first-seed needs a number of seeds, got --seeds {text}. Leave it out.")
    return found if len(found) > 1 else list(range(first, first + found[0]))


def run(args: argparse.Namespace) -> bool:
    """:return: whether a run failed"""
    import_packages(args.gym_packages)
    device = check_resources(args)
    runs = make_plan(args)
    for note in never_learn([planned.description() for planned in runs]):
        print(f"Note: {note}")
    settings = Settings(
        device=device,
        n_threads=max(int(args.cpus_per_run), 1),
        checkpoint_seconds=args.checkpoint_every,
        gym_packages=args.gym_packages,
        save_models=args.save_models,
        stop_at=None if args.stop_after is None else time.time() + args.stop_after,
    )
    waiting = [planned for planned in runs if planned.state().name != "done"]
    if len(waiting) < len(runs):
        print(f"{len(runs) - len(waiting)} of {len(runs)} runs are already finished.")
    console, failed = Console(), []
    if not console.is_terminal:  # which shows a table that changes
        print(f"Progress: sb3-eqr benchmark status {shlex.quote(str(args.folder))}", flush=True)
    if waiting:
        with contextlib.closing(make_pool(args, settings)) as pool:
            failed = finish(pool, runs, waiting, settings, console)
    for lost in failed:
        print(f"failed: {lost.label}: {lost.folder / ERROR}")
    if failed:
        print("The same command retries them from their last checkpoints.")
    elif left := sum(planned.state().name != "done" for planned in runs):
        print(
            f"Stopped after {args.stop_after:g} seconds: {left} of {len(runs)} runs are left. The same command continues them."
        )
    else:
        print(f"All runs are finished. sb3-eqr benchmark report {shlex.quote(str(args.folder))}")
    return bool(failed)


def status(args: argparse.Namespace) -> None:
    """Print the table of runs and why some failed."""
    runs = read_plan(args.folder)
    states = [run.state() for run in runs]
    Console().print(make_table(runs, states))
    for run, state in zip(runs, states, strict=True):
        if state.name == "failed":
            print(f"failed: {run.label}: {last_line(run)}")


def report(args: argparse.Namespace) -> None:
    """Write the report."""
    from sb3_eqr.benchmark.report import write_report  # rliable takes seconds to import

    references = {}
    for text in args.reference:
        name, _, path = text.partition("=")
        if not (name and path):
            raise ValueError(f"--reference must be NAME=FILE, got {text!r}.")
        references[name] = pathlib.Path(path)
    first = args.folders[0]
    output = args.output or (pathlib.Path(first.name.partition(".")[0] + "_report") if first.is_file() else first / "report")
    path = write_report(args.folders, references, args.force, output, args.agents, args.baseline, _command())
    print(f"Written: {path}")


def pack_runs(args: argparse.Namespace) -> None:
    """Pack the runs of a folder."""
    print(f"{pack(args.folder, args.file)} runs in {args.file}")


def execute(args: argparse.Namespace) -> None:
    """Run a command and exit with its status, or with a message and status 2 if the user has to do something."""
    try:
        sys.exit(int({"run": run, "status": status, "report": report, "pack": pack_runs}[args.command](args) or 0))
    except (ValueError, ImportError, OSError, gym.error.Error) as error:
        fail(f"benchmark {args.command}: {error}")
    except KeyboardInterrupt:
        fail("interrupted. The same command continues: runs resume from their last checkpoint, or start again without one.")
