"""
Tables of docs/results that ``sb3-eqr benchmark report`` does not have: other measures than final scores, agent by agent, from
folders of a benchmark or files of packed runs.

    python -m experiments.tables docs/results/worlds.jsonl.xz --games torus_of_8 --agents default plain --baseline plain
        --measures goals score R2
    python -m experiments.tables docs/results/ablation.jsonl.xz --measures score end --baseline recipe --ratio
    python -m experiments.tables docs/results/atari100k/gpu.jsonl.xz --games Boxing --measures 0-20000 20000-40000
    python -m experiments.tables docs/results/first_page.jsonl.xz --agents aet_5 plain --figure goals distractors.png
    python -m experiments.tables docs/results --differences differences.png
    python -m experiments.tables docs/results/atari100k/recipes.jsonl.xz --claim slow_target_eqr slow_target
    python -m experiments.tables --published

Cells are means ± standard errors over seeds, with ``--each`` the seeds themselves. With ``--baseline`` they also have the
difference of the means, or with ``--ratio`` the ratio averaged over games, and its 95% interval. Figures are 3.9 inches wide,
so that their letters can be read on a screen of 390 pixels.
"""

import argparse
import json
import lzma
import pathlib
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.ticker import MaxNLocator
from scipy.stats import t as student
from scipy.stats import ttest_ind

from experiments import markdown
from sb3_eqr.benchmark.packed import read
from sb3_eqr.benchmark.reference import HUMAN, RANDOM, load_reference
from sb3_eqr.benchmark.scores import evaluation_curve, normalised
from sb3_eqr.plot_style import COLORS, GREY, looks, styled

