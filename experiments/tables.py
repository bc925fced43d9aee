"""
Tables of docs/results that ``sb3-eqr benchmark report`` does not have: other measures than final scores, agent by agent, from
folders of a benchmark or files of packed runs.

    python -m experiments.tables docs/results/worlds.jsonl.xz --games torus_of_8 --agents default plain --baseline plain
        --measures goals score R2 skill
    python -m experiments.tables docs/results/ablation.jsonl.xz --measures score end skill --baseline recipe --ratio
    python -m experiments.tables docs/results/atari100k/gpu.jsonl.xz --games Boxing --measures 0-20000 20000-40000
    python -m experiments.tables docs/results/worlds.jsonl.xz --games torus_of_4 torus_of_8 --figure goals distractors.png
    python -m experiments.tables --published

Cells are means ± standard errors over seeds, with ``--each`` the seeds themselves. With ``--baseline`` they also have the
difference of the means, or with ``--ratio`` the ratio averaged over games, and its 95 % interval.
"""

import argparse
import pathlib
from collections.abc import Callable
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from scipy.stats import t as student
from scipy.stats import ttest_ind

from sb3_eqr.benchmark.packed import read
from sb3_eqr.benchmark.reference import HUMAN, RANDOM, load_reference
from sb3_eqr.benchmark.scores import evaluation_curve
from sb3_eqr.plot_style import looks, styled

Row = dict[str, Any]
PARTS = 10  # of a run, for the return at its end and for figures


def series(row: Row, what: str) -> tuple[np.ndarray, np.ndarray]:
    """
    :param what: "return" of episodes in training, "goals" (episodes with a positive return), or a logged key such as
        "aet_loss" or "latent/skill"
    :return: steps at the ends of ``PARTS`` parts of the run, and means in them ("goals": numbers), NaN where there is none
    """
    edges = np.linspace(0, row["protocol"]["steps"], PARTS + 1)
    if what in (kept := row.get("tenths", {})):
        return edges[1:][-len(kept[what]) :], np.array(kept[what])
    table = pd.DataFrame(row["training"] if what in ("return", "goals") else row["losses"]).rename(columns={"score": "return"})
    if what == "goals":
        return edges[1:], np.histogram(table["step"][table["return"] > 0], edges)[0]
    if what not in table:
        return edges[1:], np.full(PARTS, np.nan)
    return edges[1:], table.groupby(pd.cut(table["step"], edges), observed=False)[what].mean().to_numpy()


def goal_steps(row: Row) -> np.ndarray:
    """:return: steps at which an episode ended with a positive return"""
    return np.array(row["training"]["step"])[np.array(row["training"]["score"]) > 0]


def first_at(row: Row, level: float) -> float:
    """:return: the step of the first evaluation of at least ``level``"""
    steps, scores = evaluation_curve(row)
    return next((step for step, score in zip(steps, scores, strict=True) if score >= level), np.nan)


def skill(row: Row, last: bool) -> float:
    """:return: the latent model's skill at the end of training, as LatentCallback logged it, one or M steps ahead"""
    key = "latent/skill_last" if last else "latent/skill"
    return next((logged[key] for logged in reversed(row["losses"]) if key in logged), np.nan)


MEASURES: dict[str, Callable[[Row], float]] = {
    "score": lambda row: evaluation_curve(row)[1][-1],
    "end": lambda row: series(row, "return")[1][-1],  # return in training, in the last tenth
    "return": lambda row: np.mean(row["training"]["score"]),
    "goals": lambda row: len(goal_steps(row)),
    "first_goal": lambda row: min(goal_steps(row), default=np.nan),
    "skill": lambda row: skill(row, last=False),
    "skill_last": lambda row: skill(row, last=True),
    "R2": lambda row: np.nan,  # of the true state from the trunk's features, measured after training (experiments.probes)
    "minutes": lambda row: row["wall_clock_s"] / 60,
}


def measure(row: Row, name: str) -> float:
    """
    :param name: a key of ``MEASURES``; "20000-40000", the mean return of the training episodes that ended in these steps;
        "at475", the step of the first evaluation of at least 475; or "train/KEY", the last value of a logged key
    :return: its value, NaN if the run does not have it; what was measured when the run was made comes first
    """
    if name in row.get("measures", {}):
        return float(row["measures"][name])
    if name in MEASURES:
        return float(MEASURES[name](row))
    if name.startswith("at"):
        return first_at(row, float(name[2:]))
    if name.startswith("train/"):
        return float(next((logged[name[6:]] for logged in reversed(row["losses"]) if name[6:] in logged), np.nan))
    first, last = map(int, name.split("-"))
    found = [s for step, s in zip(row["training"]["step"], row["training"]["score"], strict=True) if first < step <= last]
    return float(np.mean(found)) if found and row.get("stopped_at", last) >= last else np.nan


