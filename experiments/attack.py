"""
Attacks on the package: kills, wrong input, hostile files, a full disk. Prints a row per test.

    python -m experiments.attack                       # all, about a quarter of an hour
    python -m experiments.attack --only inputs files --kills 20
    python -m experiments.attack --out experiments/notes/attack.md
"""

import argparse
import pathlib
import random
import tempfile
import time
import warnings
from collections.abc import Callable
from functools import partial

import torch as th

from experiments.attacks import Finding, files, inputs, kills


def attacks(folder: pathlib.Path, n_kills: int, rng: random.Random) -> dict[str, list[Callable[[], Finding]]]:
    """
    :param folder: folder for temporary files
    :param n_kills: number of kills per test that kills
    :param rng: chooses the times of kills
    :return: tests by their name in ``--only``
    """
    return {
        "kills": [
            partial(kills.killed_runs, folder / "runs", n_kills, rng, at_once=1),
            partial(kills.killed_runs, folder / "runs", n_kills, rng, at_once=2),
            partial(kills.killed_benchmark, folder / "benchmark", n_kills, rng),
        ],
        "inputs": [inputs.wrong_arguments, inputs.without_asserts],
        "files": [partial(files.strangers_files, folder / "hostile"), partial(files.full_disk, folder / "disk")],
    }


def main() -> None:
    """Parse the command line, run the tests, write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = list(attacks(pathlib.Path(), 0, random.Random()))
    parser.add_argument("--only", nargs="+", choices=parts, default=parts, help="a subset of the parts (default: all)")
    parser.add_argument("--kills", type=int, default=100, help="number per test that kills (default: 100)")
    parser.add_argument("--seed", type=int, default=0, help="seed of these times (default: 0)")
    parser.add_argument("--out", type=pathlib.Path, help="a Markdown file for the table")
    args = parser.parse_args()
    th.set_num_threads(1)
    warnings.simplefilter("ignore")
    rows = ["| test | must | found | seconds |", "|---|---|---|---|"]
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        tests = attacks(pathlib.Path(folder), args.kills, random.Random(args.seed))
        for test in (one for part, those in tests.items() if part in args.only for one in those):
            began = time.monotonic()
            finding = test()
            failed += not finding.holds
            mark = "" if finding.holds else "**falls short:** "
            rows.append(f"| {finding.test} | {finding.must} | {mark}{finding.found} | {time.monotonic() - began:.0f} |")
            print(rows[-1], *finding.details, sep="\n  ", flush=True)
    if args.out is not None:
        command = f"python -m experiments.attack --kills {args.kills} --seed {args.seed}"
        args.out.write_text("\n".join(["# Attacks", "", f"```sh\n{command}\n```", "", *rows, ""]), encoding="utf-8")
    raise SystemExit(1 if failed else 0)


if __name__ == "__main__":
    main()
