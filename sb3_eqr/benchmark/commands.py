"""The commands ``sb3-eqr benchmark run|status|report``, apart from the parser, whose help needs none of these imports."""

import argparse
import pathlib
import shlex
import sys

import torch as th
from rich.console import Console

from sb3_eqr.benchmark.dispatch import make_table, run_benchmark
from sb3_eqr.benchmark.runs import ERROR, Run, Settings, plan_runs, read_plan, with_present_defaults, write_plan
from sb3_eqr.benchmark.selection import never_learn
from sb3_eqr.benchmark.suites import choose, load_suite
from sb3_eqr.envs import import_packages
from sb3_eqr.zoo.checks import check_device, fail


def check_resources(args: argparse.Namespace) -> str:
    """
    :param args: arguments of ``run``
    :return: the device of every run
    :raises ValueError: for resources that are invalid or not available
    """
    if args.cpus_per_run <= 0 or args.gpus_per_run < 0:
        found = f"{args.cpus_per_run} and {args.gpus_per_run}"
        raise ValueError(f"--cpus-per-run must be > 0 and --gpus-per-run >= 0, got {found}.")
    if args.checkpoint_every < 0:
        raise ValueError(f"--checkpoint-every must be >= 0 seconds, got {args.checkpoint_every}.")
    if args.address is None and args.gpus_per_run > th.cuda.device_count():  # before Ray is started
        raise ValueError(
            f"--gpus-per-run must be <= {th.cuda.device_count()}, the GPUs of this machine, got {args.gpus_per_run:g}."
        )
    device = "cpu" if args.device == "auto" and args.gpus_per_run == 0 else args.device
    if args.address is None:  # the machines of a cluster may have other devices
        check_device(device)
    if device.startswith("cuda") and args.gpus_per_run == 0:
        raise ValueError(f"--gpus-per-run must be > 0 with --device {device}, got 0. 0.1 puts ten runs on a GPU.")
    return device


def _command() -> str:
    return shlex.join(["sb3-eqr", "benchmark", *sys.argv[1:]])


def make_plan(args: argparse.Namespace) -> list[Run]:
    """
    :param args: arguments of ``run``
    :return: the runs of the benchmark, whose plan is in its folder
    :raises ValueError: for invalid arguments
    """
    if args.suite is None and args.agents is None:
        for name in ("suite_file", "games", "seeds", "steps"):
            if getattr(args, name) is not None:
                flag = f"--{name.replace('_', '-')}"
                raise ValueError(f"{flag} needs --suite and --agents. FOLDER alone resumes the runs in it.")
        return with_present_defaults(read_plan(args.folder))
    if args.suite is None or args.agents is None:
        raise ValueError("--suite and --agents must be given together. Without both, FOLDER resumes the runs in it.")
    if args.steps is not None and args.steps < 1:
        raise ValueError(f"--steps must be >= 1, got {args.steps}.")
    suite = choose(load_suite(args.suite, args.suite_file), args.games, args.steps)
    n_seeds, command = args.default_seeds if args.seeds is None else args.seeds, _command()
    runs = plan_runs(args.folder, suite, args.agents, n_seeds, command)
    write_plan(args.folder, suite, runs)
    return runs


def run(args: argparse.Namespace) -> int:
    """:return: exit status: 1 if a run failed"""
    import_packages(args.gym_packages)
    device = check_resources(args)
    runs = make_plan(args)
    for note in never_learn([planned.description() for planned in runs]):
        print(f"Note: {note}")
    threads = max(int(args.cpus_per_run), 1)
    settings = Settings(
        device=device,
        n_threads=threads,
        checkpoint_seconds=args.checkpoint_every,
        gym_packages=args.gym_packages,
        save_models=args.save_models,
    )
    console = Console()
    if not console.is_terminal:  # which shows a table that changes
        print(f"Progress: sb3-eqr benchmark status {shlex.quote(str(args.folder))}", flush=True)
    failed = run_benchmark(runs, settings, args.address, args.cpus_per_run, args.gpus_per_run, console)
    for lost in failed:
        print(f"failed: {lost.label}: {lost.folder / ERROR}")
    if failed:
        print("The same command retries them from their last checkpoints.")
    else:
        print(f"All runs are finished. sb3-eqr benchmark report {shlex.quote(str(args.folder))}")
    return 1 if failed else 0


def status(args: argparse.Namespace) -> int:
    """:return: exit status"""
    runs = read_plan(args.folder)
    states = [run.state() for run in runs]
    Console().print(make_table(runs, states))
    for run, state in zip(runs, states, strict=True):
        if state.name == "failed":
            reason = (run.folder / ERROR).read_text(encoding="utf-8").strip().splitlines()[-1]
            print(f"failed: {run.label}: {reason}")
    return 0


def report(args: argparse.Namespace) -> int:
    """:return: exit status"""
    from sb3_eqr.benchmark.report import write_report  # rliable and seaborn take seconds to import

    references = {}
    for text in args.reference:
        name, separator, path = text.partition("=")
        if not (name and separator and path):
            raise ValueError(f"--reference must be NAME=FILE, got {text!r}.")
        references[name] = pathlib.Path(path)
    output = args.output or args.folders[0] / "report"
    path = write_report(args.folders, references, args.force, output, args.agents, args.baseline, _command())
    print(f"Written: {path}")
    return 0


def execute(args: argparse.Namespace) -> None:
    """Run a command and exit with its status, or with a message and status 2 if the user has to do something."""
    try:
        sys.exit({"run": run, "status": status, "report": report}[args.command](args))
    except (ValueError, ImportError, ConnectionError, OSError) as error:
        fail(f"benchmark {args.command}: {error}")
    except KeyboardInterrupt:
        fail("interrupted. The same command continues: runs resume from their last checkpoint, or start again without one.")
