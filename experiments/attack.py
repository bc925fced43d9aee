"""
Attacks on the package: kills, wrong and hostile input, NaN, damaged files, a full disk, threads. Prints a row per test.

    python -m experiments.attack                       # all, about a quarter of an hour
    python -m experiments.attack --only inputs files --kills 20
    python -m experiments.attack --out docs/results/attack.md
"""

import argparse
import pathlib
import random
import tempfile
import time
import warnings
from collections.abc import Callable

import torch as th

from experiments.attacks import Finding, command_lines, files, inputs, kills, numbers, resumes


def attacks(folder: pathlib.Path, n_kills: int, seed: int) -> dict[str, list[Callable[[], Finding]]]:
    """
    :param folder: folder for temporary files
    :param n_kills: number of kills per test that kills
    :param seed: seed of the times of kills and places of damage
    :return: tests by their name in ``--only``
    """
    rng = random.Random(seed)
    return {
        "kills": [
            lambda: kills.killed_runs(folder / "runs", n_kills, rng, at_once=1),
            lambda: kills.killed_runs(folder / "runs", n_kills, rng, at_once=2),
            lambda: kills.killed_benchmark(folder / "benchmark", n_kills, rng),
        ],
        "resumes": [lambda: resumes.resumed_runs(folder / "resumed")],
        "inputs": [
            inputs.wrong_arguments,
            inputs.without_asserts,
            lambda: command_lines.wrong_command_lines(folder / "lines"),
        ],
        "numbers": [lambda: numbers.not_a_number(folder / "numbers")],
        "files": [
            lambda: files.strangers_files(folder / "hostile"),
            lambda: files.damaged_files(folder / "damaged", rng),
            lambda: files.full_disk(folder / "disk"),
            lambda: files.shared_path(folder / "shared"),
        ],
    }


def main() -> None:
    """Parse the command line, run the tests, write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only", nargs="+", choices=list(attacks(pathlib.Path(), 0, 0)), help="a subset of the parts (default: all)"
    )
    parser.add_argument("--kills", type=int, default=100, help="number per test that kills (default: 100)")
    parser.add_argument("--seed", type=int, default=0, help="seed of times and places (default: 0)")
    parser.add_argument("--out", type=pathlib.Path, help="a Markdown file for the table")
    args = parser.parse_args()
    th.set_num_threads(1)
    warnings.simplefilter("ignore")
    rows = ["| test | must | found | seconds |", "|---|---|---|---|"]
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        for name, tests in attacks(pathlib.Path(folder), args.kills, args.seed).items():
            for test in tests if args.only is None or name in args.only else []:
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
