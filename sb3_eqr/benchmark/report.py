"""The report of a benchmark: from folders of runs to a page, figures, tables and data files."""

import io
import pathlib
from collections.abc import Mapping, Sequence

import pandas as pd

from sb3_eqr.benchmark import sections
from sb3_eqr.benchmark.analysis import Analysis, aggregates_file, analyse, notes
from sb3_eqr.benchmark.comparison import compare
from sb3_eqr.benchmark.pictures import all_pictures
from sb3_eqr.benchmark.tables import Table, game_table, summary_table, to_html, to_latex, to_markdown
from sb3_eqr.common.files import atomic_write

REPS = 2_000  # bootstrap samples, as rliable's profiles
METHOD = (
    "Statistics are those of rliable (Agarwal et al. 2021). The interquartile mean (IQM) is the mean of the middle half of "
    "all runs and games, the optimality gap is how far scores stay below 1 on average. Intervals hold 95% of the samples of a "
    "bootstrap that draws the runs of each game anew and keeps the games. A run's score is the mean of its final evaluation."
)


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
    Write report.html, its figures as PNG, table.md, table.tex, scores.csv, scores.parquet and aggregates.csv.

    :param folders: of benchmarks, with suite.yml and runs/
    :param references: name -> JSON file with the runs of another method, game -> raw scores
    :param force: compare agents that ran under different protocols, and mark them, or that have not all games
    :param output: folder to write into; it is made if there is none
    :param agents: those to compare; none: all
    :param baseline: the agent that the others are held against; ``None``: the first stock one, or else the first
    :param command: that wrote it
    :param reps: bootstrap samples behind every interval
    :return: the path of report.html
    :raises ValueError: where nothing can be compared, or comparing would mislead; the message says what to do
    """
    comparison = compare(folders, references, force, agents, baseline)
    analysis = analyse(comparison, reps)
    table = game_table(comparison, analysis.aggregates, analysis.matrices, analysis.means)
    figures, files = sections.draw(all_pictures(analysis))
    files |= _data_files(comparison.episodes, aggregates_file(analysis))
    files |= _table_files(analysis, table)
    without = [] if "scores.parquet" in files else ["scores.parquet was left out: it needs pyarrow (pip install pyarrow)."]
    content = [
        (
            "Aggregates",
            sections.paragraph(METHOD) + to_html(summary_table(comparison, analysis.aggregates, analysis.matrices)),
        ),
        ("Figures", figures),
    ]
    if not analysis.differences.empty:
        content.append(("What the runs can show", sections.differences(analysis)))
    content.append(("Scores per game", to_html(table) + sections.bullets(sections.game_table_notes(analysis))))
    if comparison.human:
        content.append(("Published last rows", sections.published_rows()))
    content.append(("Settings", sections.settings(comparison, command)))
    title = f"Benchmark {comparison.suite}"
    page = sections.page(title, sections.lead(comparison), [*notes(analysis), *without], content)
    files["report.html"] = page.encode()  # last: who finds it finds the rest
    for note in notes(analysis):
        print(f"Note: {note}")
    for name, content_bytes in files.items():
        with atomic_write(pathlib.Path(output) / name, pathlib.Path(name).suffix[1:]) as file:
            file.write(content_bytes)
    return pathlib.Path(output) / "report.html"


def _data_files(episodes: pd.DataFrame, aggregates: pd.DataFrame) -> dict[str, bytes]:
    """
    :return: name -> content; without scores.parquet where pandas finds nothing to write it with
    """
    files = {
        "scores.csv": episodes.to_csv(index=False).encode(),
        "aggregates.csv": aggregates.to_csv(index=False).encode(),
    }
    buffer = io.BytesIO()
    try:
        episodes.to_parquet(buffer, index=False)
    except ImportError:
        return files
    return files | {"scores.parquet": buffer.getvalue()}


def _table_files(analysis: Analysis, table: Table) -> dict[str, bytes]:
    about = [*notes(analysis), *sections.game_table_notes(analysis)]
    markdown = "\n".join([to_markdown(table), *(f"- {note}" for note in about), ""])
    latex = "".join(f"% {note}\n" for note in about) + to_latex(table)
    return {"table.md": markdown.encode(), "table.tex": latex.encode()}
