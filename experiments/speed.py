"""
The cost of an update, and of its parts: ``python -m experiments.speed`` (docs/results/speed.md).

The agents compared run alternately in one process. Milliseconds are medians over the rounds; ratios are computed within each
round, and their median is shown.
"""

import argparse
import json
import os
import pathlib
import platform
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from typing import Any
from unittest import mock

import numpy as np
import stable_baselines3
import torch as th
from torch.utils.benchmark import Timer
from torch.utils.flop_counter import FlopCounterMode

from experiments import workload
from experiments.workload import AGENTS, BATCH_SIZE, EQR_AGENTS, NETWORKS, OFF, Table, median, take_turns
from sb3_eqr.common.saving.files import atomic_write

TOLERANCE = 1e-5  # of parameters, if eager updates are deterministic
N_COUNTED, N_BEFORE = 10, 50  # counted updates, after others that warm up
AGENT = "EqRRainbow"  # of parts
Call = Callable[..., object]
Row = dict[str, Any]


def measure_updates(args: argparse.Namespace) -> Iterator[Table]:
    """An update of each agent on each network, compared with QRDQN's."""
    for key in args.network:
        n_updates, models = NETWORKS[key].n_updates, {name: workload.make_trainable(name, key, N_BEFORE) for name in AGENTS}
        updates = {name: partial(model.train, N_COUNTED, model.batch_size) for name, model in models.items()}
        counted = {name: workload.count_operations(call) / N_COUNTED for name, call in updates.items()}
        calls = {name: partial(model.train, n_updates, model.batch_size) for name, model in models.items()}
        found, rows = take_turns(calls, args.rounds, n_updates), []
        for name, model in models.items():
            row = {"name": name, "ms": median(found[name].ms), "cpu_ms": median(found[name].cpu_ms)}
            row |= {"times_QRDQN": found[name].ratio(found["QRDQN"]), "operations": counted[name]}
            rows.append(row | {"bytes_per_transition": workload.bytes_per_transition(model) if key == "atari" else None})
        yield Table(f"updates_{key}", f"Update, {key}, batch {NETWORKS[key].batch_size}", rows)


def measure_graph(args: argparse.Namespace) -> Iterator[Table]:
    """Updates captured as a CUDA graph: they must differ from eager ones no more than these from their own repetition."""
    rows: list[Row] = []
    for name in EQR_AGENTS:
        agents = []
        for graph in (False, False, True):
            agents.append(workload.make_trainable(name, n_updates=N_BEFORE, device=args.device, cuda_graph=graph))
        eager, again, captured = (th.cat([p.detach().flatten() for p in one.policy.parameters()]) for one in agents)
        apart_again, apart = (again - eager).abs().max().item(), (captured - eager).abs().max().item()
        failure = agents[2]._captured.failure
        is_right = apart <= max(TOLERANCE, 2 * apart_again) and (failure is None or args.device == "cpu")
        n_updates, models = NETWORKS["atari"].n_updates, {"eager": agents[1], "captured": agents[2]}
        calls = {way: partial(one.train, n_updates, one.batch_size) for way, one in models.items()}
        times = {f"{way}_ms": median(found.ms) for way, found in take_turns(calls, args.rounds, n_updates).items()}
        apart_by = {"eager_again": apart_again, "captured": apart}
        rows.append({"name": name, **times, **apart_by, "capture": failure or "captured", "ok": is_right})
    what = "largest difference of a parameter from an eager agent's"
    notes = [f"eager_again, captured: {what}, {N_BEFORE} updates from one seed"]
    yield Table("graph", f"Update as a CUDA graph, atari, {args.device}", rows, notes)


class Timed:
    """A function, and the CPU time of its calls in milliseconds."""

    def __init__(self, call: Call):
        self.call, self.ms = call, 0.0

    def __call__(self, *args: Any, **kwargs: Any) -> object:
        start = time.process_time()
        result = self.call(*args, **kwargs)
        self.ms += (time.process_time() - start) * 1e3
        return result