def text(value: float) -> str:
    """A number with about three digits."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


def mean_and_error(values: np.ndarray) -> str:
    """Mean ± standard error; for a single value, the mean only."""
    error = f" ± {text(np.std(values, ddof=1) / np.sqrt(len(values)))}" if len(values) > 1 else ""
    return f"{text(np.mean(values))}{error}" if len(values) else ""


def difference(values: np.ndarray, other: np.ndarray) -> str:
    """The difference of two means and its 95 % interval (Welch 1947, https://doi.org/10.1093/biomet/34.1-2.28)."""
    if min(len(values), len(other)) < 2 or max(np.ptp(values), np.ptp(other)) == 0:
        return ""
    found = ttest_ind(values, other, equal_var=False).confidence_interval()
    return f" ({text(np.mean(values) - np.mean(other))} [{text(found.low)}, {text(found.high)}])"


def ratio(changed: np.ndarray, entry: np.ndarray) -> tuple[float, float, float]:
    """
    The ratio of two agents' means over seeds, averaged over games, and its 95 % interval: variances of the means by the delta
    method, degrees of freedom as in Welch's t test. A bootstrap of five seeds would be too narrow.

    :param changed: (seeds, games)
    :param entry: (seeds, games)
    """
    ratios = changed.mean(axis=0) / entry.mean(axis=0)
    if min(len(changed), len(entry)) < 2:
        return float(ratios.mean()), -np.inf, np.inf
    variances, freedoms = [], []
    for scores, scale in ((changed, 1.0), (entry, ratios)):
        variances.append(scale**2 * scores.var(axis=0, ddof=1) / len(scores) / (entry.mean(axis=0) * len(ratios)) ** 2)
        freedoms.append(len(scores) - 1)
    variance = np.sum(variances)
    freedom = variance**2 / sum((part**2).sum() / n for part, n in zip(variances, freedoms, strict=True)) if variance else 1
    half = student.ppf(0.975, freedom) * np.sqrt(variance)
    return float(ratios.mean()), float(ratios.mean() - half), float(ratios.mean() + half)


def values_of(rows: list[Row], agent: str, game: str, name: str) -> dict[int, float]:
    """:return: seed -> value of a measure, for the runs that have it"""
    found = {row["seed"]: measure(row, name) for row in rows if (row["agent"], row["game"]) == (agent, game)}
    return {seed: value for seed, value in sorted(found.items()) if not np.isnan(value)}


def table(rows: list[Row], measures: list[str], baseline: str | None, is_ratio: bool = False, each: bool = False) -> str:
    """
    :param rows: rows of runs
    :param baseline: the agent that the others are compared with
    :return: Markdown, a row per agent, a column per measure and game
    """
    games, agents = (list(dict.fromkeys(row[key] for row in rows)) for key in ("game", "agent"))
    columns = [(game, name) for name in measures for game in games]
    header = [*(f"{game}, {name}" for game, name in columns), *(f"{name}, relative" for name in measures if is_ratio)]
    lines = [f"| agent | seeds | {' | '.join(header)} |", "|---" * (len(header) + 2) + "|"]
    for agent in agents:
        cells = []
        for game, name in columns:
            values = list(values_of(rows, agent, game, name).values())
            cell = ", ".join(map(text, values)) if each else mean_and_error(np.array(values))
            if baseline not in (None, agent) and not is_ratio:
                cell += difference(np.array(values), np.array(list(values_of(rows, str(baseline), game, name).values())))
            cells.append(cell)
        for name in measures if is_ratio else []:
            both = [[values_of(rows, one, game, name) for game in games] for one in (agent, str(baseline))]
            seeds = [sorted(set.intersection(*map(set, found))) for found in both]
            matrices = [np.array([[v[s] for v in found] for s in own]) for found, own in zip(both, seeds, strict=True)]
            has_all = agent != baseline and min(map(len, matrices)) > 0
            cells.append("{:.2f} [{:.2f}, {:.2f}]".format(*ratio(*matrices)) if has_all else "")
        n_seeds = len({row["seed"] for row in rows if row["agent"] == agent})
        lines.append(f"| {agent} | {n_seeds} | {' | '.join(cells)} |")
    return "\n".join(lines)


def draw(rows: list[Row], what: str, path: pathlib.Path) -> None:
    """
    Draw a series along training, a panel per game: means over seeds, and the range of the seeds as a band.

    :param what: see :func:`series`
    """
    games, agents = (list(dict.fromkeys(row[key] for row in rows)) for key in ("game", "agent"))
    with styled():
        figure, axes = plt.subplots(1, len(games), figsize=(4 * len(games), 3.2), layout="constrained", squeeze=False)
        for axis, game in zip(axes[0], games, strict=True):
            for agent, look in looks(agents).items():
                found = [series(row, what) for row in rows if (row["agent"], row["game"]) == (agent, game)]
                if found:
                    steps, runs = found[0][0] / 1_000, np.array([values for _, values in found])
                    axis.plot(steps, runs.mean(axis=0), look.marker, ls=look.line, color=look.color, label=agent)
                    axis.fill_between(steps, runs.min(axis=0), runs.max(axis=0), color=look.color, alpha=0.15, lw=0)
            axis.set(title=game, xlabel="steps (thousands)", ylabel=what)
        lines = {str(line.get_label()): line for axis in axes[0] for line in axis.get_lines()}
        figure.legend(list(lines.values()), list(lines), loc="outside lower center", ncols=3)
        figure.savefig(path, dpi=150, metadata={"Software": None})
        plt.close(figure)


def published() -> str:
    """:return: Markdown: the last rows of the EqR paper's tables, computed from the scores of games in them"""
    scores = load_reference().pivot(index="game", columns="method", values="mean")
    lines = ["| table | method | mean | median | superhuman games |", "|---" * 5 + "|"]
    for method in sorted((name for name in scores if "[EqR Tab" in name), key=lambda name: (name[-2], name)):
        found = ((scores[method] - scores[RANDOM]) / (scores[HUMAN] - scores[RANDOM])).dropna()
        name = method.partition(" [")[0].replace("$", "")
        lines.append(f"| {method[-2]} | {name} | {found.mean():.3f} | {found.median():.3f} | {(found > 1).sum()} |")
    return "\n".join(lines)


def main() -> None:
    """Parse the command line, print the table or draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=pathlib.Path, help="folders of a benchmark, or files of packed runs")
    parser.add_argument("--agents", nargs="+", help="with or without their algorithm (default: all)")
    parser.add_argument("--games", nargs="+", help="default: all")
    parser.add_argument("--seeds", nargs="+", type=int, help="default: all")
    parser.add_argument(
        "--measures", nargs="+", default=["score", "end", "minutes"], help=f"{', '.join(MEASURES)}, 0-20000, ..."
    )
    parser.add_argument("--baseline", help="the agent that the others are compared with")
    parser.add_argument("--ratio", action="store_true", help="compare by ratios, averaged over games")
    parser.add_argument("--each", action="store_true", help="print the seeds")
    parser.add_argument(
        "--figure", nargs=2, metavar=("SERIES", "FILE"), help="draw return, goals, aet_loss, ... along training"
    )
    parser.add_argument("--published", action="store_true", help="print the last rows of the paper's tables")
    args = parser.parse_args()
    if args.published:
        print(published())
        return
    rows = [row for file in args.files for row in read(file)[1]]
    full = {name: agent for agent in dict.fromkeys(row["agent"] for row in rows) for name in (agent, agent.partition(":")[2])}
    wanted = None if args.agents is None else [full.get(name, name) for name in args.agents]
    rows = [row for row in rows if wanted is None or row["agent"] in wanted]
    rows = [row for row in rows if args.games is None or row["game"] in args.games]
    rows = [row for row in rows if args.seeds is None or row["seed"] in args.seeds]
    if not rows:
        parser.error(f"no run of these agents, games and seeds; agents are {', '.join(sorted(set(full.values())))}")
    if wanted is not None:
        rows.sort(key=lambda row: wanted.index(row["agent"]))
    if args.figure:
        draw(rows, args.figure[0], pathlib.Path(args.figure[1]))
    else:
        print(table(rows, args.measures, full.get(args.baseline, args.baseline), args.ratio, args.each))


if __name__ == "__main__":
    main()
