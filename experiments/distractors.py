"""
The figure of docs/results/worlds.md: an observation of the torus with distractors, and how often the goal is reached during
training, from the rows of ``experiments.trials``; bands are 95 % bootstrap intervals of the mean over seeds.

    python -m experiments.distractors docs/results/worlds.jsonl docs/results/distractors.png
"""

import argparse
import pathlib

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np

from experiments.trials import N_PARTS, WORLDS, read_rows
from sb3_eqr import envs
from sb3_eqr.plot_style import looks, styled

STEPS = 8_000
SEEDS = range(3, 15)  # 0 to 2 served to choose the settings
GAMES = ("torus_of_4", "torus_of_8")
NAMES = {
    "default": "EqR",
    "aet_5": "EqR, aet_coef=5",
    "contrastive": "EqR, contrastive AET loss",
    "distance": "EqR without predictor",
    "no_group": "EqR without a group",
    "no_aet": "EqR without the AET loss",
    "plain": "Q-learning alone",
}


def interval(values: np.ndarray) -> np.ndarray:
    """
    :param values: (seeds, parts)
    :return: (2, parts), the bootstrap's percentiles 2.5 and 97.5 of the mean
    """
    picks = np.random.default_rng(0).integers(0, len(values), (10_000, len(values)))
    return np.percentile(values[picks].mean(axis=1), [2.5, 97.5], axis=0)


def draw(rows: pathlib.Path, picture: pathlib.Path) -> None:
    """
    :param rows: file of ``experiments.trials``
    :param picture: path of the image
    """
    envs.register()
    every = [row for row in read_rows(rows) if row["steps"] == STEPS and row["seed"] in SEEDS]
    with styled():
        figure, axes = plt.subplots(1, 1 + len(GAMES), figsize=(3 + 3 * len(GAMES), 3.3), layout="constrained")
        env_id, env_kwargs = WORLDS[GAMES[0]]
        axes[0].imshow(gym.make(env_id, **env_kwargs).reset(seed=2)[0], cmap="gray")
        axes[0].set_title(f"an observation, {env_kwargs['n_distractors']} distractors")
        axes[0].set_axis_off()
        steps = np.arange(1, N_PARTS + 1) * STEPS / N_PARTS
        for axis, game in zip(axes[1:], GAMES, strict=True):
            for name, look in looks(list(NAMES)).items():
                parts = [row["rewards_per_part"] for row in every if (row["game"], row["trial"]) == (game, name)]
                if parts:
                    axis.plot(steps, np.mean(parts, axis=0), look.marker, ls=look.line, color=look.color, label=NAMES[name])
                    axis.fill_between(steps, *interval(np.array(parts)), color=look.color, alpha=0.15, lw=0)
            axis.set(title=f"{WORLDS[game][1]['n_distractors']} distractors", xlabel="steps", ylim=(0, 100))
            axis.grid()
        axes[1].set_ylabel(f"goals reached per {STEPS // N_PARTS} steps")
        figure.legend(*axes[-1].get_legend_handles_labels(), loc="outside lower right", ncols=3)
        figure.savefig(picture, dpi=150)
        plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", type=pathlib.Path)
    parser.add_argument("picture", type=pathlib.Path)
    args = parser.parse_args()
    draw(args.rows, args.picture)
