"""
The cost of an update and of an environment step: ``python -m experiments.speed`` (docs/results/speed.md).

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
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from itertools import cycle, product
from typing import Any
from unittest import mock

import numpy as np
import stable_baselines3
import torch as th
from torch.profiler import ProfilerActivity, profile, record_function
from torch.utils.benchmark import Timer, timer

from experiments import workload
from experiments.clock import Table, count_operations, median, take_turns
from experiments.sizes import STORED, measure_sizes
from experiments.workload import (
    AGENTS,
    BEFORE,
    EQR_AGENTS,
    N_STORED,
    NETWORKS,
    Floor,
    bytes_per_transition,
    fill,
    make_agent,
    make_trainable,
)
from sb3_eqr.common.saving.files import atomic_write

FLOOR, ONES = "floor", ", rounds of one"
TOLERANCE = 1e-5  # of parameters, if eager updates are deterministic
N_COUNTED, N_BEFORE = 10, 50  # counted updates, after others that warm up
N_ACTED, N_OPERATIONS = 100, 20  # steps in a round, rows of the profile
NEIGHBOUR_ROUNDS = 8  # maximum, as these rounds are slow
BUSY = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: pass"  # ends with this process at the latest


def in_rounds_of_one(model: Any, n_updates: int) -> None:
    """The same number of updates as ``model.train(n_updates)``, one per call."""
    for _ in range(n_updates):
        model.train(1, model.batch_size)


def measure_updates(args: argparse.Namespace) -> Iterator[Table]:
    """An update of each agent on each network, compared with QRDQN's and the floor, in long rounds and in rounds of one."""
    for key in args.network or NETWORKS:
        n_updates, models = NETWORKS[key].n_updates, {name: make_trainable(name, key, N_BEFORE) for name in AGENTS}
        counted = {name: count_operations(partial(one.train, N_COUNTED, one.batch_size)) for name, one in models.items()}
        floor = Floor(models["EqRQRDQN"]) if key == "atari" else None
        calls: dict[str, Callable[[], object]] = {FLOOR: partial(floor.steps, n_updates)} if floor else {}
        for name, model in models.items():
            calls[name] = partial(model.train, n_updates, model.batch_size)
            calls[name + ONES] = partial(in_rounds_of_one, model, n_updates)
        found = take_turns(calls, args.rounds, n_updates)

        def ratio(name: str, other: str, found: dict[str, Any] = found) -> float | None:
            return found[name].ratio(found[other]) if name in found and other in found else None

        rows: list[dict[str, Any]] = []
        for name in [FLOOR, *models] if floor else models:
            row = {"name": name, "ms": median(found[name].ms), "cpu_ms": median(found[name].cpu_ms)}
            row |= {"times_QRDQN": ratio(name, "QRDQN"), "times_floor": ratio(name, FLOOR)}
            row |= {"times_before": ratio(name, name + BEFORE), "round_of_one": ratio(name + ONES, name)}
            row |= {"operations": counted[name] / N_COUNTED if name in models else None}
            row |= {"page_faults": median(found[name].faults)}
            row |= {"bytes_per_transition": bytes_per_transition(models[name]) if floor and name in models else None}
            rows.append(row)
        notes = [floor.description()] if floor else []
        yield Table(f"updates_{key}", f"Update, {key}, batch {NETWORKS[key].batch_size}", rows, notes)


def measure_neighbour(args: argparse.Namespace) -> Iterator[Table]:
    """Updates on Atari frames with one and with two threads, while another process is busy."""
    models = {name: make_trainable(name) for name in ("DQN", "QRDQN", *EQR_AGENTS)}

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


def acting_and_storing(name: str, network: str) -> tuple[Callable[[], object], Callable[[], object]]:
    """The two calls of an agent per environment step: choose an action with its network, and store a transition."""
    model = make_trainable(name, network)
    env, transitions = model.env, []
    obs = env.reset()
    for _ in range(N_ACTED):
        actions = np.array([env.action_space.sample()])
        before, (obs, *rest) = obs, env.step(actions)
        transitions.append((before, (actions, obs, *rest)))
    stream = cycle(transitions)

    def store() -> None:
        model._last_obs, transition = next(stream)
        model._store_transition(model.replay_buffer, *transition)

    return partial(model._sample_action, 0), store


def measure_steps(args: argparse.Namespace) -> Iterator[Table]:
    """Acting and storing: an environment step without the environment itself and without updates."""
    clock = time.process_time if args.threads == 1 else timer
    for key in args.network or NETWORKS:
        calls = {name: acting_and_storing(name, key) for name in AGENTS}
        options: dict[str, Any] = {"timer": clock, "num_threads": args.threads}
        timers = [Timer("call()", globals={"call": call}, **options) for both in calls.values() for call in both]
        rounds = [[one.timeit(N_ACTED).median * 1e3 for one in timers] for _ in range(args.rounds)]
        acting, storing = np.array(rounds).reshape(args.rounds, -1, 2).T  # (agents, rounds) each
        whole = acting + storing
        columns = {"ms_acting": acting, "ms_storing": storing, "ms": whole}
        columns["times_QRDQN"] = whole / whole[list(calls).index("QRDQN")]
        rows = [{"name": name} | {key: median(ms[i]) for key, ms in columns.items()} for i, name in enumerate(calls)]
        yield Table(f"steps_{key}", f"Step of the environment without the environment, {key}", rows)