Row = dict[str, Any]
Arguments = tuple[str, list[str], list[str], tuple[str, str], str, str]  # of ``compare``
PARTS = 10  # of a run, for the return at its end and for figures
SPR = "SPR (rliable, 100 runs)"  # in reference_scores.csv
PAPER = "EqR, L_R + L_{GET} [EqR Tab2]", "SPR [EqR Tab2]"  # the paper's agent with all losses, and the one that it compares
WIDTH, DPI = 3.9, 200  # of figures, in inches and dots per inch
AXES = {
    "score": "mean score of the evaluation episodes",
    "return": "mean return in training",
    "goals": "goals reached per tenth of the run",
}
TITLES = {
    "torus_of_4": "torus, 4 distractors",
    "torus_of_8": "torus, 8 distractors",
    "pendulum": "PixelPendulum-v0",
    "UpNDown": "Up N Down",
    "MsPacman": "Ms Pacman",
}
VERDICTS = {  # colour and marker of each
    "better with EqR": (COLORS[0], "^"),
    "no clear difference": (GREY, "o"),
    "worse with EqR": (COLORS[1], "v"),
}
MINATAR, MINATAR_RUNS = ["Breakout", "SpaceInvaders", "Asterix", "Freeway", "Seaquest"], ["minatar_30k_final.jsonl.xz"]
OFF = {"EqR_Rainbow": "rainbow", "EqR_QRDQN": "qrdqn"}
DEFAULTS, DEFAULTS_OFF = ("eqr_qrdqn:default", "eqr_qrdqn:plain"), ("eqr_rainbow:defaults", "eqr_rainbow:defaults_off")
ZOO, ATARI = ["zoo.jsonl.xz", "lunarlander_variants.jsonl.xz"], ["atari100k/gpu.jsonl.xz"]
FIRST_PAGE = (["first_page.jsonl.xz"], ["torus_of_8"], ("eqr_qrdqn:aet_5", "eqr_qrdqn:plain"), "goals")
NOISE = ["continuous_early.xz", "continuous_short.xz"]
EARLY = "area2000-12000", "continuous.md#in-12000-steps"  # after the random steps
LATE = ["continuous_gate.xz", "continuous.xz"]
COMPARED: list[Arguments] = [
    *(
        (f"{task}, EqRSAC", ["continuous_early.xz"], [f"{task}-v5"], ("eqr_sac", "sac"), *EARLY)
        for task in ("HalfCheetah", "Ant", "Walker2d", "Hopper", "Humanoid")
    ),
    *(
        (
            f"{task}, 100,000 steps, EqRSAC",
            LATE,
            [f"{task}-v5"],
            ("eqr_sac", "sac"),
            "area0-100000",
            "continuous.md#in-100000-steps",
        )
        for task in ("HalfCheetah", "Ant", "Walker2d", "Hopper")
    ),
    (
        "Pendulum from images, EqRSAC",
        ["continuous_early.xz"],
        ["PixelPendulum-v0"],
        ("eqr_sac", "drq"),  # SAC with DrQ's encoder
        EARLY[0],
        "continuous.md#from-images",
    ),
    ("HalfCheetah, EqRTQC", ["continuous_early.xz"], ["HalfCheetah-v5"], ("eqr_tqc", "tqc"), *EARLY),
    ("HalfCheetah, noise inputs, EqRSAC", NOISE, ["HalfCheetah-v5+noise"], ("eqr_sac", "sac"), *EARLY),
    ("Torus, 8 distractors, aet_coef=5", *FIRST_PAGE, "worlds.md#a-torus-with-distractors"),
    ("Torus, 8 distractors", ["worlds.jsonl.xz"], ["torus_of_8"], DEFAULTS, "goals", "worlds.md#a-torus-with-distractors"),
    ("Torus, 4 distractors", ["worlds.jsonl.xz"], ["torus_of_4"], DEFAULTS, "goals", "worlds.md#a-torus-with-distractors"),
    ("Large torus", ["worlds.jsonl.xz"], ["large_torus"], DEFAULTS, "goals", "worlds.md#a-large-torus"),
    ("Pendulum from images, EqRQRDQN", ["worlds.jsonl.xz"], ["pendulum"], DEFAULTS, "return", "worlds.md#a-pendulum"),
    ("Atari Boxing", ATARI, ["Boxing"], DEFAULTS_OFF, "56000-76000", "atari100k.md"),
    ("Atari Breakout", ATARI, ["Breakout"], DEFAULTS_OFF, "40000-60000", "atari100k.md"),
    ("CartPole", ["cartpole.jsonl.xz"], ["CartPole-v1"], ("eqr_qrdqn", "eqr_qrdqn:off"), "until10000", "cartpole.md"),
    ("LunarLander", ZOO, ["LunarLander-v3"], ("eqr_qrdqn:e482329", "eqr_qrdqn:mlp"), "score", "zoo.md"),
    *(
        (f"MinAtar {game}, {agent}", MINATAR_RUNS, [game], (agent.lower(), f"{agent.lower()}:{off}"), "score", "minatar.md")
        for agent, off in OFF.items()
        for game in MINATAR
    ),
]
MEANS: list[Arguments] = [  # printed, not drawn
    (f"MinAtar, {agent}", MINATAR_RUNS, MINATAR, (agent.lower(), f"{agent.lower()}:{off}"), "score", "minatar.md")
    for agent, off in OFF.items()
]


def series(row: Row, what: str) -> tuple[np.ndarray, np.ndarray]:
    """
    :param what: "score" of evaluations, "return" of episodes in training, "goals" (episodes with a positive return), or a
        logged key such as "aet_loss" or "latent/skill"
    :return: steps at the ends of ``PARTS`` parts of the run, and means in them ("goals": numbers), NaN where there is none;
        "score": those of the evaluations
    """
    if what == "score":
        return evaluation_curve(row)
    edges = np.linspace(0, row["protocol"]["steps"], PARTS + 1)
    if what in (kept := row.get("tenths", {})):
        return edges[1:][-len(kept[what]) :], np.array(kept[what])
    episodes = {"step": row["training"]["step"], "return": row["training"]["score"]}
    table = pd.DataFrame(episodes if what in ("return", "goals") else row["losses"])
    if what == "goals":
        return edges[1:], np.histogram(table["step"][table["return"] > 0], edges)[0]
    if what not in table:
        return edges[1:], np.full(PARTS, np.nan)
    return edges[1:], table.groupby(pd.cut(table["step"], edges), observed=False)[what].mean().to_numpy()


