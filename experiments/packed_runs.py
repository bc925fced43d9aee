"""
Finished runs of a benchmark as one compressed file, a line per run, and back. Packing adds to a file that exists. An unpacked
folder can be reported, and the command of the benchmark skips its runs.

    python -m experiments.packed_runs pack runs/minatar docs/results/minatar_30k.jsonl.xz
    python -m experiments.packed_runs unpack runs/minatar docs/results/minatar_30k.jsonl.xz
    sb3-eqr benchmark report runs/minatar
"""

import argparse
import json
import lzma
import pathlib
import re
from typing import Any

from sb3_eqr.benchmark.runs import PLAN, RESULT, write_json, write_plan
from sb3_eqr.benchmark.suites import choose, load_suite
from sb3_eqr.common.saving.files import atomic_write

PLANNED = "agent game seed suite protocol entry command".split()  # the fields of a run's plan, which its result repeats
ABSOLUTE = re.compile(r"(?<![\w./])/(?:[\w.@+-]+/)+(?=[\w.@+-])")  # the folders of an absolute path


def read(file: pathlib.Path) -> dict[str, dict[str, Any]]:
    """:return: folder of a run, relative to the benchmark's ``runs/`` -> its result"""
    with lzma.open(file, "rt", encoding="utf-8") as lines:
        rows = [json.loads(line) for line in lines]
    return {row["folder"]: row["result"] for row in rows}


def pack(folder: pathlib.Path, file: pathlib.Path) -> int:
    """
    Keeps only the last part of absolute paths, since the folders above it are those of one machine.

    :param folder: folder of a benchmark
    :param file: the file, which keeps rows of runs that are not in the folder
    :return: number of rows in the file
    """
    rows = read(file) if file.exists() else {}
    for path in folder.glob(f"runs/*/*/*/{RESULT}"):
        rows[str(path.parent.relative_to(folder / "runs"))] = json.loads(path.read_text(encoding="utf-8"))
    lines = [ABSOLUTE.sub("", json.dumps({"folder": name, "result": rows[name]})) + "\n" for name in sorted(rows)]
    with atomic_write(file, "file") as out:
        out.write(lzma.compress("".join(lines).encode()))
    return len(rows)


def unpack(folder: pathlib.Path, file: pathlib.Path) -> int:
    """
    Skips rows of runs that had not finished when they were packed.

    :return: number of runs in the file that the folder did not hold and holds now
    """
    rows = {name: row for name, row in read(file).items() if row.keys() >= set(PLANNED)}
    missing = [name for name in rows if not (folder / "runs" / name / RESULT).exists()]
    for name in missing:
        planned = {key: value for key, value in rows[name].items() if key in (*PLANNED, "defaults")}
        write_json(folder / "runs" / name / PLAN, planned)
        write_json(folder / "runs" / name / RESULT, rows[name])
    for name, game, steps in sorted({(row["suite"], row["game"], row["protocol"]["steps"]) for row in rows.values()}):
        write_plan(folder, choose(load_suite(name), [game], steps), [])
    return len(missing)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("direction", choices=["pack", "unpack"])
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("file", type=pathlib.Path)
    args = parser.parse_args()
    number = (pack if args.direction == "pack" else unpack)(args.folder, args.file)
    print(f"{number} runs")
