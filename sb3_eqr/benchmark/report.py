"""The report of a benchmark: a page, figures, tables and data files from folders of runs."""

import base64
import importlib.metadata
import json
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jinja2
import numpy as np
import pandas as pd

from sb3_eqr.benchmark.analysis import all_of, analyse, conclusion, notes, table_notes
from sb3_eqr.benchmark.comparison import Comparison, compare, counted
from sb3_eqr.benchmark.figures import all_figures, to_png, width_on_page
from sb3_eqr.benchmark.selection import flatten
from sb3_eqr.benchmark.statistics import REPS
from sb3_eqr.benchmark.tables import Table, difference_table, game_table, make_table, number, to_html, to_markdown
from sb3_eqr.common.saving.files import atomic_write


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
    Write report.html, its figures as PNG, table.md and aggregates.csv, with the other parameters of :func:`compare`.

    :param output: output folder, created if needed
    :param command: the command line of the report
    :param reps: bootstrap samples behind every interval
    :return: the path of report.html
    :raises ValueError: if nothing can be compared, or comparing would mislead; the message says what to do
    """
    comparison = compare(folders, references, force, agents, baseline)
    analysis = analyse(comparison, reps)
    figures = all_figures(analysis)
    pictures = {f"{figure.name}.png": to_png(figure) for figure in figures}
    games = game_table(comparison, analysis.matrices, analysis.means, analysis.aggregates, reps)
    differences = difference_table(comparison) if len(analysis.matrices) > 1 else None
    said, noted, about = conclusion(analysis), notes(analysis), table_notes(analysis)
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(pathlib.Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
    )
    page = environment.get_template("report.html.jinja").render(
        comparison=comparison,
        lead=_lead(comparison),
        conclusion=said,
        notes=noted,
        figures=[
            (figure, base64.b64encode(png).decode(), width_on_page(png))
            for figure, png in zip(figures, pictures.values(), strict=True)
        ],
        games=to_html(games),
        differences=to_html(differences) if differences else "",
        about_games=about,
        settings=_settings(comparison),
        commands=[*dict.fromkeys(result["command"] for result in comparison.results if result["command"]), command],
        versions=all_of(f"{name} {importlib.metadata.version(name)}" for name in ("rliable", "numpy", "scipy", "pandas")),
    )
    compared = to_markdown(differences) if differences else ""
    markdown = [to_markdown(games), *(f"- {sentence}" for sentence in [*said, *noted, *about]), "", compared]
    files = {**pictures, "table.md": "\n".join(markdown).encode()}
    files["aggregates.csv"] = analysis.aggregates.to_csv(index=False).encode()
    files["report.html"] = page.encode()  # last: where it exists, so do the others
    for sentence in [*said, *(f"Note: {note}" for note in noted)]:
        print(sentence)
    for name, content in files.items():
        with atomic_write(output / name, "") as file:
            file.write(content)
    return output / "report.html"


def _lead(comparison: Comparison) -> str:
    """:return: what was measured, in two sentences"""
    runs = sorted({len(comparison.runs(agent)) // len(comparison.games) for agent in comparison.agents})
    days = sorted(result["started"][:10] for result in comparison.results)
    per_game = counted(runs[0], "run") if len(runs) == 1 else f"{runs[0]} to {runs[-1]} runs"
    when = f"on {days[0]}" if days[0] == days[-1] else f"from {days[0]} to {days[-1]}"
    return (
        f"{counted(len(comparison.agents), 'agent')} on {counted(len(comparison.games), 'game')}, "
        f"{per_game} of each per game, started {when}. "
        f"{'Scores are raw' if comparison.is_raw else f'Normalised scores: {comparison.unit} ({comparison.source})'}."
        f"{' IQM: the mean of their middle half.' if comparison.is_averaged else ''}"
    )


def _settings(comparison: Comparison) -> list[tuple[str, str]]:
    """:return: headings and tables in HTML: settings and machine of each agent"""
    rows = []
    for agent in comparison.agents:
        runs = comparison.runs(agent)
        seeds, threads = all_of(sorted({run["seed"] for run in runs})), all_of(run["machine"]["threads"] for run in runs)
        device = all_of(f"{run['machine']['device']}, {run['machine'].get('platform', '')}" for run in runs)
        speed = number(float(np.mean([run["steps_per_second"] for run in runs])))
        restarted = str(sum(bool(run["resumed_at"]) or run["attempts"] > 1 for run in runs))
        rows.append([comparison.label(agent), seeds, device, threads, number(comparison.minutes(agent)), speed, restarted])
    header = ["agent", "seeds", "device", "threads", "minutes per run", "steps/s", "restarted runs"]
    tables = {
        "Hyperparameters": _side_by_side(comparison, lambda run: run["entry"]["hyperparameters"]),
        "Protocol": _side_by_side(comparison, lambda run: run["protocol"]),
        "Versions": _side_by_side(comparison, lambda run: run["versions"]),
    }
    words = [(heading, to_html(table, "words")) for heading, table in tables.items()]
    return [("Runs", to_html(make_table(header, rows))), *words]


def _side_by_side(comparison: Comparison, settings: Callable[[dict[str, Any]], dict[str, Any]]) -> Table:
    """:return: a row per setting, a column per agent; where runs of an agent differ, all values separated by "/" """

    def texts(run: dict[str, Any]) -> dict[str, str]:
        found = flatten(settings(run)).items()
        return {key: value if isinstance(value, str) else json.dumps(value) for key, value in found}

    labels = np.array([comparison.label(run["agent"]) for run in comparison.results])
    table = pd.DataFrame([texts(run) for run in comparison.results]).fillna("–")
    table = table.groupby(labels, sort=False).agg(lambda found: " / ".join(found.unique())).T
    if len(table.columns) > 1 and (table.nunique(axis=1) == 1).all():
        table = table.iloc[:, :1].set_axis(["all agents"], axis=1)
    return make_table(["setting", *table], [[key, *row] for key, row in zip(table.index, table.to_numpy(), strict=True)])