def goals(row: Row) -> list[int]:
    """:return: steps at which an episode ended with a positive return"""
    return [step for step, score in zip(row["training"]["step"], row["training"]["score"], strict=True) if score > 0]


MEASURES: dict[str, Callable[[Row], float]] = {
    "score": lambda row: np.nan if "stopped_at" in row else evaluation_curve(row)[1][-1],
    "end": lambda row: series(row, "return")[1][-1],  # return in training, in the last tenth
    "return": lambda row: np.mean(row["training"]["score"]),
    "goals": lambda row: len(goals(row)),
    "first_goal": lambda row: min(goals(row), default=np.nan),
    "R2": lambda row: np.nan,  # of the true state from the trunk's features, measured after training (experiments.probes)
    "minutes": lambda row: row["wall_clock_s"] / 60,
}


def measure(row: Row, name: str) -> float:
    """
    :param name: a key of ``MEASURES``; "20000-40000", the mean return of the training episodes that ended in these steps;
        "area20000-40000", the same with episodes weighted by their lengths; "goals0-4000", the goals in these steps; "at475",
        the step of the first evaluation of at least 475; "until10000", the mean of the evaluations up to this step; or
        "train/KEY", the last value of a logged key
    :return: its value, NaN if the run does not have it; what was measured when the run was made comes first
    """
    if name in row.get("measures", {}):
        return float(row["measures"][name])
    if name in MEASURES:
        return float(MEASURES[name](row))
    if name.startswith("train/"):
        return float(next((logged[name[6:]] for logged in reversed(row["losses"]) if name[6:] in logged), np.nan))
    if name.startswith(("at", "until")):
        steps, scores = evaluation_curve(row)
        limit = float(name.removeprefix("until").removeprefix("at"))
        if name.startswith("until"):
            return float(scores[steps <= limit].mean())
        return float(min(steps[scores >= limit], default=np.nan))
    first, end = map(int, name.removeprefix("area").removeprefix("goals").split("-"))
    if name.startswith("goals"):
        return sum(first < step <= end for step in goals(row))
    if name.startswith("area"):
        return area(row, first, end)
    steps, scores = np.array(row["training"]["step"]), np.array(row["training"]["score"])
    found = scores[(first < steps) & (steps <= end)]
    return float(np.mean(found)) if len(found) and row.get("stopped_at", end) >= end else np.nan


def area(run: Row, after: int = 0, until: float = np.inf) -> float:
    """The mean return of the episodes that end after one step and until another: each weighs as many steps as it has."""
    steps, scores, lengths = (np.array(run["training"][key]) for key in ("step", "score", "length"))
    counted = (steps > after) & (steps <= until)
    if not counted.any():
        return np.nan
    return float(np.average(scores[counted], weights=lengths[counted]))


