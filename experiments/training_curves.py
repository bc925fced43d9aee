"""
What happened during the runs of a benchmark: returns, losses, gradients at the latent state, and the latent model's metrics
(with LatentCallback), a panel each per game.

    python -m experiments.training_curves runs/atari docs/results/atari100k
"""

import argparse
import io
import pathlib
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

from sb3_eqr.benchmark.scores import load_results
from sb3_eqr.common.saving.files import atomic_write
from sb3_eqr.plot_style import looks, styled

POINTS = 50  # of a curve: means over parts of equal length
PANELS = {  # title -> column
    "return of a game": "score",
    "TD loss": "td_loss",
    "AET loss": "aet_loss",
    "GET loss": "symmetry_loss",
    "reward loss": "reward_loss",
    "auxiliary / TD gradient": "ratio",
    "cosine of the two gradients": "state_gradient_cosine",
    "skill of the latent model": "latent/skill",
    "effective rank": "latent/effective_rank",
    "spread of the latent states": "latent/spread",
}
LOGARITHMIC = ("td_loss", "aet_loss", "symmetry_loss", "reward_loss", "ratio")


def curves(result: dict[str, Any]) -> dict[str, pd.Series]:
    """
    :param result: result of a run
    :return: column -> mean of each of ``POINTS`` parts of the training, by the step at its end; only what was logged
    """
    training, losses = pd.DataFrame(result["training"]), pd.DataFrame(result["losses"] or {"step": []})
    if {"aux_state_gradient", "td_state_gradient"} <= set(losses):
        losses["ratio"] = losses["aux_state_gradient"] / losses["td_state_gradient"]
    part = result["protocol"]["steps"] / POINTS
    found: dict[str, pd.Series] = {}
    for table in (training, losses):
        means = table.groupby(np.ceil(table["step"] / part) * part).mean()
        found |= {str(name): means[name].dropna() for name in means if name in PANELS.values() and means[name].notna().any()}
    return found


def draw(ax: Axes, title: str, by_agent: dict[str, list[pd.Series]]) -> None:
    """
    Draw a panel: mean over seeds of each agent; the range of the seeds is shaded.

    :param by_agent: agent -> a curve per seed
    """
    style = looks(list(by_agent))
    for agent, runs in by_agent.items():
        if runs:
            table = pd.concat(runs, axis=1).sort_index().interpolate("index", limit_area="inside")  # steps of logs differ
            steps, look = table.index.to_numpy() / 1_000, style[agent]
            ax.plot(steps, table.mean(axis=1), color=look.color, linestyle=look.line, linewidth=1.2, label=agent)
            ax.fill_between(steps, table.min(axis=1), table.max(axis=1), color=look.color, alpha=0.15, linewidth=0)
    ax.set_title(title, loc="left")
    ax.set_xlim(left=0)
    if PANELS[title] in LOGARITHMIC:
        ax.set_yscale("log")
        low, high = ax.get_ylim()  # many curves stay within a decade: three ticks in each, or a few at equal distances
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)) if high > 5 * low else MaxNLocator(4))
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:.4g}"))
        ax.yaxis.set_minor_formatter(NullFormatter())


def figure_of(results: list[dict[str, Any]]) -> plt.Figure:
    """
    :param results: results of the runs of one game
    :return: a panel per quantity that was logged
    """
    by_run = [(result["agent"], curves(result)) for result in results]
    by_run.sort(key=lambda run: -len(run[1]))  # the agent with most panels has the first colour in every figure
    agents = list(dict.fromkeys(agent for agent, _ in by_run))
    shown = {
        title: {agent: [found[column] for name, found in by_run if name == agent and column in found] for agent in agents}
        for title, column in PANELS.items()
    }
    shown = {title: by_agent for title, by_agent in shown.items() if any(by_agent.values())}
    rows = -(-len(shown) // 2)
    figure, axes = plt.subplots(rows, 2, figsize=(7, 1.5 * rows + 0.5), layout="constrained", squeeze=False)
    for ax, (title, by_agent) in zip(axes.flat, shown.items(), strict=False):
        draw(ax, title, by_agent)
    for ax in list(axes.flat)[len(shown) :]:
        ax.remove()
    for column in range(2):
        axes[-1 if rows * 2 == len(shown) or column == 0 else -2, column].set_xlabel("steps (thousands)")
    lines = {str(line.get_label()): line for ax in figure.axes for line in ax.get_lines()}  # not every panel has all agents
    figure.legend(list(lines.values()), list(lines), loc="outside lower center", ncols=2)
    return figure


def main() -> None:
    """Parse the command line, write a figure per game."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=pathlib.Path, help="folder of a benchmark")
    parser.add_argument("output", type=pathlib.Path, help="folder for the figures, one per game: GAME.png")
    arguments = parser.parse_args()
    results = load_results(arguments.folder)
    if not results:
        raise SystemExit(f"{arguments.folder} must be the folder of a benchmark, got one without finished runs.")
    for game in dict.fromkeys(result["game"] for result in results):
        with styled():
            figure = figure_of([result for result in results if result["game"] == game])
            buffer = io.BytesIO()
            figure.savefig(buffer, format="png", dpi=130, metadata={"Software": None})
            plt.close(figure)
        path = arguments.output / f"{game}.png"
        with atomic_write(path, "png") as file:
            file.write(buffer.getvalue())
        print(path)


if __name__ == "__main__":
    main()
