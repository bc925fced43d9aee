"""
The cost of an update and of replay, also by size: ``python -m experiments.speed`` (docs/results/speed.md).

The agents compared run alternately in one process. Milliseconds are medians over the rounds; ratios are computed within each
round, and their median is shown.
"""

import argparse
import json
import os
import pathlib
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import cycle
from math import log2
from typing import Any

import numpy as np
import stable_baselines3
import torch as th
from gymnasium import spaces
from torch.utils.flop_counter import FlopCounterMode

from experiments import workload
from experiments.workload import AGENTS, BATCH_SIZE, BEFORE, EQR_AGENTS, N_STACK, NETWORKS, Floor, Table, median, take_turns
from sb3_eqr import PrioritizedSequenceReplayBuffer, SequenceReplayBuffer
from sb3_eqr.common.saving.files import atomic_write

FLOOR, ONES = "floor", ", rounds of one"
TOLERANCE = 1e-5  # of parameters, if eager updates are deterministic
N_COUNTED, N_BEFORE = 10, 50  # counted updates, after others that warm up
NEIGHBOUR_ROUNDS = 8  # maximum, as these rounds are slow
BUSY = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: pass"  # ends with this process at the latest
AGENT = "EqRQRDQN"  # of sizes
STORED, FILLED_BY = (10_000, 100_000, 1_000_000), 20  # transitions, and number of environments that add them
N_ENVS, N_PLAYED, N_UPDATES, N_DRAWS = (1, 8, 32), 256, 2, 30
VARIANTS: dict[str, dict[Any, dict[str, Any]]] = {
    "M": {m: {"prediction_depth": m} for m in (0, 1, 2, 3, 5, 7, 10)},
    "K": {k: {"policy_kwargs": {"n_blocks": k}} for k in (4, 8, 16, 32, 64)},
    "group": {group: {"policy_kwargs": {"group": group}} for group in ("SE(2)", "SE(3)", "SO(6)", "GL(4)")},
}
Call = Callable[[], object]
Row = dict[str, Any]


def in_rounds_of_one(model: Any, n_updates: int) -> None:
    """The same number of updates as ``model.train(n_updates)``, one per call."""
    for _ in range(n_updates):
        model.train(1, model.batch_size)


def measure_updates(args: argparse.Namespace) -> Iterator[Table]:
    """An update of each agent on each network, compared with QRDQN's and the floor, in long rounds and in rounds of one."""
    for key in args.network or NETWORKS:
        n_updates, models = NETWORKS[key].n_updates, {name: workload.make_trainable(name, key, N_BEFORE) for name in AGENTS}
        updates = {name: partial(model.train, N_COUNTED, model.batch_size) for name, model in models.items()}
        counted = {name: workload.count_operations(call) / N_COUNTED for name, call in updates.items()}
        floor = Floor(models[AGENT]) if key == "atari" else None
        stored = {name: workload.bytes_per_transition(model) for name, model in models.items() if floor}
        calls: dict[str, Call] = {FLOOR: partial(floor.steps, n_updates)} if floor else {}
        for name, model in models.items():
            calls[name] = partial(model.train, n_updates, model.batch_size)
            calls[name + ONES] = partial(in_rounds_of_one, model, n_updates)
        found = take_turns(calls, args.rounds, n_updates)

        def ratio(name: str, other: str, found: dict[str, Any] = found) -> float | None:
            return found[name].ratio(found[other]) if name in found and other in found else None

        rows: list[Row] = []
        for name in [FLOOR, *models] if floor else models:
            row = {"name": name, "ms": median(found[name].ms), "cpu_ms": median(found[name].cpu_ms)}
            row |= {"times_QRDQN": ratio(name, "QRDQN"), "times_floor": ratio(name, FLOOR)}
            row |= {"times_before": ratio(name, name + BEFORE), "round_of_one": ratio(name + ONES, name)}
            row |= {"operations": counted.get(name), "page_faults": median(found[name].faults)}
            rows.append(row | {"bytes_per_transition": stored.get(name)})
        notes = [floor.description()] if floor else []
        yield Table(f"updates_{key}", f"Update, {key}, batch {NETWORKS[key].batch_size}", rows, notes)


