"""The report of a benchmark: a page, figures, tables and data files from folders of runs."""

import importlib.metadata
import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from sb3_eqr.benchmark.analysis import Analysis, aggregates_file, all_of, analyse, conclusion, counted, notes, table_notes
from sb3_eqr.benchmark.comparison import Comparison, compare
from sb3_eqr.benchmark.figures import all_figures, to_png
from sb3_eqr.benchmark.selection import flatten
from sb3_eqr.benchmark.statistics import REPS
from sb3_eqr.benchmark.tables import (
    Table,
    difference_table,
    game_table,
    make_table,
    number,
    to_html,
    to_markdown,
)
from sb3_eqr.common.saving.files import atomic_write

TEMPLATE = pathlib.Path(__file__).with_name("report.html.jinja")


def write_report(
    folders: list[pathlib.Path],
    references: Mapping[str, pathlib.Path],
    force: bool,
    output: pathlib.Path,
    agents: Sequence[str] = (),
    baseline: str | None = None,
    command: str = "",
    reps: int = REPS,
) -> pathlib.Path:
    """
    Write report.html, its figures as PNG, table.md and aggregates.csv.

    :param folders: folders of benchmarks, with suite.yml and runs/, or files of ``sb3-eqr benchmark pack``
    :param references: name -> JSON file with the runs of another method, game -> raw scores
    :param force: also compare agents with different protocols, which are marked, or with missing games
    :param output: output folder, created if needed
    :param agents: the agents to compare; empty: all
    :param baseline: the agent that the others are compared with; ``None``: the first stock one, or else the first
    :param command: the command line of the report
    :param reps: bootstrap samples behind every interval
    :return: the path of report.html
    :raises ValueError: if nothing can be compared, or comparing would mislead; the message says what to do
    """
    comparison = compare(folders, references, force, agents, baseline)
    analysis = analyse(comparison, reps)
    figures = all_figures(analysis)
    table = game_table(comparison, analysis.aggregates, analysis.matrices, analysis.means, reps)
    files = {f"{figure.name}.png": to_png(figure) for figure in figures}
    files["table.md"] = _markdown(analysis, table)
    files["aggregates.csv"] = aggregates_file(analysis).to_csv(index=False).encode()
    before, shown = notes(analysis), conclusion(analysis)
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, keep_trailing_newline=True, undefined=jinja2.StrictUndefined
    )
    page = environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        title=f"Benchmark {comparison.suite}",
        style=Markup(TEMPLATE.with_name("report.css").read_text(encoding="utf-8")),
        lead=_lead(comparison),
        conclusion=shown,
        notes=before,
        figures=[(figure, files[f"{figure.name}.png"]) for figure in figures],
        human=comparison.human,
        raw=comparison.is_raw,
        games=_html(table),
        differences=_html(difference_table(comparison)) if len(analysis.matrices) > 1 else "",
        about_games=table_notes(analysis),
        settings=_settings(comparison),
        commands=_commands(comparison, command),
        versions=all_of(f"{name} {importlib.metadata.version(name)}" for name in ("rliable", "numpy", "scipy", "pandas")),
    )
    files["report.html"] = page.encode()  # last: where it exists, so do the others
    for sentence in shown:
        print(sentence)
    for note in before:
        print(f"Note: {note}")
    for name, content in files.items():
        with atomic_write(pathlib.Path(output) / name, pathlib.Path(name).suffix[1:]) as file:
            file.write(content)
    return pathlib.Path(output) / "report.html"


def _html(table: Table, kind: str = "numbers") -> Markup:
    return Markup(to_html(table, kind))  # to_html escapes the cells


def _lead(comparison: Comparison) -> str:
    """:return: what was measured, in two sentences"""
    runs = sorted({len(comparison.runs(agent)) // len(comparison.games) for agent in comparison.agents})
    days = sorted(result["started"][:10] for result in comparison.results)
    per_game = counted(runs[0], "run") if len(runs) == 1 else f"{runs[0]} to {runs[-1]} runs"
    when = f"on {days[0]}" if days[0] == days[-1] else f"from {days[0]} to {days[-1]}"
    return (
        f"{counted(len(comparison.agents), 'agent')} on {counted(len(comparison.games), 'game')}, "
        f"{per_game} of each per game, started {when}. "
        f"{'Scores are raw' if comparison.is_raw else f'Normalised scores: {comparison.unit} ({comparison.source})'}. "
        "IQM: the mean of their middle half."
    )


def _markdown(analysis: Analysis, table: Table) -> bytes:
    about = [*conclusion(analysis), *notes(analysis), *table_notes(analysis)]
    compared = to_markdown(difference_table(analysis.comparison)) if len(analysis.matrices) > 1 else ""
    return "\n".join([to_markdown(table), *(f"- {note}" for note in about), "", compared]).encode()


def _settings(comparison: Comparison) -> list[tuple[str, Markup]]:
    """:return: headings and tables: settings and machine of each agent"""
    rows = []
    for agent in comparison.agents:
        runs = comparison.runs(agent)
        seeds, threads = all_of(sorted({run["seed"] for run in runs})), all_of(run["machine"]["threads"] for run in runs)
        device = all_of(f"{run['machine']['device']}, {run['machine'].get('platform', '')}" for run in runs)
        speed = number(float(np.mean([run["steps_per_second"] for run in runs])))
        restarted = str(sum(bool(run["resumed_at"]) or run["attempts"] > 1 for run in runs))
        rows.append([comparison.label(agent), seeds, device, threads, number(comparison.minutes(agent)), speed, restarted])
    header = ["agent", "seeds", "device", "threads", "minutes per run", "steps/s", "restarted runs"]
    paths = {"Hyperparameters": ("entry", "hyperparameters"), "Protocol": ("protocol",), "Versions": ("versions",)}
    compared = [(heading, _html(_side_by_side(comparison, path), "words")) for heading, path in paths.items()]
    return [("Runs", _html(make_table(header, rows))), *compared]


def _side_by_side(comparison: Comparison, path: Sequence[str]) -> Table:
    """
    :return: a row per setting, a column per agent; where runs of an agent differ, all values separated by "/"
    """

    def of(run: dict[str, Any]) -> dict[str, str]:
        for key in path:
            run = run[key]
        return {key: value if isinstance(value, str) else json.dumps(value) for key, value in flatten(run).items()}

    by_agent = {comparison.label(agent): [of(run) for run in comparison.runs(agent)] for agent in comparison.agents}
    keys = dict.fromkeys(key for runs in by_agent.values() for run in runs for key in run)
    rows = [
        [key, *(" / ".join(dict.fromkeys(run.get(key, "–") for run in runs)) for runs in by_agent.values())] for key in keys
    ]
    if len(by_agent) > 1 and all(len(set(row[1:])) == 1 for row in rows):
        return make_table(["setting", "all agents"], [row[:2] for row in rows])
    return make_table(["setting", *by_agent], rows)


def _commands(comparison: Comparison, command: str) -> list[str]:
    """:return: the commands that reproduce the runs and the report"""
    return [*dict.fromkeys(result["command"] for result in comparison.results if result["command"]), command]
