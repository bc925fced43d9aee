"""The sections of report.html."""

import base64
import html
import importlib.metadata
import json
import pathlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from sb3_eqr.benchmark.analysis import Analysis, counted, difference_in_words
from sb3_eqr.benchmark.comparison import Comparison
from sb3_eqr.benchmark.figures import Picture, to_png
from sb3_eqr.benchmark.reference import SHOWN, disagreements, last_rows, load_reference
from sb3_eqr.benchmark.selection import flatten
from sb3_eqr.benchmark.tables import Cell, Table, label, number, superhuman, to_html

# Standard deviation of an IQM over 26 games by the number of seeds, from the 100 runs of SPR that rliable's authors published
SPR_SPREAD = {1: 0.058, 5: 0.026, 10: 0.018}


def page(title: str, lead: str, notes: Sequence[str], sections: Sequence[tuple[str, str]]) -> str:
    """
    :param title: plain text
    :param lead: plain text, what was measured
    :param notes: plain text, what to know before any number
    :param sections: heading (plain text), content (HTML)
    :return: the whole page, which needs nothing from elsewhere
    """
    style = pathlib.Path(__file__).with_name("report.css").read_text(encoding="utf-8")
    links = [f'<a href="#s{place}">{html.escape(heading)}</a>' for place, (heading, _) in enumerate(sections)]
    parts = [
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{html.escape(title)}</title>",
        f"<style>\n{style}</style></head><body><main>",
        f'<h1>{html.escape(title)}</h1><p class="lead">{html.escape(lead)}</p>',
        f'<div class="notes"><p>Before the numbers</p>{bullets(notes)}</div>' if notes else "",
        f"<nav>{' '.join(links)}</nav>",
    ]
    parts += [f'<h2 id="s{place}">{html.escape(heading)}</h2>\n{text}' for place, (heading, text) in enumerate(sections)]
    return "\n".join([*parts, "</main></body></html>", ""])


def bullets(texts: Iterable[str]) -> str:
    """
    :param texts: plain text
    """
    return f"<ul>{''.join(f'<li>{html.escape(text)}</li>' for text in texts)}</ul>"


def paragraph(text: str) -> str:
    """
    :param text: plain text
    """
    return f"<p>{html.escape(text)}</p>"


def lead(comparison: Comparison) -> str:
    """
    :return: what was measured, in two sentences
    """
    runs = sorted({comparison.runs(agent) for agent in comparison.agents})
    days = sorted(result["started"][:10] for result in comparison.results)
    per_game = counted(runs[0], "run") if len(runs) == 1 else f"{runs[0]} to {runs[-1]} runs"
    when = f"on {days[0]}" if days[0] == days[-1] else f"from {days[0]} to {days[-1]}"
    return (
        f"{counted(len(comparison.agents), 'agent')} on {counted(len(comparison.games), 'game')}, "
        f"{per_game} of each per game, started {when}. Normalised scores: {comparison.unit} ({comparison.source})."
    )


def figure(picture: Picture, wide: bytes, narrow: bytes) -> str:
    """
    :param picture: what is shown
    :param wide: PNG for screens and paper
    :param narrow: PNG for phones
    """

    def embedded(image: bytes) -> str:
        return f"data:image/png;base64,{base64.b64encode(image).decode()}"

    alt = html.escape(f"{picture.title}. {picture.caption}")
    width = int.from_bytes(wide[16:20], "big") // 2  # of the PNG's header; two pixels of the image to one of CSS
    return (
        f"<h3>{html.escape(picture.title)}</h3>"
        f'<figure><picture><source media="(max-width: 700px)" srcset="{embedded(narrow)}">'
        f'<img src="{embedded(wide)}" width="{width}" alt="{alt}"></picture>'
        f"<figcaption>{html.escape(picture.caption)}</figcaption></figure>"
    )


def draw(pictures: Iterable[Picture]) -> tuple[str, dict[str, bytes]]:
    """
    :return: the section with all figures, and their files by name
    """
    parts, files = [], {}
    for picture in pictures:
        wide, narrow = to_png(picture.draw(2)), to_png(picture.draw(1))
        parts.append(figure(picture, wide, narrow))
        files[f"{picture.name}.png"] = wide
    return "\n".join(parts), files


def differences(analysis: Analysis) -> str:
    """How large a difference the runs can show, and which of those found are that large."""
    rows = analysis.differences.to_dict("records")
    against = [analysis.baseline, *([analysis.best] if analysis.best != analysis.baseline else [])]
    text = (
        f"Differences of the IQM, each agent against {label(analysis.comparison, against[0])}, the baseline"
        + (f", and against {label(analysis.comparison, against[1])}, the best. " if len(against) > 1 else ". ")
        + "A difference counts if it is larger than what the runs can show: the half-width of a 95% interval around no "
        "difference, by the spread that the stratified bootstrap finds, times n / (n - 1) for n runs, and Student's quantile. "
        "Of twenty pairs that are alike, about one passes by "
        "chance; more where one of the two was chosen for its score, as the best is."
    )
    parts = [paragraph(text), bullets(difference_in_words(row, analysis.comparison) for row in rows)]
    if analysis.comparison.human:
        told = ", ".join(f"{spread:.3f} with {counted(seeds, 'seed')}" for seeds, spread in SPR_SPREAD.items())
        parts.append(
            paragraph(
                "As a measure of what to expect: the standard deviation of the IQM of SPR over all 26 games is "
                f"{told} (derived from the 100 runs of SPR that the authors of rliable published)."
            )
        )
    return "\n".join(parts)