def measure_profile(args: argparse.Namespace) -> Iterator[Table]:
    """The time of an update by stage and operation, from PyTorch's profiler, whose overhead is included."""
    for key, name in product(args.network or ["minatar"], EQR_AGENTS):
        model = make_trainable(name, key, N_BEFORE)
        policy, buffer = model.policy, model.replay_buffer
        stages = {"sample": buffer, "objective": model, "backward": th.Tensor}
        stages |= {"step": policy.optimizer, "update_target": policy, "update_priorities": buffer}
        with ExitStack() as stack:
            for stage, owner in stages.items():
                ranged = record_function(f"stage {stage}")(getattr(owner, stage))
                stack.enter_context(mock.patch.object(owner, stage, ranged))
            profiled = stack.enter_context(profile(activities=[ProfilerActivity.CPU]))
            model.train(N_COUNTED, model.batch_size)
        rows: list[dict[str, Any]] = []
        for event in sorted(profiled.key_averages(), key=lambda event: -event.self_cpu_time_total):
            times = {"ms": event.cpu_time_total / N_COUNTED / 1e3, "self_ms": event.self_cpu_time_total / N_COUNTED / 1e3}
            rows.append({"name": event.key, "calls": event.count / N_COUNTED, **times})
        shown = [row for row in rows if row["name"].startswith("stage")]
        shown += [row for row in rows if row not in shown][:N_OPERATIONS]
        notes = [f"all: {sum(row['self_ms'] for row in rows):.2f} ms; self: excluding nested calls"]
        yield Table(f"profile_{name}_{key}", f"Update of {name} by stage and operation, {key}", shown, notes)


def measure_graph(args: argparse.Namespace) -> Iterator[Table]:
    """Updates captured as a CUDA graph: they must differ from eager ones no more than these from their own repetition."""
    rows: list[dict[str, Any]] = []
    for name in EQR_AGENTS:
        agents = []
        for graph in (False, False, True):
            agents.append(make_agent(name, device=args.device, cuda_graph=graph))  # which seeds the generators
            fill(agents[-1].replay_buffer, N_STORED)
            agents[-1].train(N_BEFORE, agents[-1].batch_size)
        eager, again, captured = (th.cat([p.detach().flatten() for p in one.policy.parameters()]) for one in agents)
        apart_again, apart = (again - eager).abs().max().item(), (captured - eager).abs().max().item()
        failure = agents[2]._captured.failure
        is_right = apart <= max(TOLERANCE, 2 * apart_again) and (failure is None or args.device == "cpu")
        floor, n_updates = Floor(agents[0]), NETWORKS["atari"].n_updates
        calls: dict[str, Callable[[], object]] = {FLOOR: partial(floor.steps, n_updates)}
        calls |= {
            way: partial(one.train, n_updates, one.batch_size)
            for way, one in zip(("eager", "captured"), agents[1:], strict=True)
        }
        times = {f"{way}_ms": median(found.ms) for way, found in take_turns(calls, args.rounds, n_updates).items()}
        rows.append(
            {
                "name": name,
                **times,
                "eager_again": apart_again,
                "captured": apart,
                "capture": failure or "captured",
                "ok": is_right,
            }
        )
    notes = [
        f"eager_again, captured: largest difference of a parameter from an eager agent's, {N_BEFORE} updates from one seed"
    ]
    yield Table("graph", f"Update as a CUDA graph, atari, {args.device}", rows, notes)


MEASURES = (measure_updates, measure_neighbour, measure_steps, measure_profile, measure_graph, measure_sizes)
PARTS = {measure.__name__.removeprefix("measure_"): measure for measure in MEASURES}


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Parse the given arguments, or else the command line; argparse reports wrong ones."""
    parser = argparse.ArgumentParser(prog="python -m experiments.speed", description=__doc__.strip().split("\n")[0])
    several, usual = partial(str.split, sep=","), [part for part in PARTS if part not in ("sizes", "graph")]
    parser.add_argument("--only", metavar="PARTS", type=several, default=usual, help=f"some of {', '.join(PARTS)}")
    networks = f"some of {', '.join(NETWORKS)}; default: all, but minatar for profile"
    parser.add_argument("--network", metavar="NETWORKS", type=several, help=networks)
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
    cpu = names[0] if names else platform.processor() or platform.machine()
    versions = {"torch": th.__version__, "SB3": stable_baselines3.__version__, "numpy": np.__version__}
    about = {"command": f"python -m experiments.speed {' '.join(sys.argv[1:])}", "cpu": cpu, "cores": os.cpu_count()}
    about |= {"threads": args.threads, "rounds": args.rounds, "python": platform.python_version()}
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
