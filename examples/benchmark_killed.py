"""
Does a benchmark that is killed and resumed have the same scores as an undisturbed one? Tests SIGKILL at random times, then two
benchmarks at once in one folder.

    python examples/benchmark_killed.py FOLDER [--kills 10] [--seed 0]
"""

import argparse
import json
import pathlib
import random
import signal
import subprocess
import sys
import time

AGENTS = ["eqr_qrdqn", "eqr_rainbow", "qrdqn:stock"]
N_RUNS = 2 * len(AGENTS)


def start(folder: pathlib.Path) -> subprocess.Popen:
    """
    :return: the process of a benchmark on the suite smoke
    """
    line = [
        "benchmark",
        "run",
        str(folder),
        "--suite",
        "smoke",
        "--agents",
        *AGENTS,
        "--seeds",
        "2",
        "--checkpoint-every",
        "1",
    ]
    call = f"import sys; sys.argv = {['sb3-eqr', *line]!r}; from sb3_eqr.cli import main; main()"
    return subprocess.Popen([sys.executable, "-c", call], stdout=subprocess.DEVNULL, start_new_session=True)


def scores(folder: pathlib.Path) -> dict[str, tuple]:
    """
    :return: run -> all evaluations, all training scores
    """
    results = {str(path.parent.relative_to(folder)): json.loads(path.read_text()) for path in folder.rglob("result.json")}
    return {run: (result["evaluations"], result["training"]) for run, result in results.items()}


def main() -> None:
    """Run, kill, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0, help="seed of the times of kills")
    args = parser.parse_args()
    rng = random.Random(args.seed)

    begin = time.monotonic()
    assert start(args.folder / "undisturbed").wait() == 0
    seconds = time.monotonic() - begin
    expected = scores(args.folder / "undisturbed")
    print(f"undisturbed: {len(expected)} runs in {seconds:.0f} s", flush=True)

    killed = args.folder / "killed"
    for kill in range(1, args.kills + 1):
        wait = rng.uniform(0.1, 0.3) * seconds
        process = start(killed)
        try:
            process.wait(wait)
            print(f"{kill}: finished within {wait:.0f} s")
            continue
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
        checkpoints = sorted(int(path.name.split("-")[1]) for path in killed.rglob("checkpoint-*"))
        print(f"{kill}: killed after {wait:.0f} s; {len(scores(killed))} runs done, checkpoints at {checkpoints}", flush=True)
    assert start(killed).wait() == 0
    print(
        f"killed and restarted: {len(scores(killed))} of {N_RUNS} runs, scores equal: {scores(killed) == expected}", flush=True
    )

    shared = args.folder / "shared"
    processes = [start(shared), start(shared)]
    codes = [process.wait() for process in processes]
    print(f"two at once: exit {codes}, {len(scores(shared))} of {N_RUNS} runs, scores equal: {scores(shared) == expected}")


if __name__ == "__main__":
    main()
