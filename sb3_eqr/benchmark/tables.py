"""Tables of a report, once as rows of cells, then as HTML, Markdown and LaTeX."""

import dataclasses
import html
import re
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from sb3_eqr.benchmark.comparison import Comparison
from sb3_eqr.benchmark.reference import HUMAN, PUBLISHED_STEPS, RANDOM, PublishedMethod, published_means
from sb3_eqr.benchmark.statistics import METRICS, games_above

MARK = "‡"  # at the name of an agent with another protocol
LONG = 40  # letters; longer texts in a cell may be broken
LATEX = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "±": r"$\pm$",
    "−": "$-$",
    "–": "--",
    "†": r"\dag{}",
    "κ": r"$\kappa$",
    MARK: r"\ddag{}",
}


@dataclasses.dataclass(frozen=True)
class Cell:
    """
    :param text: what stands in it
    :param bold: the best of its row
    :param aside: a smaller addition, a spread or an interval
    """

    text: str
    bold: bool = False
    aside: str = ""


@dataclasses.dataclass(frozen=True)
class Table:
    """
    :param header: of the columns
    :param rows: as long as the header; the first cell names the row
    :param ruled: numbers of the rows that a line stands above
    :param align: of all columns but the first: "right" for numbers, "left" for words
    """

    header: list[str]
    rows: list[list[Cell]]
    ruled: tuple[int, ...] = ()
    align: str = "right"


def number(value: float, decimals: int | None = None) -> str:
    """
    :param value: a score
    :param decimals: as many as its size asks for if ``None``: about three significant digits
    :return: with thousands separated and a true minus sign, "–" for NaN
    """
    if np.isnan(value):
        return "–"
    places = decimals_of(value) if decimals is None else decimals
    text = f"{abs(value):,.{places}f}"
    return text if value >= 0 or float(text.replace(",", "")) == 0 else f"−{text}"


def decimals_of(value: float) -> int:
    """
    :return: decimals that give about three significant digits: 0 from 100 on, 1 from 10 on, 2 below
    """
    return 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 2


def interval(low: float, high: float) -> str:
    """
    :return: "[0.120, 0.340]", "" where there is none
    """
    return "" if np.isnan(low) else f"[{number(low, 3)}, {number(high, 3)}]"


def to_html(table: Table) -> str:
    """
    :return: a table in a box of its own that scrolls sideways
    """
    lines = [f'<div class="box" tabindex="0"><table class="{table.align}">', "<thead><tr>"]
    lines += [f'<th scope="col">{_breakable(text)}</th>' for text in table.header]
    lines.append("</tr></thead><tbody>")
    for place, row in enumerate(table.rows):
        lines.append('<tr class="ruled">' if place in table.ruled else "<tr>")
        lines.append(f'<th scope="row">{_breakable(row[0].text)}</th>')
        for cell in row[1:]:
            text = f"<b>{html.escape(cell.text)}</b>" if cell.bold else html.escape(cell.text)
            aside = f" <small>{html.escape(cell.aside)}</small>" if cell.aside else ""
            kind = ' class="long"' if len(cell.text) > LONG else ""
            lines.append(f"<td{kind}>{text}{aside}</td>")
        lines.append("</tr>")
    return "\n".join([*lines, "</tbody></table></div>"])


def _breakable(text: str) -> str:
    """:return: HTML in which the parts of an agent's name may stand on lines of their own, and a mark stays at its word"""
    return re.sub("([:.])", r"\1<wbr>", re.sub(" ([†‡])", "\N{NO-BREAK SPACE}\\1", html.escape(text)))


def to_markdown(table: Table) -> str:
    """
    :return: a table of GitHub's Markdown
    """

    def escaped(text: str) -> str:
        return text.replace("\\", "\\\\").replace("|", "\\|").replace("_", "\\_").replace("*", "\\*").replace("<", "&lt;")

    def shown(cell: Cell) -> str:
        text = f"**{escaped(cell.text)}**" if cell.bold else escaped(cell.text)
        return f"{text} {escaped(cell.aside)}".rstrip()

    lines = [" | ".join(map(escaped, table.header)), "---|" + "|".join(["---:"] * (len(table.header) - 1))]
    lines += [" | ".join(map(shown, row)) for row in table.rows]
    return "\n".join(f"| {line} |" if "---" not in line else f"|{line}|" for line in lines) + "\n"


def to_latex(table: Table) -> str:
    """
    :return: a ``tabular`` that needs no package
    """

    def escaped(text: str) -> str:
        return re.sub("|".join(map(re.escape, LATEX)), lambda found: LATEX[found[0]], text)

    def shown(cell: Cell) -> str:
        text = rf"\textbf{{{escaped(cell.text)}}}" if cell.bold else escaped(cell.text)
        return f"{text} {{\\scriptsize {escaped(cell.aside)}}}" if cell.aside else text

    lines = [
        "% Needs no package. Bold: the best of the runs of this benchmark and of those read from a file.",
        rf"\begin{{tabular}}{{l{table.align[0] * (len(table.header) - 1)}}}",
        r"\hline",
        " & ".join(map(escaped, table.header)) + r" \\",
        r"\hline",
    ]
    for place, row in enumerate(table.rows):
        lines += [r"\hline"] if place in table.ruled else []
        lines.append(" & ".join(map(shown, row)) + r" \\")
    return "\n".join([*lines, r"\hline", r"\end{tabular}"]) + "\n"