def game_table_notes(analysis: Analysis) -> list[str]:
    """
    :return: what the table of games shows, plain text
    """
    comparison = analysis.comparison
    notes = ["Raw scores: mean over runs ± standard deviation over runs. Bold: the best of the runs compared here."]
    notes.append(
        "Below: aggregates of normalised scores over all runs and games, with 95% intervals; "
        f"{superhuman(comparison)} are those with a mean above 1."
    )
    if len(analysis.means.columns):
        sources = load_reference().drop_duplicates("method").set_index("method")["source"]
        notes += [f"† {m.label}: 100K steps, game means only ({m.n_runs}), no interval. {sources[m.method]}." for m in SHOWN]
    notes += [f"‡ {agent}: another protocol: {what}." for agent, what in comparison.differing.items()]
    return notes


def published_rows() -> str:
    """The last rows of the EqR paper's Tables 2 to 4, from the bundled scores."""
    rows = last_rows()
    cells = [
        [Cell(text) for text in (row["method"], str(row["table"]), f"{row['mean']:.3f}", f"{row['median']:.3f}")]
        + [Cell(str(row["superhuman"]))]
        for row in rows.to_dict("records")
    ]
    table = Table(["method", "table", "mean", "median", "superhuman games"], cells)
    text = (
        "The last rows of Tables 2, 3 and 4 of the EqR paper, computed from the bundled scores of its 26 games. "
        "They agree with what the paper prints, but for two:"
    )
    return paragraph(text) + bullets(disagreements(rows)) + to_html(table)


def settings(comparison: Comparison, command: str) -> str:
    """
    What each agent ran with, where, and the commands to repeat it.

    :param command: of this report
    """
    by_agent = {a: [r for r in comparison.results if r["agent"] == a] for a in comparison.agents}
    runs = Table(
        ["agent", "seeds", "device", "threads", "minutes per run", "steps/s", "restarted runs"],
        [_run_row(label(comparison, agent), results) for agent, results in by_agent.items()],
    )
    names = [label(comparison, agent) for agent in by_agent]
    parts = ["<h3>Runs</h3>", to_html(runs)]
    for heading, path in (
        ("Hyperparameters", ("entry", "hyperparameters")),
        ("Protocol", ("protocol",)),
        ("Versions", ("versions",)),
    ):
        values = [[_at(result, path) for result in results] for results in by_agent.values()]
        parts += [f"<h3>{heading}</h3>", to_html(_side_by_side(names, values))]
        if heading == "Hyperparameters":
            parts.append(
                paragraph("Where games differ, all values are named; – is an algorithm's default, or no argument of it.")
            )
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("rliable", "numpy", "scipy", "pandas"))
    commands = dict.fromkeys(result["command"] for result in comparison.results)
    whole = [text for text in commands if "--suite" in text] or list(commands)  # not those that only went on
    lines = html.escape("\n".join([*whole, command]))
    parts += ["<h3>To repeat it</h3>", f'<div class="box" tabindex="0"><pre>{lines}</pre></div>']
    parts.append(paragraph(f"suite.yml and run.json in the folder hold what the files named there said. Report: {versions}."))
    return "\n".join(parts)


def _at(result: dict[str, Any], path: Sequence[str]) -> dict[str, Any]:
    for key in path:
        result = result[key]
    return result


def _run_row(name: str, results: list[dict[str, Any]]) -> list[Cell]:
    def all_of(values: Iterable[Any]) -> str:
        return ", ".join(dict.fromkeys(map(str, values)))

    minutes = float(np.mean([result["wall_clock_s"] for result in results])) / 60
    return [
        Cell(name),
        Cell(all_of(sorted({result["seed"] for result in results}))),
        Cell(all_of(f"{result['machine']['device']}, {result['machine'].get('platform', '')}" for result in results)),
        Cell(all_of(result["machine"]["threads"] for result in results)),
        Cell(number(minutes)),
        Cell(number(float(np.mean([result["steps_per_second"] for result in results])))),
        Cell(str(sum(bool(result["resumed_at"]) or result["attempts"] > 1 for result in results))),
    ]


def _side_by_side(names: Sequence[str], values: Sequence[Sequence[dict[str, Any]]]) -> Table:
    """
    :param values: per agent, per run
    :return: a row per setting, a column per agent; the values of different runs beside each other
    """
    flat = [[flatten(run) for run in runs] for runs in values]
    keys = dict.fromkeys(key for runs in flat for run in runs for key in run)
    rows = []
    for key in keys:
        row = [Cell(key)]
        for runs in flat:
            texts = dict.fromkeys(_plain(run[key]) if key in run else "–" for run in runs)
            row.append(Cell(" / ".join(texts)))
        rows.append(row)
    alike = len(names) > 1 and all(len({cell.text for cell in row[1:]}) == 1 for row in rows)
    if alike:
        return Table(["", "all agents"], [row[:2] for row in rows], align="left")
    return Table(["", *names], rows, align="left")


def _plain(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
