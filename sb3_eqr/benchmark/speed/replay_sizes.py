"""Cost against size, without a gradient step: stored transitions, and environments."""

import math
from collections.abc import Callable
from functools import partial
from itertools import cycle
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_eqr import PrioritizedSequenceReplayBuffer, SequenceReplayBuffer
from sb3_eqr.benchmark.speed.clock import take_turns
from sb3_eqr.benchmark.speed.tables import Sweep
from sb3_eqr.benchmark.speed.workload import (
    BATCH_SIZE,
    EQR_AGENTS,
    N_ACTIONS,
    N_STACK,
    N_STORED,
    SIZE,
    close,
    fill,
    make_agent,
    make_env,
    play,
)

STORED = (10_000, 100_000, 1_000_000)
FILLED_BY = 20  # environments: fewer, larger calls of add
N_STEPS, DEPTH = 10, 5  # Table 5
DRAWS = 30  # per round
N_ENVS = (1, 8, 32)
PLAYED = 256  # steps per round, of the environments together
PLAY_ROUNDS = 10  # at most


def stored_sweep(rounds: int, largest: int) -> Sweep:
    """
    Drawing 32 windows, and writing their priorities back, on the CPU.

    :param rounds: in which the sizes take turns
    :param largest: number of stored transitions up to which to go
    """
    sizes = [size for size in STORED if size <= largest]
    buffers = {size: _full_buffer(size) for size in sizes}
    ways: dict[str, Callable[[PrioritizedSequenceReplayBuffer], Callable[[], object]]] = {
        "sample_ms": lambda buffer: partial(buffer.sample, BATCH_SIZE),
        "update_priorities_ms": _updating,
        "uniform_sample_ms": lambda buffer: partial(SequenceReplayBuffer.sample, buffer, BATCH_SIZE),
    }
    calls = {(way, size): _repeated(make(buffers[size]), DRAWS) for way, make in ways.items() for size in sizes}
    names = {f"{way} {size}": call for (way, size), call in calls.items()}
    timings = take_turns(names, rounds, DRAWS)
    tree = [math.log2(size) for size in sizes]
    return Sweep(
        "stored_transitions",
        f"Replay: a batch of {BATCH_SIZE} windows, {SIZE}x{SIZE}x{N_STACK}, n = {N_STEPS}, M = {DEPTH}",
        "transitions",
        sizes,
        {way: [timings[f"{way} {size}"].median for size in sizes] for way in ways},
        {"sample_ms": tree, "update_priorities_ms": tree, "uniform_sample_ms": [1.0] * len(sizes)},
        "log2 of the transitions where priorities are used, else constant",
    )


def _full_buffer(size: int) -> PrioritizedSequenceReplayBuffer:
    buffer = PrioritizedSequenceReplayBuffer(
        size,
        spaces.Box(0, 255, (N_STACK, SIZE, SIZE), np.uint8),
        spaces.Discrete(N_ACTIONS),
        "cpu",
        FILLED_BY,
        n_steps=N_STEPS,
        prediction_depth=DEPTH,
        frame_stack=N_STACK,
    )
    fill(buffer, size // FILLED_BY)
    return buffer


def _updating(buffer: PrioritizedSequenceReplayBuffer) -> Callable[[], object]:
    """New priorities for other transitions at each call, of those that may be drawn."""
    n_drawable = (buffer.buffer_size - buffer.window) * buffer.n_envs
    batches = cycle(np.random.default_rng(0).integers(0, n_drawable, (1_000, BATCH_SIZE)))
    priorities = th.rand(BATCH_SIZE)
    return lambda: buffer.update_priorities(next(batches), priorities)


def _repeated(call: Callable[[], object], times: int) -> Callable[[], None]:
    def repeat() -> None:
        for _ in range(times):
            call()

    return repeat


def n_envs_sweep(rounds: int, device: str) -> Sweep:
    """
    Collection and drawing with several environments of random frames in one process.

    :param rounds: in which the sizes take turns
    :param device: of the agents
    """
    models: dict[int, Any] = {n: make_agent(EQR_AGENTS[0], make_env(n), device) for n in N_ENVS}
    for n, model in models.items():
        fill(model.replay_buffer, N_STORED // n)
    playing = {str(n): partial(play, model, PLAYED) for n, model in models.items()}
    collection = take_turns(playing, min(rounds, PLAY_ROUNDS), PLAYED, device)
    drawing = {str(n): _repeated(partial(model.replay_buffer.sample, BATCH_SIZE), DRAWS) for n, model in models.items()}
    samples = take_turns(drawing, rounds, DRAWS, device)
    for model in models.values():
        close(model)
    constant = [1.0] * len(models)
    return Sweep(
        "n_envs",
        f"Environments side by side, {EQR_AGENTS[0]}: collection per environment step, and a batch of {BATCH_SIZE}",
        "n_envs",
        list(models),
        {
            "collection_ms_per_step": [collection[str(n)].median for n in models],
            "sample_ms": [samples[str(n)].median for n in models],
        },
        {"collection_ms_per_step": constant, "sample_ms": constant},
        "constant",
    )
