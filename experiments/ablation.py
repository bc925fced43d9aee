"""
The table and the figure of docs/results/ablation.md: the entry of EqRRainbow for MinAtar with one component changed, compared
with the entry, from the rows of ``experiments.trials``.

    python -m experiments.ablation docs/results/ablation.jsonl docs/results/ablation.png
"""

import argparse
import pathlib
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import t as student

from experiments.trials import GAMES, mean_and_error, read_rows
from sb3_eqr.plot_style import styled

STEPS = 15_000
ENTRY = "recipe"
NAMES = {
    "no_eqr": "without EqR: no group, no losses",
    "aet": "AET loss only",
    "get": "GET loss only",
    "reward": "reward loss only",
    "no_layer_norm": "no layer norm of the features",
    "no_centring": "features not centred",
    "head_on_elements": "Q head on the group elements",
    "shared_projection": "... and its first layer as projection",
    "no_predictor": "no predictor",
    "contrastive": "contrastive AET loss",
    "lagging_target": "latent model's target lags",
    "batch_norm": "batch norm in κ, ρ and r_ψ",
    "larger_aet": "aet_coef=5",
    "no_limit": "no limit of the gradient",
    "flat_head": "categorical head starts flat",
    "larger_epsilon": "Adam's ε of 1.5e-4",
    "ten_steps": "ten-step returns",
}


def returns_in_training(row: dict[str, Any]) -> float:
    """The mean of ``rollout/ep_rew_mean`` over the last tenth of the times that it was logged."""
    return float(row["curve"][-1])


MEASURES = {"score": lambda row: row["score"], "return in training": returns_in_training}


def matrix(rows: list[dict[str, Any]], measure: str) -> np.ndarray:
    """
    :param rows: of one trial
    :param measure: a key of ``MEASURES``
    :return: (seeds, games); the seeds that all games have
    """
    values = {(row["seed"], row["game"]): MEASURES[measure](row) for row in rows}
    seeds = [seed for seed in sorted({seed for seed, _ in values}) if all((seed, game) in values for game in GAMES)]
    return np.array([[values[seed, game] for game in GAMES] for seed in seeds]).reshape(len(seeds), len(GAMES))


def ratio(changed: np.ndarray, entry: np.ndarray) -> tuple[float, float, float]:
    """
    The ratio of two trials' means over seeds, averaged over games, and its 95 % interval: variances of the means by the delta
    method, degrees of freedom as in Welch's t test. A bootstrap of five seeds would be too narrow.

    :param changed: (seeds, games)
    :param entry: (seeds, games)
    """
    ratios = changed.mean(axis=0) / entry.mean(axis=0)
    parts = [
        (scale**2 * scores.var(axis=0, ddof=1) / len(scores) / (entry.mean(axis=0) * len(ratios)) ** 2, len(scores) - 1)
        for scores, scale in ((changed, 1.0), (entry, ratios))
        if len(scores) > 1
    ]
    variance = sum(part.sum() for part, _ in parts)
    half = np.inf if len(parts) < 2 else 0.0
    if variance > 0 and len(parts) == 2:
        freedom = variance**2 / sum((part**2).sum() / n for part, n in parts)
        half = student.ppf(0.975, freedom) * np.sqrt(variance)
    return float(ratios.mean()), float(ratios.mean() - half), float(ratios.mean() + half)


def table(trials: dict[str, list[dict[str, Any]]]) -> str:
    """
    A Markdown table with a row per trial: scores and skills, and both measures relative to the entry.

    :param trials: name -> rows
    """
    lines = ["| | seeds | " + " | ".join(GAMES) + " | " + " | ".join(f"{m}, relative" for m in MEASURES) + " | skill |"]
    lines.append("|---" * (len(GAMES) + len(MEASURES) + 3) + "|")
    for name, rows in trials.items():
        complete = matrix(rows, "score")
        scores = [mean_and_error(list(of_game)) for of_game in complete.T]
        relative = [
            "1" if name == ENTRY else "{:.2f} [{:.2f}, {:.2f}]".format(*compared(trials, name, measure))
            for measure in MEASURES
        ]
        skills = np.array([row["skill"] for row in rows if row.get("skill")])
        skill = f"{skills[:, 0].mean():.2f}, {skills[:, -1].mean():.2f}" if len(skills) else ""
        cells = [NAMES.get(name, "the entry"), str(len(complete)), *scores, *relative, skill]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def compared(trials: dict[str, list[dict[str, Any]]], name: str, measure: str) -> tuple[float, float, float]:
    """The ratio to the entry and its 95 % interval."""
    return ratio(matrix(trials[name], measure), matrix(trials[ENTRY], measure))


def draw(trials: dict[str, list[dict[str, Any]]], picture: pathlib.Path) -> None:
    """
    Ratios to the entry with their intervals, a panel per measure.

    :param trials: name -> rows
    :param picture: path of the image
    """
    names = [name for name in trials if name != ENTRY]
    rows = -np.arange(len(names))
    with styled():
        figure, axes = plt.subplots(1, len(MEASURES), figsize=(9, 0.8 + 0.27 * len(names)), sharey=True, layout="constrained")
        for axis, measure in zip(axes, MEASURES, strict=True):
            values, low, high = np.array([compared(trials, name, measure) for name in names]).T
            axis.errorbar(values, rows, xerr=[values - low, high - values], fmt="o", capsize=2)
            axis.axvline(1, color="0.5", lw=1)
            axis.set(xlabel=f"{measure}, relative to the entry", xlim=(0, None))
            axis.grid(axis="x")
        axes[0].set_yticks(rows, [NAMES[name] for name in names])
        figure.savefig(picture, dpi=150)
        plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", type=pathlib.Path)
    parser.add_argument("picture", type=pathlib.Path)
    args = parser.parse_args()
    every = [row for row in read_rows(args.rows) if row["steps"] == STEPS]
    found = {name: [row for row in every if row["trial"] == name] for name in (ENTRY, *NAMES)}
    found = {name: rows for name, rows in found.items() if len(matrix(rows, "score"))}
    print(table(found))
    draw(found, args.picture)
