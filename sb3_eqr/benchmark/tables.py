"""Tables of a report: strings in a pandas frame, whose first column names the rows, and a mask of those in bold."""

import html
import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from markupsafe import Markup
from scipy.stats import ttest_ind

from sb3_eqr.benchmark.comparison import Comparison
from sb3_eqr.benchmark.reference import HUMAN, RANDOM
from sb3_eqr.benchmark.statistics import METRICS, distinct_best


class Table(NamedTuple):
    """The cells of a table, and which of them are in bold."""

    cells: pd.DataFrame  # strings; a second line is a spread or an interval
    bold: pd.DataFrame  # mask of the same shape

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


def to_html(table: Table, kind: str = "numbers") -> Markup:
    """
    :param kind: "numbers" or "words", for the alignment of the columns
    :return: a table in a box that scrolls horizontally
    """
    escaped = Table(table.cells.map(html.escape).rename(columns=html.escape), table.bold.rename(columns=html.escape))
    cells = escaped.emphasised("<b>", "</b>").replace(r"\n(.*)", r"<br><small>\1</small>", regex=True)
    content = cells.to_html(index=False, escape=False, border=0, classes=kind)
    return Markup(f'<div class="box" tabindex="0">{content}</div>')  # whose cells are escaped


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


def game_table(
    comparison: Comparison, matrices: Mapping[str, np.ndarray], means: pd.DataFrame, aggregates: pd.DataFrame, reps: int
) -> Table:
    """
    A table as Tables 2 to 4 of the EqR paper: raw scores per game, aggregates of normalised scores below. In bold are agents
    that these runs distinguish from all others with the same protocol.

    ``matrices``, ``means``, ``aggregates`` and ``reps`` are those of :class:`~sb3_eqr.benchmark.analysis.Analysis`.
    """
    names = (RANDOM, HUMAN) if comparison.human else () if comparison.is_raw else ("score 0", "score 1")
    header = ["game", *names, *map(comparison.label, matrices), *(f"{method} †" for method in means)]
    alike = {agent: matrix for agent, matrix in matrices.items() if agent not in comparison.differing}
    by_game = comparison.scores.groupby(["agent", "game"])["raw"].agg(["mean", "std"])
    rows, best = [], []
    for game in comparison.games:
        bounds = [number(bound) for bound in comparison.bounds[game] if names]
        texts = []
        for mean, spread in (by_game.loc[(agent, game)] for agent in matrices):
            texts.append(number(mean) + ("" if np.isnan(spread) else f"\n± {number(spread, decimals_of(mean))}"))
        rows.append([game, *bounds, *texts, *map(number, means.loc[game])])
        column = sorted(comparison.games).index(game)
        best.append(distinct_best({agent: matrix[:, [column]] for agent, matrix in alike.items()}, reps))
    found = aggregates.set_index(["from", "agent", "metric"])[["value", "low", "high"]]
    keys = [*(("runs", agent) for agent in matrices), *(("game means only", method) for method in means)]
    for metric in comparison.metrics:
        ends = ("1", "0") if metric == "optimality gap" else ("0", "1") if metric in METRICS else ("", "")
        decimals = 3 if metric in METRICS else 0
        texts = []
        for value, low, high in (found.loc[(*key, metric)] for key in keys):
            interval = "" if np.isnan(low) else f"\n[{number(low, decimals)}, {number(high, decimals)}]"
            texts.append(number(value, decimals) + interval)
        rows.append([metric, *ends[: len(names)], *texts])
        best.append(distinct_best(alike, reps) if metric == "IQM" else None)
    times = [number(comparison.minutes(agent)) for agent in matrices]
    rows.append(["minutes per run", *[""] * len(names), *times, *["–"] * len(means.columns)])
    columns = ["", *[""] * len(names), *matrices, *[""] * len(means.columns)]
    return make_table(header, rows, [[agent == name for agent in columns] for name in [*best, None]])


def differences_per_game(comparison: Comparison) -> dict[tuple[str, str], tuple[float, float, float]]:
    """
    (agent, game) -> the difference of its mean raw score from that of the first agent, and the ends of its 95% interval
    (Welch 1947, https://doi.org/10.1093/biomet/34.1-2.28): NaN unless both have several runs with different scores.
    """
    raw = {key: rows["raw"].to_numpy() for key, rows in comparison.scores.groupby(["agent", "game"])}
    first, *others = dict.fromkeys(comparison.scores["agent"])
    found = {}
    for agent, game in itertools.product(others, comparison.games):
        pair, ends = (raw[agent, game], raw[first, game]), (np.nan, np.nan)
        if min(map(len, pair)) > 1 and max(map(np.ptp, pair)) > 0:
            ends = tuple(ttest_ind(*pair, equal_var=False).confidence_interval())
        found[agent, game] = pair[0].mean() - pair[1].mean(), *ends
    return found


def difference_table(comparison: Comparison) -> Table:
    """A row per game, a column per agent: see :func:`differences_per_game`."""
    first, *others = dict.fromkeys(comparison.scores["agent"])
    found = differences_per_game(comparison)

    def cell(difference: float, low: float, high: float) -> str:
        return number(difference) + ("" if np.isnan(low) else f"\n[{number(low)}, {number(high)}]")

    rows = [[game, *(cell(*found[agent, game]) for agent in others)] for game in comparison.games]
    return make_table([f"minus {comparison.label(first)}", *map(comparison.label, others)], rows)
