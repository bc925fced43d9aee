"""Cost against size: stored transitions, environments, depth M, blocks K, groups."""

import argparse
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import cycle
from math import log2
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from torch.utils.flop_counter import FlopCounterMode

from experiments.clock import Table, median, take_turns
from experiments.workload import BATCH_SIZE, N_ACTIONS, N_STACK, SIZE, Floor, fill, make_agent, make_env, make_trainable, play
from sb3_eqr import PrioritizedSequenceReplayBuffer, SequenceReplayBuffer

AGENT = "EqRQRDQN"
STORED, FILLED_BY = (10_000, 100_000, 1_000_000), 20  # transitions, and number of environments that add them
N_ENVS, N_PLAYED, N_UPDATES, N_DRAWS = (1, 8, 32), 256, 2, 30
VARIANTS: dict[str, dict[Any, dict[str, Any]]] = {
    "M": {m: {"prediction_depth": m} for m in (0, 1, 2, 3, 5, 7, 10)},
    "K": {k: {"policy_kwargs": {"n_blocks": k}} for k in (4, 8, 16, 32, 64)},
    "group": {group: {"policy_kwargs": {"group": group}} for group in ("SE(2)", "SE(3)", "SO(6)", "GL(4)")},
}


def growth(costs: Sequence[float], arithmetic: Sequence[float]) -> list[float]:
    """Growth of the costs since the first size, divided by that of the arithmetic, in any unit."""
    return [(cost / costs[0]) / (work / arithmetic[0]) for cost, work in zip(costs, arithmetic, strict=True)]


def repeat(call: Callable[[], object]) -> list[object]:
    """Call it ``N_DRAWS`` times, since one call is too short to time."""
    return [call() for _ in range(N_DRAWS)]


def drawing_and_updating(size: int) -> dict[str, Callable[[], object]]:
    """Calls on a full buffer of ``size`` transitions: prioritised and uniform batches, and new priorities."""
    space, actions = spaces.Box(0, 255, (N_STACK, SIZE, SIZE), np.uint8), spaces.Discrete(N_ACTIONS)
    windows: dict[str, Any] = {"n_steps": 10, "prediction_depth": 5, "frame_stack": N_STACK}  # Table 5
    buffer = PrioritizedSequenceReplayBuffer(size, space, actions, "cpu", FILLED_BY, **windows)
    fill(buffer, size // FILLED_BY)
    n_drawable = (buffer.buffer_size - buffer.window) * buffer.n_envs
    batches = cycle(np.random.default_rng(0).integers(0, n_drawable, (1_000, BATCH_SIZE)))
    priorities = th.rand(BATCH_SIZE)
    return {
        "sample": partial(buffer.sample, BATCH_SIZE),
        "update_priorities": lambda: buffer.update_priorities(next(batches), priorities),
        "uniform_sample": partial(SequenceReplayBuffer.sample, buffer, BATCH_SIZE),
    }


def measure_stored(rounds: int, largest: int) -> Table:
    """Time of a batch of windows by number of stored transitions, up to the largest."""
    sizes = [size for size in STORED if size <= largest]
    work = {size: drawing_and_updating(size) for size in sizes}
    calls = {f"{what} {size}": partial(repeat, call) for size in sizes for what, call in work[size].items()}
    found = take_turns(calls, rounds, N_DRAWS)
    rows: list[dict[str, Any]] = [{"transitions": size} for size in sizes]
    for what in work[sizes[0]]:
        costs = [median(found[f"{what} {size}"].ms) for size in sizes]
        grown = growth(costs, [1.0 if what == "uniform_sample" else log2(size) for size in sizes])
        for place, row in enumerate(rows):
            row |= {f"{what}_ms": costs[place], f"{what}_growth": grown[place]}
    notes = ["growth: of the time, over that of log2 of the transitions where priorities are used"]
    return Table("stored_transitions", f"Replay, a batch of {BATCH_SIZE} windows, n = 10, M = 5", rows, notes)


def measure_n_envs(rounds: int) -> Table:
    """Time of acting and storing by number of environments in one process."""
    models = {str(n): make_agent(AGENT, env=make_env("atari", n)) for n in N_ENVS}
    found = take_turns({n: partial(play, model, N_PLAYED) for n, model in models.items()}, rounds, N_PLAYED)
    rows = [{"n_envs": n, "ms": median(found[n].ms), "growth": median(found[n].ms) / median(found["1"].ms)} for n in models]
    return Table("n_envs", f"Environments of random frames, {AGENT}: step of one environment, without updates", rows)


def measure_variants(size: str, rounds: int) -> Table:
    """Time of an update by M, K or the group, compared with the floor."""
    models = {str(value): make_trainable(AGENT, **kwargs) for value, kwargs in VARIANTS[size].items()}
    floors = {name: Floor(model) for name, model in models.items()}
    calls: dict[str, Callable[[], object]] = {f"floor {name}": partial(floors[name].steps, N_UPDATES) for name in models}
    calls |= {name: partial(model.train, N_UPDATES, model.batch_size) for name, model in models.items()}
    found = take_turns(calls, rounds, N_UPDATES)
    rows: list[dict[str, Any]] = []
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
    """All of the above."""
    yield from (measure_stored(args.rounds, args.largest), measure_n_envs(args.rounds))
    yield from (measure_variants(size, args.rounds) for size in VARIANTS)