def label(comparison: Comparison, agent: str) -> str:
    """
    :return: the agent's name, marked where its protocol is not that of the others
    """
    return f"{agent} {MARK}" if agent in comparison.differing else agent


def superhuman(comparison: Comparison) -> str:
    """
    :return: what a normalised score above 1 is called
    """
    return "superhuman games" if comparison.human else "games above 1"


def aggregate_means(means: pd.DataFrame, comparison: Comparison) -> pd.DataFrame:
    """
    Aggregates of methods of which only the means of games are known: what rliable gives for a single run of such scores.

    :param means: rows games, columns methods, raw
    :return: columns label, metric, value; the metrics of ``METRICS`` and "above 1"
    """
    rows = []
    for method in means:
        values = np.array([[comparison.normalize(game, means.at[game, method]) for game in means.index]])  # (1, games)
        rows += [{"label": method, "metric": name, "value": function(values)} for name, function in METRICS.items()]
        rows.append({"label": method, "metric": "above 1", "value": games_above(values)})
    return pd.DataFrame(rows, columns=["label", "metric", "value"])


def published(comparison: Comparison, methods: Sequence[PublishedMethod]) -> pd.DataFrame:
    """
    :return: rows games, columns methods, raw mean scores; without columns where a run has other steps than theirs, the suite
        is not normalised by human scores, or a compared game has no published score
    """
    none = pd.DataFrame(index=comparison.games)
    if not comparison.human or comparison.steps != {PUBLISHED_STEPS}:
        return none
    means = published_means(methods, comparison.games)
    return means if len(means) == len(comparison.games) else none


def best(values: Mapping[str, float], comparison: Comparison) -> set[str]:
    """
    :param values: agent -> the higher the better
    :return: the agents to print in bold: none where all are alike, and none whose protocol is not that of the others
    """
    if len(set(values.values())) < 2:
        return set()
    top = max(values.values())
    return {agent for agent, value in values.items() if value == top and agent not in comparison.differing}


def game_table(
    comparison: Comparison, aggregates: pd.DataFrame, matrices: dict[str, np.ndarray], means: pd.DataFrame
) -> Table:
    """
    Tables 2 to 4 of the EqR paper: raw scores per game, aggregates of normalised ones below.

    :param aggregates: columns agent, metric, value, low, high
    :param matrices: agent -> (runs, games), normalised scores
    :param means: of :func:`published`
    """
    agents = list(matrices)
    names = (RANDOM, HUMAN) if comparison.human else ("score 0", "score 1")
    header = ["game", *names, *(label(comparison, agent) for agent in agents), *(f"{name} †" for name in means)]
    by_game = comparison.scores.groupby(["agent", "game"])["raw"].agg(["mean", "std"])
    rows = []
    for game in comparison.games:
        row = [Cell(game), *(Cell(number(bound)) for bound in comparison.bounds[game])]
        low, high = comparison.bounds[game]
        bold = best({agent: by_game.at[(agent, game), "mean"] * np.sign(high - low) for agent in agents}, comparison)
        for agent in agents:
            mean, spread = by_game.loc[(agent, game)]
            aside = "" if np.isnan(spread) else f"± {number(spread, decimals_of(mean))}"
            row.append(Cell(number(mean), bold=agent in bold, aside=aside))
        rows.append(row + [Cell(number(means.at[game, method])) for method in means])
    return Table(header, rows + _aggregate_rows(comparison, aggregates, matrices, means), ruled=(len(rows),))


def summary_table(comparison: Comparison, aggregates: pd.DataFrame, matrices: dict[str, np.ndarray]) -> Table:
    """
    The aggregates of the runs compared, a row per agent.

    :param aggregates: columns agent, metric, value, low, high
    :param matrices: agent -> (runs, games), normalised scores
    """
    columns = _aggregate_rows(comparison, aggregates, matrices, pd.DataFrame(index=comparison.games))
    header = ["agent", "runs", *(column[0].text for column in columns)]
    rows = [
        [Cell(label(comparison, agent)), Cell(str(len(matrix))), *(column[3 + place] for column in columns)]
        for place, (agent, matrix) in enumerate(matrices.items())
    ]
    return Table(header, rows)


def _aggregate_rows(
    comparison: Comparison, aggregates: pd.DataFrame, matrices: dict[str, np.ndarray], means: pd.DataFrame
) -> list[list[Cell]]:
    by_agent = aggregates.set_index(["agent", "metric"])
    of_means = aggregate_means(means, comparison).set_index(["label", "metric"])["value"]
    rows = []
    for metric in METRICS:
        bounds = (1.0, 0.0) if metric == "optimality gap" else (0.0, 1.0)
        values = {agent: by_agent.at[(agent, metric), "value"] for agent in matrices}
        bold = best({a: -value if metric == "optimality gap" else value for a, value in values.items()}, comparison)
        row = [Cell(metric), *(Cell(number(bound, 3)) for bound in bounds)]
        for agent, value in values.items():
            ends = interval(*by_agent.loc[(agent, metric), ["low", "high"]])
            row.append(Cell(number(value, 3), bold=agent in bold, aside=ends))
        rows.append(row + [Cell(number(of_means[method, metric], 3)) for method in means])
    counts = {agent: games_above(matrix) for agent, matrix in matrices.items()}
    row = [Cell(superhuman(comparison)), Cell("0"), Cell("–")]  # nothing is above itself
    bold = best(counts, comparison)
    row += [Cell(str(n), bold=agent in bold) for agent, n in counts.items()]
    row += [Cell(str(int(of_means[method, "above 1"]))) for method in means]
    return [*rows, row]