def measure_neighbour(args: argparse.Namespace) -> Iterator[Table]:
    """Updates on Atari frames with one and with two threads, while another process is busy."""
    models = {name: workload.make_trainable(name) for name in ("DQN", "QRDQN", *EQR_AGENTS)}

    def update(model: Any, n_threads: int) -> None:
        th.set_num_threads(n_threads)
        model.train(1, model.batch_size)

    calls = {f"{name} {n}": partial(update, model, n) for name, model in models.items() for n in (1, 2)}
    process = subprocess.Popen([sys.executable, "-c", BUSY])
    try:
        found = take_turns(calls, min(args.rounds, NEIGHBOUR_ROUNDS))
    finally:
        process.kill()
        process.wait()
        th.set_num_threads(args.threads)
    rows = []
    for name in models:
        one, two = found[f"{name} 1"].ms, found[f"{name} 2"].ms
        rows.append({"name": name, "ms_1_thread": median(one), "ms_2_threads": median(two), "slowdown": median(two / one)})
    yield Table("neighbour", "Update, atari, beside a busy process", rows)


def measure_graph(args: argparse.Namespace) -> Iterator[Table]:
    """Updates captured as a CUDA graph: they must differ from eager ones no more than these from their own repetition."""
    rows: list[Row] = []
    for name in EQR_AGENTS:
        agents = []
        for graph in (False, False, True):
            agents.append(workload.make_agent(name, device=args.device, cuda_graph=graph))  # which seeds the generators
            workload.fill(agents[-1].replay_buffer, workload.N_STORED)
            agents[-1].train(N_BEFORE, agents[-1].batch_size)
        eager, again, captured = (th.cat([p.detach().flatten() for p in one.policy.parameters()]) for one in agents)
        apart_again, apart = (again - eager).abs().max().item(), (captured - eager).abs().max().item()
        failure = agents[2]._captured.failure
        is_right = apart <= max(TOLERANCE, 2 * apart_again) and (failure is None or args.device == "cpu")
        n_updates, models = NETWORKS["atari"].n_updates, {"eager": agents[1], "captured": agents[2]}
        calls: dict[str, Call] = {FLOOR: partial(Floor(agents[0]).steps, n_updates)}
        calls |= {way: partial(one.train, n_updates, one.batch_size) for way, one in models.items()}
        times = {f"{way}_ms": median(found.ms) for way, found in take_turns(calls, args.rounds, n_updates).items()}
        apart_by = {"eager_again": apart_again, "captured": apart}
        rows.append({"name": name, **times, **apart_by, "capture": failure or "captured", "ok": is_right})
    what = "largest difference of a parameter from an eager agent's"
    notes = [f"eager_again, captured: {what}, {N_BEFORE} updates from one seed"]
    yield Table("graph", f"Update as a CUDA graph, atari, {args.device}", rows, notes)


def growth(costs: Sequence[float], arithmetic: Sequence[float]) -> list[float]:
    """Growth of the costs since the first size, divided by that of the arithmetic, in any unit."""
    return [(cost / costs[0]) / (work / arithmetic[0]) for cost, work in zip(costs, arithmetic, strict=True)]


def repeat(call: Call) -> list[object]:
    """Call it ``N_DRAWS`` times, since one call is too short to time."""
    return [call() for _ in range(N_DRAWS)]


