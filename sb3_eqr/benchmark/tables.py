"""Tables of a report: strings in a pandas frame, whose first column names the rows, and a mask of those in bold."""

import html
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import ttest_ind

from sb3_eqr.benchmark.comparison import Comparison
from sb3_eqr.benchmark.reference import HUMAN, RANDOM
from sb3_eqr.benchmark.statistics import METRICS, MIN_RUNS, detectable_difference, games_above, iqm


class Table(NamedTuple):
    """
    :param cells: strings; a second line is a spread or an interval
    :param bold: mask of the cells in bold, of the same shape
    """

    cells: pd.DataFrame
    bold: pd.DataFrame

    def emphasised(self, before: str, after: str) -> pd.DataFrame:
        """:return: the cells, with ``before`` and ``after`` around the first line of bold ones"""
        return self.cells.mask(self.bold, self.cells.replace(r"^([^\n]+)", rf"{before}\1{after}", regex=True))


def make_table(header: Sequence[str], rows: Sequence[Sequence[str]], bold: Sequence[Sequence[bool]] | None = None) -> Table:
    """
    :param rows: rows as long as the header
    :param bold: mask of the cells in bold; default: none
    """
    cells = pd.DataFrame(rows, columns=list(header), dtype=str)
    is_bold = np.zeros(cells.shape, dtype=bool) if bold is None else np.array(bold, dtype=bool).reshape(cells.shape)
    return Table(cells, pd.DataFrame(is_bold, columns=cells.columns))


def to_html(table: Table, kind: str = "numbers") -> str:
    """
    :param kind: "numbers" or "words", for the alignment of the columns
    :return: a table in a box that scrolls horizontally
    """
    escaped = Table(table.cells.map(html.escape).rename(columns=html.escape), table.bold.rename(columns=html.escape))
    cells = escaped.emphasised("<b>", "</b>").replace(r"\n(.*)", r"<br><small>\1</small>", regex=True)
    content = cells.to_html(index=False, escape=False, border=0, classes=kind)
    return f'<div class="box" tabindex="0">{content}</div>'


def to_markdown(table: Table) -> str:
    """:return: a table in GitHub's Markdown"""
    cells = table.emphasised("**", "**").replace(r"\n", " ", regex=True).replace(r"\|", r"\\|", regex=True)
    align = ("left", *["right"] * (len(cells.columns) - 1))
    return cells.to_markdown(index=False, disable_numparse=True, colalign=align) + "\n"


def number(value: float, decimals: int | None = None) -> str:
    """
    :param value: a score
    :param decimals: number of decimals; ``None``: see :func:`decimals_of`
    :return: the number with thousands separators and a true minus sign, "–" for NaN
    """
    if np.isnan(value):
        return "–"
    text = f"{abs(value):,.{decimals_of(value) if decimals is None else decimals}f}"
    return text if value >= 0 or float(text.replace(",", "")) == 0 else f"−{text}"


def decimals_of(value: float) -> int:
    """:return: decimals for about three significant digits: 0 from 100, 1 from 10, 2 below"""
    return 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 2


def with_interval(value: float, low: float, high: float) -> str:
    """:return: "0.230", and below it "[0.120, 0.340]" where there is an interval"""
    return number(value, 3) + ("" if np.isnan(low) else f"\n[{number(low, 3)}, {number(high, 3)}]")


def distinct_best(matrices: Mapping[str, np.ndarray], differing: Mapping[str, str], reps: int) -> list[bool]:
    """
    :param matrices: agent -> (runs, games), normalised scores
    :param differing: agents to leave out, because their protocol differs
    :return: for each agent, whether it is the best and these runs distinguish it from all others
    """
    values = {agent: float(iqm(matrix)) for agent, matrix in matrices.items() if agent not in differing}
    best = max(values, key=lambda agent: values[agent], default="")
    is_distinct = (
        len(values) > 1
        and min(len(matrices[agent]) for agent in values) >= MIN_RUNS
        and all(
            values[best] - value > detectable_difference(matrices[best], matrices[agent], reps)
            for agent, value in values.items()
            if agent != best
        )
    )
    return [is_distinct and agent == best for agent in matrices]