def measure_parts(args: argparse.Namespace) -> Iterator[Table]:
    """Where the CPU time of an update goes: by part, and what its arithmetic would take as plain products of matrices."""
    rows_by_width, square = th.rand(5 * BATCH_SIZE, 256), th.rand(256, 256)  # M rows of each sample, hidden units
    product = Timer("a @ b", globals={"a": rows_by_width, "b": square}, num_threads=args.threads)
    rate = 2e-9 * 256 * rows_by_width.numel() / product.blocked_autorange().median
    for key in args.network:
        rows: list[Row] = []
        for name in ("QRDQN", AGENT + OFF, AGENT):
            model = workload.make_trainable(name, key, N_BEFORE)
            with FlopCounterMode(display=False) as counter:
                model.train(1, model.batch_size)
            flop, n_updates = counter.get_total_flops(), args.rounds * NETWORKS[key].n_updates
            parts = {
                "update": (model, "train"),
                "sample": (model.replay_buffer, "sample"),
                "Adam": (model.policy.optimizer, "step"),
            }
            if name != "QRDQN":
                parts |= {"losses": (model, "objective"), "backward": (th.autograd, "backward")}
                parts |= {"clip": (model, "_clip_gradients"), "target": (model.policy, "update_target")}
            with ExitStack() as patches:
                timed = {part: Timed(getattr(*place)) for part, place in parts.items()}
                for part, (owner, attribute) in parts.items():
                    patches.enter_context(mock.patch.object(owner, attribute, timed[part]))
                model.train(n_updates, model.batch_size)
            ms = {f"{part}_ms": one.ms / n_updates for part, one in timed.items()}
            rows.append({"name": name, "MFLOP": flop / 1e6, "products_ms": flop / rate / 1e6, **ms})
        notes = [
            f"products: the same arithmetic at {rate:.0f} GFLOP/s, as a product of {5 * BATCH_SIZE}x256 and 256x256 takes"
        ]
        yield Table(f"parts_{key}", f"Parts of an update, {key}, batch {NETWORKS[key].batch_size}", rows, notes)


PARTS = {"updates": measure_updates, "graph": measure_graph, "parts": measure_parts}


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Parse the given arguments, or else the command line; argparse reports wrong ones."""
    parser = argparse.ArgumentParser(prog="python -m experiments.speed", description=__doc__.strip().split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=PARTS, default=["updates"])
    parser.add_argument("--network", nargs="+", choices=NETWORKS, default=list(NETWORKS), help="of updates and parts")
    parser.add_argument("--threads", type=int, default=th.get_num_threads(), help="PyTorch threads")
    parser.add_argument("--rounds", type=int, default=20, help="number of rounds")
    parser.add_argument("--device", default="cpu", help="of graph: cuda, or cpu to test the script")
    parser.add_argument("--json", metavar="FILE", help="also write all tables to this file")
    args = parser.parse_args(arguments)
    for option in ("threads", "rounds"):
        if getattr(args, option) < 1:
            parser.error(f"--{option} must be an integer >= 1, got {getattr(args, option)}")
    return args


def surroundings(args: argparse.Namespace) -> dict[str, Any]:
    """Machine, versions and settings, which the measurements depend on, for JSON."""
    info = pathlib.Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    versions = {"torch": th.__version__, "SB3": stable_baselines3.__version__, "numpy": np.__version__}
    about: dict[str, Any] = {
        "command": f"python -m experiments.speed {' '.join(sys.argv[1:])}",
        "cpu": [*names, platform.machine()][0],
    }
    about |= {"cores": os.cpu_count(), "threads": args.threads, "rounds": args.rounds, "python": platform.python_version()}
    return {**about, "versions": versions, "tables": {}}


def main() -> None:
    """Parse the command line, measure, print, write."""
    args = parse()
    th.set_num_threads(args.threads)
    about = surroundings(args)
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    print(f"{about['cpu']}, {args.threads} thread(s), {args.rounds} rounds, {versions}")
    failed = False
    for part in args.only:
        for table in PARTS[part](args):
            print(f"\n{table.text()}", flush=True)
            failed |= not all(row.get("ok", True) for row in table.rows)
            about["tables"][table.name] = table._asdict()
    if args.json:
        with atomic_write(args.json, "json") as file:
            file.write(json.dumps(about, indent=2).encode())
    sys.exit(failed)


if __name__ == "__main__":
    main()
