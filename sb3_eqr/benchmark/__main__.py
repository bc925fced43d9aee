"""The command line: ``sb3-eqr benchmark run|status|report``."""

import argparse
import pathlib
import shlex
import sys

import torch as th
from rich.console import Console

from sb3_eqr.benchmark.dispatch import make_table, run_benchmark
from sb3_eqr.benchmark.runs import ERROR, Run, Settings, plan_runs, read_plan, write_plan
from sb3_eqr.benchmark.selection import never_learn
from sb3_eqr.benchmark.suites import choose, load_suite
from sb3_eqr.zoo.checks import check_machine, fail

SEEDS = 5  # of a benchmark where the user does not say


def absolute(path: str) -> pathlib.Path:
    """:return: the path as every machine of a cluster understands it"""
    return pathlib.Path(path).resolve()


def make_parser() -> argparse.ArgumentParser:
    """:return: of the three commands"""
    parser = argparse.ArgumentParser(prog="sb3-eqr benchmark", description="Compare agents, with evidence.")
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="train and evaluate agents on a suite; the same command resumes where it stopped")
    run.add_argument("folder", type=absolute, help="where everything is written")
    run.add_argument("--suite", help="atari100k, atari100k-5, minatar, classic, smoke, or one of --suite-file")
    run.add_argument("--suite-file", type=pathlib.Path, help="a YAML file with suites of your own")
    run.add_argument("--agents", nargs="+", help="ALGO or ALGO:ENTRIES, such as qrdqn, qrdqn:stock, eqr_rainbow:se2+aet")
    run.add_argument("--games", nargs="+", help="some games of the suite (default: all)")
    run.add_argument("--seeds", type=int, help=f"number of seeds, from 0 (default: {SEEDS})")
    run.add_argument("--steps", type=int, help="training steps instead of the suite's")
    run.add_argument("--device", default="auto", help="of PyTorch (default: the GPU with --gpus-per-run, else cpu)")
    run.add_argument("--address", help="of a Ray cluster that sees the folder (default: this machine)")
    run.add_argument("--cpus-per-run", type=float, default=1.0, help="CPUs, and threads of PyTorch, of a run (default: 1)")
    run.add_argument("--gpus-per-run", type=float, default=0.0, help="GPUs of a run, such as 0.1 (default: 0)")
    run.add_argument("--checkpoint-every", type=float, default=300.0, metavar="SECONDS", help="(default: 300)")
    status = commands.add_parser("status", help="where a benchmark stands")
    status.add_argument("folder", type=pathlib.Path)
    report = commands.add_parser("report", help="scores, tables, figures and report.html")
    report.add_argument("folders", nargs="+", type=pathlib.Path, metavar="folder", help="of a benchmark, or of several")
    report.add_argument("--reference", action="append", default=[], metavar="NAME=FILE", help="JSON: game -> scores of runs")
    report.add_argument("--agents", nargs="+", default=[], help="some of the agents (default: all)")
    report.add_argument("--baseline", help="the agent that the others are held against (default: the first stock one)")
    report.add_argument(
        "--force", action="store_true", help="compare in spite of other protocols or missing games; it is marked"
    )
    report.add_argument("--output", type=pathlib.Path, help="where it is written (default: FOLDER/report)")
    return parser


def check_resources(args: argparse.Namespace) -> str:
    """
    :param args: of ``run``
    :return: the device of every run
    :raises ValueError: if runs cannot have what they need
    """
    if args.cpus_per_run <= 0 or args.gpus_per_run < 0:
        found = f"{args.cpus_per_run} and {args.gpus_per_run}"
        raise ValueError(f"--cpus-per-run, --gpus-per-run: expected > 0 and >= 0, found {found}")
    if args.checkpoint_every < 0:
        raise ValueError(f"--checkpoint-every: expected seconds >= 0, found {args.checkpoint_every}")
    if args.address is None and args.gpus_per_run > th.cuda.device_count():  # Ray would say so, once it is started
        raise ValueError(f"--gpus-per-run: expected at most {th.cuda.device_count()} GPUs, found {args.gpus_per_run:g}")
    device = "cpu" if args.device == "auto" and args.gpus_per_run == 0 else args.device
    if args.address is None:  # else the machines of the cluster count
        check_machine(device, False, "")
    if device.startswith("cuda") and args.gpus_per_run == 0:
        raise ValueError(f"--device {device}: expected --gpus-per-run above 0, such as 0.1 for ten runs on a GPU")
    return device


def make_plan(args: argparse.Namespace) -> list[Run]:
    """
    :param args: of ``run``
    :return: the runs of the benchmark, written into its folder
    :raises ValueError: for wrong use
    """
    if args.suite is None and args.agents is None:
        for name in ("suite_file", "games", "seeds", "steps"):
            if getattr(args, name) is not None:
                flag = f"--{name.replace('_', '-')}"
                raise ValueError(f"{flag}: expected --suite and --agents with it; FOLDER alone resumes what it holds")
        return read_plan(args.folder)
    if args.suite is None or args.agents is None:
        raise ValueError("expected both --suite and --agents, or neither to resume what the folder holds")
    if args.steps is not None and args.steps < 1:
        raise ValueError(f"--steps: expected at least 1, found {args.steps}")
    suite = choose(load_suite(args.suite, args.suite_file), args.games, args.steps)
    runs = plan_runs(args.folder, suite, args.agents, SEEDS if args.seeds is None else args.seeds)
    write_plan(args.folder, suite, runs)
    return runs


def run(args: argparse.Namespace) -> int:
    """:return: exit status: 1 if a run failed"""
    device = check_resources(args)
    runs = make_plan(args)
    for note in never_learn([planned.description() for planned in runs]):
        print(f"Note: {note}")
    command = shlex.join(["sb3-eqr", "benchmark", *sys.argv[1:]])
    threads = max(int(args.cpus_per_run), 1)
    settings = Settings(command=command, device=device, n_threads=threads, checkpoint_seconds=args.checkpoint_every)
    failed = run_benchmark(runs, settings, args.address, args.cpus_per_run, args.gpus_per_run, Console())
    for lost in failed:
        print(f"failed: {lost.label}: {lost.folder / ERROR}")
    if failed:
        print("The same command tries them again, from their last checkpoints.")
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
    from sb3_eqr.benchmark.report import write_report

    references = {}
    for text in args.reference:
        name, separator, path = text.partition("=")
        if not (name and separator and path):
            raise ValueError(f"--reference: expected NAME=FILE, found {text!r}")
        references[name] = pathlib.Path(path)
    output = args.output or args.folders[0] / "report"
    command = shlex.join(["sb3-eqr", "benchmark", *sys.argv[1:]])
    path = write_report(args.folders, references, args.force, output, args.agents, args.baseline, command)
    print(f"Written: {path}")
    return 0


def main() -> None:
    """Parse the command line and do what it says."""
    args = make_parser().parse_args()
    try:
        sys.exit({"run": run, "status": status, "report": report}[args.command](args))
    except (ValueError, ImportError, ConnectionError, OSError) as error:
        fail(f"benchmark {args.command}: {error}")
    except KeyboardInterrupt:
        fail("stopped. The same command resumes, from the last checkpoints where there are any.")


if __name__ == "__main__":
    main()
