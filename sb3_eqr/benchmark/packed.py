"""
Finished runs as one compressed file, ``NAME.jsonl.xz``: the suite in the first line, then a line per run. ``report`` reads
such a file like the folder of a benchmark.
"""

import json
import lzma
import pathlib
import re
import shlex
from typing import Any

from pydantic import FiniteFloat, NonNegativeInt, PositiveInt, TypeAdapter, ValidationError
from typing_extensions import TypedDict  # pydantic needs this one below Python 3.12

from sb3_eqr.benchmark.runs import RESULT, STOPPED, SUITE
from sb3_eqr.benchmark.suites import Evaluation, Suite, first_mistake, merge, read_suite
from sb3_eqr.common.saving.files import atomic_write

SUFFIX = ".jsonl.xz"
ABSOLUTE = re.compile(r"(?<![\w./])/(?:[\w.@+-]+/)+(?=[\w.@+-])")  # the folders of an absolute path in a text,
WHOLE = re.compile(r"(?<![\w./])/(?:[^/:]+/)+(?=[^/])")  # and of one that may have any letters, in a word of a command line


# What a report needs of a run; rows have more keys.
Episodes = list[FiniteFloat]  # their scores
Steps = list[NonNegativeInt]  # at which they ended, or their lengths
Evaluated = TypedDict("Evaluated", {"step": NonNegativeInt, "kind": str, "scores": Episodes, "lengths": Steps})
Trained = TypedDict("Trained", {"step": Steps, "score": Episodes, "length": Steps})
Protocol = TypedDict(
    "Protocol", {"env_id": str, "steps": PositiveInt, "preprocessing": dict[str, Any], "evaluation": Evaluation}
)
Entry = TypedDict("Entry", {"algo": str, "hyperparameters": dict[str, Any]})
Machine = TypedDict("Machine", {"device": str, "threads": PositiveInt})


class Row(TypedDict):
    """A run."""

    agent: str
    game: str
    seed: NonNegativeInt
    suite: str
    protocol: Protocol
    entry: Entry
    command: str
    started: str
    machine: Machine
    versions: dict[str, Any]
    attempts: NonNegativeInt
    wall_clock_s: FiniteFloat
    steps_per_second: FiniteFloat
    resumed_at: Steps
    evaluations: list[Evaluated]
    training: Trained
    losses: list[dict[str, float | None]]


ROW = TypeAdapter(Row)


def read(path: pathlib.Path) -> tuple[Suite, list[dict[str, Any]]]:
    """
    :param path: folder of a benchmark, or a file of :func:`pack`
    :return: its suite, and a row per run that has finished or was stopped; the latter have "stopped_at", a step
    :raises ValueError: if the path is neither, or holds a damaged file
    """
    if path.is_file():
        try:
            with lzma.open(path, "rt", encoding="utf-8") as lines:
                first, *others = lines
            return Suite.model_validate(json.loads(first)["suite"]), [_row(line) for line in others]
        except (lzma.LZMAError, EOFError, ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{path} must be a file of sb3-eqr benchmark pack, got another or a damaged one ({error})."
            ) from error
    if not (path / SUITE).is_file():
        found = "one without suite.yml" if path.is_dir() else "no folder"
        raise ValueError(f"{path} must be a folder of sb3-eqr benchmark run, got {found}. Run sb3-eqr benchmark run first.")
    files = {file.parent: file for name in (STOPPED, RESULT) for file in path.glob(f"runs/*/*/*/{name}")}
    rows = []
    for _, file in sorted(files.items()):
        try:
            rows.append(_row(file.read_text(encoding="utf-8")))
        except (ValueError, RecursionError) as error:
            raise ValueError(
                f"{file} must be the result of a run, got a damaged file ({error}). Remove it and run it again."
            ) from error
    return read_suite(path / SUITE), rows


def _row(text: str) -> dict[str, Any]:
    """:raises ValueError: with the first mistake, if the text is not the row of a run"""
    row = json.loads(text)
    try:
        ROW.validate_python(row, strict=True)
    except ValidationError as error:
        raise ValueError(first_mistake(error).removesuffix(".")) from error
    return row


def pack(folder: pathlib.Path, file: pathlib.Path) -> int:
    """
    Keeps only the last part of absolute paths, since the folders above it are those of one machine.

    :param folder: folder of a benchmark
    :param file: the file, to which runs are added; those that it has of the same agent, game and seed are replaced
    :return: number of runs in the file
    """
    if not file.name.endswith(SUFFIX):
        raise ValueError(f"FILE must end with {SUFFIX}, got {file}.")
    suite, rows = read(folder)
    if file.is_file():
        old, kept = read(file)
        suite, rows = merge(old, suite), [*kept, *rows]
    rows.sort(key=lambda row: "stopped_at" not in row)  # a finished run is not replaced by one that was stopped
    by_run = {(row["agent"], row["game"], row["seed"]): row for row in rows}
    lines = [{"suite": suite.model_dump()}, *(by_run[run] for run in sorted(by_run))]
    with atomic_write(file, "file") as out:
        texts = [json.dumps(_without_folders(line), ensure_ascii=False) + "\n" for line in lines]
        out.write(lzma.compress("".join(texts).encode()))
    return len(by_run)


def _without_folders(value: Any, key: str = "") -> Any:
    """The same plain data, with the last part only of absolute paths in its texts."""
    if isinstance(value, dict):
        return {name: _without_folders(item, name) for name, item in value.items()}
    if isinstance(value, list):
        return [_without_folders(item) for item in value]
    if not isinstance(value, str):
        return value
    if key == "command":
        return shlex.join(WHOLE.sub("", word) for word in shlex.split(value))
    return WHOLE.sub("", value) if value.startswith("/") else ABSOLUTE.sub("", value)