def aggregate_means(means: pd.DataFrame, comparison: Comparison) -> pd.DataFrame:
    """
    Aggregates of methods with known game means only, computed as for a single run with these scores.

    :param means: rows games, columns methods, raw
    :return: columns label, metric, value; the metrics of ``METRICS`` and "above 1"
    """
    rows = []
    for method in means:
        values = np.array([[comparison.normalize(game, means.at[game, method]) for game in means.index]])  # (1, games)
        rows += [(method, name, float(function(values))) for name, function in METRICS.items()]
        rows.append((method, "above 1", games_above(values)))
    return pd.DataFrame(rows, columns=["label", "metric", "value"])


def game_table(
    comparison: Comparison, aggregates: pd.DataFrame, matrices: Mapping[str, np.ndarray], means: pd.DataFrame, reps: int
) -> Table:
    """
    A table as Tables 2 to 4 of the EqR paper: raw scores per game, aggregates of normalised scores below.

    :param aggregates: columns agent, metric, value, low, high
    :param matrices: agent -> (runs, games), normalised scores
    :param means: see :func:`~sb3_eqr.benchmark.analysis.published`
    """
    names = (RANDOM, HUMAN) if comparison.human else () if comparison.is_raw else ("score 0", "score 1")
    header = ["game", *names, *map(comparison.label, matrices), *(f"{method} †" for method in means)]
    by_game = comparison.scores.groupby(["agent", "game"])["raw"].agg(["mean", "std"])
    rows, bold = [], []
    for game in comparison.games:
        place = sorted(comparison.games).index(game)  # the game's column
        found = [by_game.loc[(agent, game)] for agent in matrices]
        texts = [
            number(mean) + ("" if np.isnan(spread) else f"\n± {number(spread, decimals_of(mean))}") for mean, spread in found
        ]
        bounds = [number(bound) for bound in comparison.bounds[game] if names]
        rows.append([game, *bounds, *texts, *(number(means.at[game, method]) for method in means)])
        of_game = {agent: matrix[:, [place]] for agent, matrix in matrices.items()}
        is_best = distinct_best(of_game, comparison.differing, reps)
        bold.append([False] * (1 + len(names)) + is_best + [False] * len(means.columns))
    of_means = aggregate_means(means, comparison).set_index(["label", "metric"])["value"]
    by_agent = aggregates.set_index(["agent", "metric"])
    last = {metric: [with_interval(*by_agent.loc[(agent, metric)]) for agent in matrices] for metric in comparison.metrics}
    last |= {} if comparison.is_raw else {comparison.above_one: [str(games_above(matrix)) for matrix in matrices.values()]}
    last["minutes per run"] = [number(comparison.minutes(agent)) for agent in matrices]
    for name, texts in last.items():
        ends = ("1", "0") if name == "optimality gap" else ("0", "1") if name in METRICS else ("", "")
        metric = "above 1" if name == comparison.above_one else name
        known = [of_means.get((method, metric), np.nan) for method in means]
        rows.append([name, *ends[: len(names)], *texts, *(number(value, 3 if name in METRICS else 0) for value in known)])
        is_best = distinct_best(matrices, comparison.differing, reps) if name == "IQM" else [False] * len(matrices)
        bold.append([False] * (1 + len(names)) + is_best + [False] * len(means.columns))
    return make_table(header, rows, bold)


def difference_table(comparison: Comparison) -> Table:
    """
    A row per game, a column per agent: the difference of its mean raw score from that of the first agent, and its 95%
    interval (Welch 1947, https://doi.org/10.1093/biomet/34.1-2.28), where both have several runs with different scores.
    """
    raw = {key: rows["raw"].to_numpy() for key, rows in comparison.scores.groupby(["agent", "game"])}
    first, *others = dict.fromkeys(comparison.scores["agent"])
    rows = []
    for game in comparison.games:
        cells = []
        for agent in others:
            pair = raw[agent, game], raw[first, game]
            text = number(pair[0].mean() - pair[1].mean())
            if min(map(len, pair)) > 1 and max(map(np.ptp, pair)) > 0:
                ends = ttest_ind(*pair, equal_var=False).confidence_interval()
                text += f"\n[{number(ends.low)}, {number(ends.high)}]"
            cells.append(text)
        rows.append([game, *cells])
    return make_table([f"minus {comparison.label(first)}", *(f"{comparison.label(agent)}" for agent in others)], rows)
