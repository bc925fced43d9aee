"""A gradient step: beside its floor and stock agents, and by stage."""

from functools import partial
from typing import Any

import torch as th

from sb3_eqr.benchmark.speed.clock import Series, now, page_faults, take_turns
from sb3_eqr.benchmark.speed.floor import Floor
from sb3_eqr.benchmark.speed.stopwatch import REST, Stage, break_down
from sb3_eqr.benchmark.speed.tables import Table
from sb3_eqr.benchmark.speed.workload import (
    AGENTS,
    BATCH_SIZE,
    EQR_AGENTS,
    SIZE,
    STEPS_PER_CALL,
    STOCK_QRDQN,
    bytes_per_transition,
    close,
    make_trainable,
    train,
)
from sb3_eqr.common.eqr_algorithm import EqRAlgorithm

FLOOR, WHOLE = "floor", "whole"


def measure_steps(rounds: int, device: str) -> list[Table]:
    """
    :param rounds: in which the floor and the agents take turns
    :param device: of the agents
    :return: one table
    """
    models = {name: make_trainable(name, device) for name in AGENTS}
    floor = Floor(models[EQR_AGENTS[0]])
    calls = {FLOOR: partial(floor.steps, STEPS_PER_CALL), **{name: partial(train, model) for name, model in models.items()}}
    timings = take_turns(calls, rounds, STEPS_PER_CALL, device)
    rows = []
    for name, series in timings.items():
        row = _step_row(name, series, timings)
        rows.append({**row, "bytes_per_transition": bytes_per_transition(models[name]) if name in models else None})
    for model in models.values():
        close(model)
    formats = {
        "name": "",
        "ms_per_step": ".1f",
        "best_ms": ".1f",
        "times_floor": ".2f",
        "times_stock_QRDQN": ".2f",
        "page_faults": ",.0f",
        "bytes_per_transition": ",.0f",
    }
    reached = floor.flop / timings[FLOOR].median / 1e6
    heads = timings[EQR_AGENTS[1]].ratio(timings[EQR_AGENTS[0]])
    notes = [
        f"{floor.description()}, {reached:.0f} GFLOP/s reached",
        f"{EQR_AGENTS[1]} over {EQR_AGENTS[0]}: {heads:.2f}",
    ]
    return [Table("steps", f"Gradient step, {SIZE}x{SIZE}x4, batch {BATCH_SIZE}", formats, rows, notes)]


def _step_row(name: str, series: Series, timings: dict[str, Series]) -> dict[str, Any]:
    return {
        "name": name,
        "ms_per_step": series.median,
        "best_ms": series.best,
        "times_floor": series.ratio(timings[FLOOR]),
        "times_stock_QRDQN": series.ratio(timings[STOCK_QRDQN]),
        "page_faults": series.median_faults,
    }


def update_stages(model: EqRAlgorithm) -> list[Stage]:
    """The one table of what a gradient step of an EqR agent is made of."""
    policy = model.policy
    return [
        Stage("sampling", model.replay_buffer, "sample"),
        Stage("augmentation", type(model.objective.augment), "__call__"),
        Stage("encoder, no gradient", policy.target.features_extractor, "forward"),
        Stage("encoder, gradient", policy.online.features_extractor, "forward"),
        Stage("TD loss", model.objective, "_td_terms"),
        Stage("latent losses", policy.latent_model, "forward"),
        Stage("backward", th.Tensor, "backward"),
        Stage("clipping", th.nn.utils, "clip_grad_norm_"),
        Stage("optimiser", policy.optimizer, "step"),
        Stage("target", policy, "update_target"),
        Stage("priorities", model.replay_buffer, "update_priorities"),
        Stage("monitor", model._monitor, "start_round"),
        Stage("monitor", model._monitor, "add"),
        Stage("monitor", model._monitor, "collect"),
    ]


def measure_stages(rounds: int, device: str) -> list[Table]:
    """
    :param rounds: in which the agents take turns
    :param device: of the agents
    :return: one table, the stages as rows
    """
    models = {name: make_trainable(name, device) for name in EQR_AGENTS}
    work = {name: (update_stages(model), partial(train, model)) for name, model in models.items()}
    faults_before = page_faults(device)
    found = break_down(work, rounds, partial(now, device))
    faults_after = page_faults(device)
    for model in models.values():
        close(model)
    rows: list[dict[str, Any]] = []
    for stage in [*found[EQR_AGENTS[0]].calls, REST, WHOLE]:
        rows.append({"stage": stage})
        for name, breakdown in found.items():
            seconds = breakdown.median() if stage == WHOLE else breakdown.median(stage)
            rows[-1] |= {
                f"{name}_ms": seconds * 1e3 / STEPS_PER_CALL,
                f"{name}_%": 100 * seconds / breakdown.median(),
                f"{name}_calls": breakdown.calls[stage] / STEPS_PER_CALL if stage in breakdown.calls else None,
            }
    formats = {key: ".1f" if key.endswith(("%", "calls")) else ".2f" for key in rows[0]} | {"stage": ""}
    notes = ["medians per gradient step; a stage inside another one counts once"]
    if faults_before is not None and faults_after is not None:
        n_steps = rounds * len(models) * STEPS_PER_CALL
        notes.append(f"page faults per gradient step, mean: {(faults_after - faults_before) / n_steps:,.0f}")
    return [Table("stages", "Gradient step by stage", formats, rows, notes)]
