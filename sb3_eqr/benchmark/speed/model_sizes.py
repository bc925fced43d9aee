"""Cost against size, of a gradient step: depth M, number of blocks K, group."""

from functools import partial
from typing import Any

from torch.utils.flop_counter import FlopCounterMode

from sb3_eqr.benchmark.speed.clock import take_turns
from sb3_eqr.benchmark.speed.floor import Floor
from sb3_eqr.benchmark.speed.tables import Sweep
from sb3_eqr.benchmark.speed.workload import EQR_AGENTS, STEPS_PER_CALL, close, make_trainable, state_entries, train
from sb3_eqr.common.eqr_algorithm import EqRAlgorithm

DEPTHS = (0, 1, 2, 3, 5, 7, 10)
BLOCKS = (4, 8, 16, 32, 64)
GROUPS = ("SE(2)", "SE(3)", "SO(6)", "GL(4)")
AGENT = EQR_AGENTS[0]


def model_sweeps(rounds: int, device: str) -> list[Sweep]:
    """
    :param rounds: in which the sizes of a sweep, and their floors, take turns
    :param device: of the agents
    """
    return [
        _sweep("M", f"{AGENT}: depth of the rollout", {m: {"prediction_depth": m} for m in DEPTHS}, rounds, device),
        _sweep("K", f"{AGENT}: blocks of SE(2)", {k: {"policy_kwargs": {"n_blocks": k}} for k in BLOCKS}, rounds, device),
        _sweep("group", f"{AGENT}: groups, 12 blocks", {g: {"policy_kwargs": {"group": g}} for g in GROUPS}, rounds, device),
    ]


def counted_flop(model: EqRAlgorithm) -> int:
    """
    :return: of one gradient step, in convolutions and products of matrices, as PyTorch counts them
    """
    with FlopCounterMode(display=False) as counter:
        model.train(gradient_steps=1, batch_size=model.batch_size)
    return counter.get_total_flops()


def _sweep(size: str, title: str, variants: dict[Any, dict[str, Any]], rounds: int, device: str) -> Sweep:
    models = {name: make_trainable(AGENT, device, **kwargs) for name, kwargs in variants.items()}
    floors = {name: Floor(model) for name, model in models.items()}
    calls = {}
    for name, model in models.items():
        calls[f"floor {name}"] = partial(floors[name].steps, STEPS_PER_CALL)
        calls[f"step {name}"] = partial(train, model)
    timings = take_turns(calls, rounds, STEPS_PER_CALL, device)
    pairs = [(timings[f"step {name}"], timings[f"floor {name}"]) for name in models]
    flop = [counted_flop(model) / 1e9 for model in models.values()]
    flop_beyond = [whole - floor.flop / 1e9 for whole, floor in zip(flop, floors.values(), strict=True)]
    entries = [state_entries(model) for model in models.values()]
    for model in models.values():
        close(model)
    steps = [step.median for step, _ in pairs]
    details: dict[str, tuple[list[Any], str]] = {
        "state_entries": (entries, "d"),
        "GFLOP": (flop, ".2f"),
        "floor_ms": ([floor.median for _, floor in pairs], ".1f"),
        "times_floor": ([step.ratio(floor) for step, floor in pairs], ".2f"),
        "page_faults": ([step.median_faults for step, _ in pairs], ",.0f"),
    }
    if size == "M":  # the floor grows, too
        costs, arithmetic, unit = {"ms_per_step": steps}, {"ms_per_step": flop}, "GFLOP"
    else:  # the floor stays: what grows is the rest
        beyond = [step.beyond(floor) for step, floor in pairs]
        details |= {"GFLOP_beyond_floor": (flop_beyond, ".2f"), "ms_per_step": (steps, ".1f")}
        costs, arithmetic = {"ms_beyond_floor": beyond}, {"ms_beyond_floor": flop_beyond}
        unit = "GFLOP beyond the floor"
    return Sweep(size, f"Gradient step of {title}", size, list(models), costs, arithmetic, unit, details)