def drawing_and_updating(size: int) -> dict[str, Call]:
    """Calls on a full buffer of ``size`` transitions: prioritised and uniform batches, and new priorities."""
    space, actions = spaces.Box(0, 255, (N_STACK, workload.SIZE, workload.SIZE), np.uint8), spaces.Discrete(workload.N_ACTIONS)
    windows: dict[str, Any] = {"n_steps": 10, "prediction_depth": 5, "frame_stack": N_STACK}  # Table 5
    buffer = PrioritizedSequenceReplayBuffer(size, space, actions, "cpu", FILLED_BY, **windows)
    workload.fill(buffer, size // FILLED_BY)
    n_drawable = (buffer.buffer_size - buffer.window) * buffer.n_envs
    batches = cycle(np.random.default_rng(0).integers(0, n_drawable, (1_000, BATCH_SIZE)))
    priorities = th.rand(BATCH_SIZE)
    return {
        "sample": partial(buffer.sample, BATCH_SIZE),
        "update_priorities": lambda: buffer.update_priorities(next(batches), priorities),
        "uniform_sample": partial(SequenceReplayBuffer.sample, buffer, BATCH_SIZE),
    }


def measure_stored(args: argparse.Namespace) -> Table:
    """Time of a batch of windows by number of stored transitions, up to the largest."""
    sizes = [size for size in STORED if size <= args.largest]
    work = {size: drawing_and_updating(size) for size in sizes}
    calls = {f"{what} {size}": partial(repeat, call) for size in sizes for what, call in work[size].items()}
    found = take_turns(calls, args.rounds, N_DRAWS)
    rows: list[Row] = [{"transitions": size} for size in sizes]
    for what in work[sizes[0]]:
        costs = [median(found[f"{what} {size}"].ms) for size in sizes]
        grown = growth(costs, [1.0 if what == "uniform_sample" else log2(size) for size in sizes])
        for place, row in enumerate(rows):
            row |= {f"{what}_ms": costs[place], f"{what}_growth": grown[place]}
    notes = ["growth: of the time, over that of log2 of the transitions where priorities are used"]
    return Table("stored_transitions", f"Replay, a batch of {BATCH_SIZE} windows, n = 10, M = 5", rows, notes)


def measure_n_envs(args: argparse.Namespace) -> Table:
    """Time of acting and storing by number of environments in one process."""
    models = {str(n): workload.make_agent(AGENT, env=workload.make_env("atari", n)) for n in N_ENVS}
    found = take_turns({n: partial(workload.play, one, N_PLAYED) for n, one in models.items()}, args.rounds, N_PLAYED)
    rows = [{"n_envs": n, "ms": median(found[n].ms), "growth": median(found[n].ms) / median(found["1"].ms)} for n in models]
    return Table("n_envs", f"Environments of random frames, {AGENT}: step of one environment, without updates", rows)


def measure_variants(size: str, rounds: int) -> Table:
    """Time of an update by M, K or the group, compared with the floor."""
    models = {str(value): workload.make_trainable(AGENT, **kwargs) for value, kwargs in VARIANTS[size].items()}
    floors = {name: Floor(model) for name, model in models.items()}
    calls: dict[str, Call] = {f"floor {name}": partial(floors[name].steps, N_UPDATES) for name in models}
    calls |= {name: partial(model.train, N_UPDATES, model.batch_size) for name, model in models.items()}
    found = take_turns(calls, rounds, N_UPDATES)
    rows: list[Row] = []
    for name, model in models.items():
        with FlopCounterMode(display=False) as counter:
            model.train(1, model.batch_size)
        step, floor, gflop = found[name], found[f"floor {name}"], counter.get_total_flops() / 1e9
        row = {size: name, "GFLOP": gflop, "GFLOP_beyond_floor": gflop - floors[name].flop / 1e9, "ms": median(step.ms)}
        row |= {"times_floor": step.ratio(floor), "ms_beyond_floor": median(step.ms - floor.ms)}
        rows.append({**row, "page_faults": median(step.faults)})
    grown = growth([row["ms_beyond_floor"] for row in rows], [row["GFLOP_beyond_floor"] for row in rows])
    rows = [{**row, "growth": value} for row, value in zip(rows, grown, strict=True)]
    return Table(size, f"Update of {AGENT} by {size}", rows, ["growth: of ms over that of GFLOP, both beyond the floor"])


def measure_sizes(args: argparse.Namespace) -> Iterator[Table]:
    """Cost against size: stored transitions, environments, depth M, blocks K, groups."""
    yield from (measure_stored(args), measure_n_envs(args))
    yield from (measure_variants(size, args.rounds) for size in VARIANTS)


PARTS = {"updates": measure_updates, "neighbour": measure_neighbour, "graph": measure_graph, "sizes": measure_sizes}


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Parse the given arguments, or else the command line; argparse reports wrong ones."""
    parser = argparse.ArgumentParser(prog="python -m experiments.speed", description=__doc__.strip().split("\n")[0])
    several = partial(str.split, sep=",")
    parser.add_argument("--only", type=several, default=["updates", "neighbour"], help=f"some of {', '.join(PARTS)}")
    parser.add_argument("--network", type=several, help=f"of updates: some of {', '.join(NETWORKS)}; default: all")
    parser.add_argument("--threads", type=int, default=th.get_num_threads(), help="PyTorch threads")
    parser.add_argument("--rounds", type=int, default=20, help="number of rounds")
    parser.add_argument("--device", default="cpu", help="of graph: cuda, or cpu to test the script")
    parser.add_argument("--before", metavar="DIR", help="a checkout of another version, measured alternately with this one")
    parser.add_argument("--largest", type=int, default=STORED[-1], metavar="N", help="largest buffer of sizes; 7.2 kB each")
    parser.add_argument("--json", metavar="FILE", help="also write all tables to this file")
    args = parser.parse_args(arguments)
    for option, known in (("only", PARTS), ("network", NETWORKS)):
        for name in getattr(args, option) or []:
            if name not in known:
                parser.error(f"--{option} must be some of {', '.join(known)}, got {name!r}")
    for option, least in (("threads", 1), ("rounds", 1), ("largest", STORED[0])):
        if getattr(args, option) < least:
            parser.error(f"--{option} must be an integer >= {least}, got {getattr(args, option)}")
    if args.before and not (pathlib.Path(args.before) / "sb3_eqr" / "__init__.py").is_file():
        parser.error(f"--before must be a folder with sb3_eqr in it, got {args.before!r}")
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
    if args.before:
        workload.add_before(args.before)
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
