"""The command line: measure, print, write."""

import argparse
import json
import os
import pathlib
import platform
import sys
from typing import Any

import numpy as np
import stable_baselines3
import torch as th

from sb3_eqr.benchmark.speed.model_sizes import model_sweeps
from sb3_eqr.benchmark.speed.play import measure_collection, measure_evaluation
from sb3_eqr.benchmark.speed.replay_sizes import STORED, n_envs_sweep, stored_sweep
from sb3_eqr.benchmark.speed.steps import measure_stages, measure_steps
from sb3_eqr.benchmark.speed.tables import Sweep, Table
from sb3_eqr.common.save_util import atomic_write

PROGRAM = "python -m sb3_eqr.benchmark.speed"
SIZES = "sizes"
PARTS = {
    "steps": measure_steps,
    "stages": measure_stages,
    "collection": measure_collection,
    "evaluation": measure_evaluation,
}


def make_parser() -> argparse.ArgumentParser:
    """The options."""
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description="What a gradient step, a step of the environment and a stored transition cost, in turns in one process.",
    )
    parser.add_argument("--threads", type=int, default=th.get_num_threads(), help="threads of PyTorch")
    parser.add_argument("--rounds", type=int, default=30, help="rounds in which what is compared takes turns")
    parser.add_argument("--device", default="cpu", help="of the agents, such as cuda")
    parser.add_argument(
        "--only",
        metavar="PARTS",
        type=lambda text: text.split(","),
        help=f"a part, or several with commas between them: {', '.join([*PARTS, SIZES])}",
    )
    parser.add_argument(
        "--sizes",
        action="store_true",
        help="cost against size, too: stored transitions, environments, depth, blocks, groups. 1,000,000 transitions take "
        "9 GB of memory, see --largest",
    )
    parser.add_argument(
        "--largest",
        type=int,
        default=STORED[-1],
        metavar="N",
        help="of the replay buffers of --sizes, in transitions of 7.2 kB; at least 10000",
    )
    parser.add_argument("--plot", metavar="FILE", help="a picture of --sizes (PNG)")
    parser.add_argument("--json", metavar="FILE", help="write everything there, too")
    return parser


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """
    :param arguments: those of the command line where not given
    :return: with the parts to measure as ``only``
    """
    parser = make_parser()
    args = parser.parse_args(arguments)
    for name in ("threads", "rounds"):
        if getattr(args, name) < 1:
            parser.error(f"--{name}: expected at least 1, found {getattr(args, name)}")
    if args.only is None:
        args.only = [*PARTS, SIZES] if args.sizes else list(PARTS)
    elif args.sizes:
        args.only.append(SIZES)
    for part in args.only:
        if part not in (*PARTS, SIZES):
            parser.error(f"--only: expected parts of {', '.join([*PARTS, SIZES])}, found {part!r}")
    if args.largest < STORED[0]:
        parser.error(f"--largest: expected at least {STORED[0]}, found {args.largest}")
    if args.plot and SIZES not in args.only:
        parser.error("--plot: there is nothing to draw without --sizes")
    if args.device != "cpu" and not th.cuda.is_available():
        parser.error(f"--device: expected cpu, found {args.device!r}: PyTorch sees no GPU here")
    return args


def cpu_model() -> str:
    """The processor's name as the system tells it."""
    info = pathlib.Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def surroundings(args: argparse.Namespace) -> dict[str, Any]:
    """What figures depend on, for JSON."""
    return {
        "command": " ".join([PROGRAM, *sys.argv[1:]]),
        "threads": args.threads,
        "rounds": args.rounds,
        "device": args.device if args.device == "cpu" else th.cuda.get_device_name(args.device),
        "cpu": cpu_model(),
        "cores": os.cpu_count(),
        "versions": {
            "python": platform.python_version(),
            "torch": th.__version__,
            "stable_baselines3": stable_baselines3.__version__,
            "numpy": np.__version__,
        },
    }


def sweeps(args: argparse.Namespace) -> list[Sweep]:
    """Cost against size."""
    on_device = (args.rounds, args.device)
    return [stored_sweep(args.rounds, args.largest), n_envs_sweep(*on_device), *model_sweeps(*on_device)]


def main() -> None:
    """Parse the command line, measure, print, write."""
    args = parse()
    th.set_num_threads(args.threads)
    about = surroundings(args)
    versions = about["versions"]
    print(
        f"{about['cpu']}, {args.threads} thread(s), {args.device}, {args.rounds} rounds, torch {versions['torch']}, ", end=""
    )
    print(f"SB3 {versions['stable_baselines3']}, numpy {versions['numpy']}")
    tables: list[Table] = []

    def show(table: Table) -> None:
        print(f"\n{table.text()}", flush=True)
        tables.append(table)

    for part in PARTS:
        if part in args.only:
            for table in PARTS[part](args.rounds, args.device):
                show(table)
    if SIZES in args.only:
        found = sweeps(args)
        for sweep in found:
            show(sweep.table())
        if args.plot:
            from sb3_eqr.benchmark.speed.plot import plot_sweeps

            plot_sweeps(found, args.plot)
    if args.json:
        with atomic_write(args.json, "json") as file:
            file.write(json.dumps({**about, "tables": {table.name: table.data() for table in tables}}, indent=2).encode())


if __name__ == "__main__":
    main()