def text(value: float) -> str:
    """A number with about three digits."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


def mean_and_error(values: np.ndarray) -> str:
    """Mean ± standard error; for a single value, the mean only."""
    error = f" ± {text(np.std(values, ddof=1) / np.sqrt(len(values)))}" if len(values) > 1 else ""
    return f"{text(np.mean(values))}{error}" if len(values) else ""


def difference(values: np.ndarray, other: np.ndarray) -> str:
    """The difference of two means and its 95% interval (Welch 1947, https://doi.org/10.1093/biomet/34.1-2.28)."""
    if min(len(values), len(other)) < 2 or max(np.ptp(values), np.ptp(other)) == 0:
        return ""
    found = ttest_ind(values, other, equal_var=False).confidence_interval()
    return f" ({text(np.mean(values) - np.mean(other))} [{text(found.low)}, {text(found.high)}])"


def ratio(changed: np.ndarray, entry: np.ndarray) -> tuple[float, float, float]:
    """
    The ratio of two agents' means over seeds, averaged over games, and its 95% interval: variances of the means by the delta
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


def unique(rows: list[Row], key: str) -> list[str]:
    """:return: the values of a key in order of appearance"""
    return list(dict.fromkeys(row[key] for row in rows))


def table(rows: list[Row], measures: list[str], baseline: str | None, is_ratio: bool = False, each: bool = False) -> str:
    """
    :param rows: rows of runs
    :param baseline: the agent that the others are compared with
    :return: Markdown, a row per agent, a column per measure and game
    """
    games, ratios = unique(rows, "game"), measures if is_ratio else []
    columns = [(game, name) for name in measures for game in games]
    header = ["agent", "seeds", *(f"{game}, {name}" for game, name in columns), *(f"{name}, relative" for name in ratios)]
    found = [[row["agent"], row["game"], row["seed"], *(measure(row, name) for name in measures)] for row in rows]
    frame = pd.DataFrame(found, columns=["agent", "game", "seed", *measures]).sort_values("seed")
    by_agent, lines = dict(list(frame.groupby("agent"))), []
    for agent in unique(rows, "agent"):
        own, other, cells = by_agent[agent], by_agent.get(baseline, frame[:0]), []
        for game, name in columns:
            every, of_other = (part.loc[part["game"] == game, name] for part in (own, other))
            values, others = every.dropna().to_numpy(), of_other.dropna().to_numpy()
            shown = ", ".join(map(text, values)) if each else mean_and_error(values)
            shown += f" ({len(values)} of {len(every)} runs)" if 0 < len(values) < len(every) else ""
            cells.append(shown + (difference(values, others) if not is_ratio and agent != baseline else ""))
        for name in ratios:
            both = [part.pivot(index="seed", columns="game", values=name).reindex(columns=games) for part in (own, other)]
            matrices = [part.dropna().to_numpy() for part in both]  # of the seeds that have it on all games
            is_compared = agent != baseline and min(map(len, matrices)) > 0
            cells.append("{:.2f} [{:.2f}, {:.2f}]".format(*ratio(*matrices)) if is_compared else "")
        lines.append([agent, str(own["seed"].nunique()), *cells])
    return markdown(header, lines)


def draw(rows: list[Row], what: str, path: pathlib.Path, labels: list[str] | None = None, axis_label: str = "") -> None:
    """
    Draw a series along training, a panel per game: means over seeds, and as a band their 95% intervals, or, below five
    seeds, their range.

    :param what: see :func:`series`
    :param labels: of the agents, in order of appearance (default: their names)
    :param axis_label: in place of that of ``AXES``
    """
    games, agents = unique(rows, "game"), unique(rows, "agent")
    n_columns, n_rows = min(len(games), 2), (len(games) + 1) // 2
    names = dict(zip(agents, labels or agents, strict=True))
    with styled():
        figure, axes = plt.subplots(
            n_rows, n_columns, figsize=(WIDTH, 1.7 * n_rows + 0.9), layout="constrained", squeeze=False, sharex="col"
        )
        for axis, game in zip(axes.flat, games, strict=False):
            for agent, look in looks(agents).items():
                found = [series(row, what) for row in rows if (row["agent"], row["game"]) == (agent, game)]
                if found:
                    steps, runs = found[0][0] / 1_000, np.array([values for _, values in found])
                    mean, low, high = runs.mean(axis=0), runs.min(axis=0), runs.max(axis=0)
                    if len(runs) >= 5:
                        width = student.ppf(0.975, len(runs) - 1) * runs.std(axis=0, ddof=1) / np.sqrt(len(runs))
                        low, high = mean - width, mean + width
                    axis.plot(steps, mean, look.marker, ls=look.line, color=look.color, label=names[agent])
                    axis.fill_between(steps, low, high, color=look.color, alpha=0.15, lw=0)
            axis.set(title=TITLES.get(game, game), xlim=(0, None), ylim=(min(0, axis.get_ylim()[0]), None))
            axis.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
            axis.tick_params(labelbottom=True)
            axis.grid(axis="y")
        for axis in axes.flat[len(games) :]:
            axis.set_axis_off()
        lines = {str(line.get_label()): line for axis in axes.flat for line in axis.get_lines()}
        figure.supxlabel("training steps (thousands)", fontsize="medium")
        figure.supylabel(axis_label or AXES.get(what, what), fontsize="medium")
        figure.legend(list(lines.values()), list(lines), loc="outside upper center")
        figure.savefig(path, dpi=DPI, metadata={"Software": None})
        plt.close(figure)


class Compared(NamedTuple):
    """A task with EqR and without it: means, the 95% interval of their difference, the pooled standard deviation of seeds."""

    task: str
    steps: int
    means: tuple[float, float]
    ends: tuple[float, float]
    spread: float
    seeds: int
    page: str

    @property
    def difference(self) -> float:
        """Positive if EqR is better."""
        return self.means[0] - self.means[1]

    @property
    def verdict(self) -> str:
        """A key of ``VERDICTS``."""
        better, none, worse = VERDICTS
        return better if self.ends[0] > 0 else worse if self.ends[1] < 0 else none


def rows_of(path: pathlib.Path) -> list[Row]:
    """The runs of a packed file of the benchmark, or of ``experiments.continuous``: its arms are agents, its tasks games."""
    if not path.name.startswith("continuous"):
        return read(path)[1]
    with lzma.open(path, "rt") as lines:
        runs = [json.loads(line) for line in lines]
    return [{**run, "agent": run["arm"], "game": run["task"], "protocol": {"steps": run["steps"]}} for run in runs]


def compare(
    folder: pathlib.Path, task: str, files: list[str], games: list[str], agents: tuple[str, str], name: str, page: str
) -> Compared:
    """
    :param games: if there are several, normalised scores are averaged over them, seed by seed
    :param agents: with EqR and without it
    :param name: see :func:`measure`
    """
    both: list[np.ndarray] = []
    runs = [rows_of(folder / file) for file in files]
    for agent in agents:
        found = {(r["seed"], r["game"]): r for rows in runs for r in rows if r["agent"] == agent and r["game"] in games}
        scores = pd.Series({run: measure(row, name) for run, row in found.items()}).unstack()[games]
        if scores.isna().any(axis=None):
            raise ValueError(f"{agent} must have {name!r} in every run of {', '.join(games)}, got {scores.to_dict()}.")
        if len(games) > 1:
            bounds = read(folder / files[0])[0].normalisation.scores
            scores = scores.apply(lambda column, bounds=bounds: normalised(column, bounds[column.name]))
        both.append(scores.mean(axis=1).to_numpy())
    numbers, (low, high) = re.findall(r"\d+", name), ttest_ind(*both, equal_var=False).confidence_interval()
    steps = int(numbers[-1]) if numbers else next(iter(found.values()))["protocol"]["steps"]
    spread = np.sqrt(np.mean([values.var(ddof=1) for values in both]))
    means = float(both[0].mean()), float(both[1].mean())
    return Compared(task.replace("EqR_", "EqR"), steps, means, (low, high), float(spread), min(map(len, both)), page)


def forest(found: list[Compared], path: pathlib.Path) -> None:
    """Draw the differences, in standard deviations over seeds."""
    with styled():
        figure, axis = plt.subplots(figsize=(WIDTH, 0.235 * len(found) + 1.2), layout="constrained")
        for i, one in enumerate(found):
            color, marker = VERDICTS[one.verdict]
            low, middle, high = (value / one.spread for value in (one.ends[0], one.difference, one.ends[1]))
            axis.plot([low, high], [i, i], color=color, lw=1.6)
            axis.plot(middle, i, marker, color=color, label=one.verdict)
        labels = [f"{one.task} ({one.seeds})" for one in found]
        axis.set_yticks(range(len(found)), labels, fontsize=8)
        axis.set(ylim=(len(found) - 0.4, -0.6))
        axis.set_xlabel("with EqR minus without,\nin standard deviations over seeds\n(beyond 2: logarithmic)", loc="right")
        axis.set_xscale("symlog", linthresh=2)
        axis.set_xticks([-2, 0, 2, 6, 20], ["−2", "0", "2", "6", "20"])
        axis.set_xlim(right=1.2 * axis.get_xlim()[1])
        axis.minorticks_off()
        axis.axvline(0, color=GREY, lw=0.7)
        axis.grid(axis="x")
        lines = {str(line.get_label()): line for line in axis.get_lines() if line.get_label() in VERDICTS}
        shown = [verdict for verdict in VERDICTS if verdict in lines]
        figure.legend([lines[verdict] for verdict in shown], shown, loc="outside upper right", ncols=1, handlelength=1)
        figure.savefig(path, dpi=DPI, metadata={"Software": None})
        plt.close(figure)


def differences(found: list[Compared]) -> str:
    """:return: Markdown, without spaces beside the bars"""
    lines = []
    for one in found:
        largest = max(map(abs, one.ends))
        digits = 0 if largest >= 20 else 1 if largest >= 1 else 2
        numbers = (*one.means, one.difference, *one.ends)
        cells = [f"{value:,.{digits}f}".replace("-", "−") for value in numbers]
        shown = [f"[{one.task}]({one.page})", f"{one.steps:,}", str(one.seeds), *cells[:2]]
        lines.append([*shown, f"{cells[2]} [{cells[3]}, {cells[4]}]", one.verdict])
    header = ["task", "steps", "seeds", "with EqR", "without", "difference, 95% CI", "verdict"]
    return re.sub(r" ?\| ?", "|", markdown(header, lines))


def claim(rows: list[Row], agents: tuple[str, str], games: list[str]) -> str:
    """
    The endpoint of ``experiments/settings/atari``: differences in standard deviations of 100 published runs of SPR, and their
    mean over games with its 95% interval (Student's t over games). Where a run was stopped, both agents' games in training
    from step 55,000 to 75,000 are compared. Beside it, in the same units, how far the paper's agent is above its SPR.

    :param agents: with EqR and without it
    :return: Markdown, a row per game that both have, the mean last
    """
    reference = load_reference()
    spreads = reference[reference["method"] == SPR].set_index("game")["sd"]
    published = reference.pivot(index="game", columns="method", values="mean")
    gains = (published[PAPER[0]] - published[PAPER[1]]) / spreads
    lines, found = [], []
    for game in games:
        of_game = [[row for row in rows if (row["agent"], row["game"]) == (agent, game)] for agent in agents]
        if not all(of_game):
            continue
        values = [np.array([measure(row, "score") for row in runs]) for runs in of_game]
        if is_stopped := bool(np.isnan(np.concatenate(values)).any()):
            values = [np.array([measure(row, "55000-75000") for row in runs]) for runs in of_game]
        means, spread = [float(one.mean()) for one in values], float(spreads[game.lower()])
        found.append((means[0] - means[1]) / spread)
        measured = "training" if is_stopped else "final"
        numbers = *means, spread, found[-1], float(gains[game.lower()])
        lines.append([game, measured, str(min(map(len, values))), *map(text, numbers)])
    half = student.ppf(0.975, len(found) - 1) * np.std(found, ddof=1) / np.sqrt(len(found)) if len(found) > 1 else np.nan
    mean = float(np.mean(found))
    paper = text(float(gains[[line[0].lower() for line in lines]].mean()))
    lines.append(["mean", "", "", "", "", "", f"{text(mean)} [{text(mean - half)}, {text(mean + half)}]", paper])
    return markdown(["game", "games", "seeds", "with EqR", "without", "SD of SPR", "difference in these", "paper's"], lines)


def published() -> str:
    """:return: Markdown: the last rows of the EqR paper's tables, computed from their scores of games, each agent once"""
    scores = load_reference().pivot(index="game", columns="method", values="mean")
    tables: dict[tuple[str, str, str], list[str]] = {}  # mean, median and superhuman games -> tables
    names: dict[tuple[str, str, str], str] = {}
    for method in sorted((name for name in scores if "[EqR Tab" in name), key=lambda name: (name[-2], name)):
        found = normalised(scores[method], (scores[RANDOM], scores[HUMAN])).dropna()
        numbers = f"{found.mean():.3f}", f"{found.median():.3f}", str((found > 1).sum())
        tables.setdefault(numbers, []).append(method[-2])
        names.setdefault(numbers, in_words(method))
    rows = [[names[numbers], ", ".join(tables[numbers]), *numbers] for numbers in sorted(tables, reverse=True)]
    return markdown(["agent", "tables", "mean", "median", "superhuman games"], rows)


def in_words(method: str) -> str:
    """:return: a name in the paper's tables without LaTeX: "EqR, $L_R + L_{GET}$ [EqR Tab4]" is "EqR, reward + GET" """
    name = method.partition(" [")[0].replace("$", "")
    return re.sub(r"\b(GL|SE|T)_2", r"\1(2)", name.replace("L_R", "reward").replace("L_{GET}", "GET"))


def main() -> None:
    """Parse the command line, print the table or draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=pathlib.Path, help="folders of a benchmark, or files of packed runs")
    parser.add_argument("--agents", nargs="+", help="with or without their algorithm (default: all)")
    parser.add_argument("--games", nargs="+", help="default: all")
    parser.add_argument("--seeds", nargs="+", type=int, help="default: all")
    usual, known = ["score", "end", "minutes"], ", ".join(MEASURES)
    parser.add_argument("--measures", nargs="+", default=usual, help=f"{known}, 0-20000, at475, train/aet_loss, ...")
    parser.add_argument("--baseline", help="the agent that the others are compared with")
    parser.add_argument("--ratio", action="store_true", help="compare by ratios, averaged over games")
    parser.add_argument("--each", action="store_true", help="print the seeds")
    drawn = "draw return, goals, aet_loss, ... along training"
    parser.add_argument("--figure", nargs=2, metavar=("SERIES", "FILE"), help=drawn)
    parser.add_argument("--labels", nargs="+", help="of the agents in the figure, in words")
    parser.add_argument("--axis-label", default="", help="of the figure's vertical axis")
    every = "a file: draw what EqR changes on every task of COMPARED, whose runs are in the given folder, and print a table"
    parser.add_argument("--differences", type=pathlib.Path, metavar="FILE", help=every)
    units = "print the difference of two agents in units of SPR's published standard deviation, game by game"
    parser.add_argument("--claim", nargs=2, metavar=("WITH", "WITHOUT"), help=units)
    parser.add_argument("--published", action="store_true", help="print the last rows of the paper's tables")
    args = parser.parse_args()
    if args.published:
        print(published())
        return
    if args.differences:
        compared = [compare(args.files[0], *arguments) for arguments in COMPARED]
        compared.sort(key=lambda one: -one.difference / one.spread)
        forest(compared, args.differences)
        means = [compare(args.files[0], *arguments) for arguments in MEANS]
        print(f"{differences(compared)}\n\nMeans of normalised scores:\n\n{differences(means)}")
        return
    rows = [row for file in args.files for row in read(file)[1]]
    full = {name: agent for agent in unique(rows, "agent") for name in (agent, agent.partition(":")[2])}
    wanted = [full.get(name, name) for name in args.agents or full]
    baseline = full.get(args.baseline, args.baseline)
    if unknown := {*wanted, baseline} - {*full.values(), None}:
        parser.error(f"no run of {', '.join(sorted(unknown))}; agents are {', '.join(sorted({*full.values()}))}")
    for key, chosen in (("agent", wanted), ("game", args.games), ("seed", args.seeds)):
        rows = [row for row in rows if chosen is None or row[key] in chosen]
    if not rows:
        parser.error(f"no run of these agents, games and seeds; agents are {', '.join(sorted(set(full.values())))}")
    if args.agents:
        rows.sort(key=lambda row: wanted.index(row["agent"]))
    if args.claim:
        print(claim(rows, (full[args.claim[0]], full[args.claim[1]]), args.games or unique(rows, "game")))
    elif args.figure:
        draw(rows, args.figure[0], pathlib.Path(args.figure[1]), args.labels, args.axis_label)
    else:
        print(table(rows, args.measures, baseline, args.ratio, args.each))


if __name__ == "__main__":
    main()
