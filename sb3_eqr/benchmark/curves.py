"""What changes along training: scores at evaluations, and losses."""

from collections.abc import Callable
from typing import Any

import numpy as np

from sb3_eqr.benchmark.comparison import Comparison


def evaluation_curve(result: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """
    :param result: of a run
    :return: steps (points,), mean raw scores (points,) of its evaluations along training, the final one included
    """
    found: dict[int, float] = {}
    for evaluation in sorted(result["evaluations"], key=lambda e: e["kind"] == "final"):  # the final one wins at its step
        if evaluation["kind"] in ("curve", "final") and evaluation["scores"]:
            found[evaluation["step"]] = float(np.mean(evaluation["scores"]))
    steps = np.array(sorted(found))
    return steps, np.array([found[step] for step in steps])


def normalized_curves(comparison: Comparison) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """
    :return: agent -> fractions of the training steps (points,), agent -> normalised scores (runs, games, points); agents
        whose runs share fewer than two points are left out
    """
    fractions, curves = {}, {}
    for agent in comparison.agents:
        runs = [result for result in comparison.results if result["agent"] == agent]
        by_run: dict[tuple[str, int], dict[float, float]] = {}
        for run in runs:
            steps, raw = evaluation_curve(run)
            shares = np.round(steps / steps[-1], 2)  # games may differ in steps, and a curve's points in rounding
            values = comparison.normalize(run["game"], raw)
            by_run[run["game"], run["seed"]] = dict(zip(shares.tolist(), values.tolist(), strict=True))
        common = sorted(set.intersection(*(set(curve) for curve in by_run.values())))
        if len(common) > 1:
            seeds = sorted({seed for _, seed in by_run})
            curves[agent] = np.array(
                [[[by_run[game, seed][share] for share in common] for game in comparison.games] for seed in seeds]
            )
            fractions[agent] = np.array(common)
    return fractions, curves


def on_common_steps(curves: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """
    :param curves: steps (points,), values (points,) of each run; a run may log at other steps than the next
    :return: steps (points,) of the run with fewest within what all cover, values (runs, points), linear in between
    """
    first, last = max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves)
    grid = min((steps for steps, _ in curves), key=len)
    grid = grid[(grid >= first) & (grid <= last)]
    return grid, np.array([np.interp(grid, steps, values) for steps, values in curves])


def learning_curves(comparison: Comparison) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """
    :return: game -> agent -> steps (points,), raw mean scores (runs, points) at the evaluations along training; without
        the agents that were evaluated at the end only
    """
    return _per_game(comparison, evaluation_curve)


def symmetry_losses(comparison: Comparison) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """
    :return: game -> agent -> steps (points,), L_AET + L_GET (runs, points) of equation 21 as far as the agent has them;
        without the agents that have neither
    """
    return _per_game(comparison, _symmetry_loss)


def _symmetry_loss(result: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    rows = [row for row in result.get("losses", []) if "aet_loss" in row or "symmetry_loss" in row]
    values = [row.get("aet_loss", 0.0) + row.get("symmetry_loss", 0.0) for row in rows]
    return np.array([row["step"] for row in rows]), np.array(values)


def _per_game(
    comparison: Comparison, curve: Callable[[dict[str, Any]], tuple[np.ndarray, np.ndarray]]
) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
    found: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]] = {}
    for game in comparison.games:
        for agent in comparison.agents:
            runs = [curve(r) for r in comparison.results if (r["agent"], r["game"]) == (agent, game)]
            if min(len(steps) for steps, _ in runs) > 1:
                steps, values = on_common_steps(runs)
                if len(steps) > 1:
                    found.setdefault(game, {})[agent] = steps, values
    return found
