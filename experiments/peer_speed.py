"""
The speed of this package's agent beside that of its peers, on random frames of Atari's size, on a CPU.

    python -m experiments.peer_speed env runs/peers  # a virtual environment for each peer, in a folder that git ignores
    python -m experiments.peer_speed run runs/peers --threads 1 --rounds 20 --json peer_speed.json

Every peer runs in a process of its own, with the Python of its environment (``experiments.peer_calls``). The processes start
one after the other and then take turns, so that slow periods of the machine affect all of them alike. A peer that fails, or
whose environment is missing, is in the table with the reason.
"""

import argparse
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import venv
from typing import Any

import numpy as np

from experiments import markdown
from experiments.peer_calls import PEERS

ROOT = pathlib.Path(__file__).parents[1]
BASELINE = "SB3 DQN"
TORCH = "torch==2.13.0"  # where the package index has no CPU build, pip downloads gigabytes for CUDA
JAX = ("jax==0.10.2", "jaxlib==0.10.2", "flax==0.12.8", "optax==0.2.8", "numpy==2.4.6", "gymnasium==1.4.0")
ENVIRONMENTS = {
    "sbx": ("sbx-rl==0.28.0", "stable_baselines3==2.9.2", TORCH, *JAX),
    "dopamine": ("dopamine-rl==4.1.2", "tensorflow==2.21.0", "gym==0.25.2", *JAX),
    "tianshou": ("tianshou==2.0.1", TORCH, "gymnasium==1.4.0", "numpy==2.4.6"),
    "pfrl": ("pfrl==0.4.0", "packaging==26.4", TORCH, "gym==0.26.2", "numpy==2.4.6"),  # packaging: not among its dependencies
    "torchrl": ("torchrl==0.14.1", "tensordict==0.14.3", TORCH, "numpy==2.4.6"),
}
Row = dict[str, Any]


def python_of(folder: pathlib.Path, environment: str | None) -> pathlib.Path:
    """:return: the interpreter of an environment; of this one if None"""
    return pathlib.Path(sys.executable) if environment is None else folder / environment / "bin" / "python"


def make_environments(folder: pathlib.Path, names: list[str]) -> None:
    """Create an environment for each name, or complete the one that is there."""
    for name in names:
        print(f"{folder / name}: {' '.join(ENVIRONMENTS[name])}", flush=True)
        venv.create(folder / name, with_pip=True)
        subprocess.run([python_of(folder, name), "-m", "pip", "install", "--quiet", *ENVIRONMENTS[name]], check=True)


class Worker:
    """A process that measures one peer, a round at a time."""

    def __init__(self, name: str, folder: pathlib.Path, n_threads: int):
        self.errors = tempfile.TemporaryFile("w+")
        variables = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(n_threads))
        variables |= {"PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": "", "JAX_PLATFORMS": "cpu"}
        if n_threads == 1:
            variables["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
        self.process = subprocess.Popen(
            [python_of(folder, PEERS[name].environment), "-m", "experiments.peer_calls", name, str(n_threads)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.errors, text=True, env={**os.environ, **variables},
        )  # fmt: skip

    def answer(self) -> Row:
        """
        :return: the next line of the process
        :raises RuntimeError: if it has ended, with the end of what it printed
        """
        assert self.process.stdout is not None
        if line := self.process.stdout.readline():
            return json.loads(line)
        self.process.wait()
        self.errors.seek(0)
        raise RuntimeError(([line for line in self.errors.read().splitlines() if line.strip()] or ["no output"])[-1][:200])

    def measure(self) -> Row:
        """:return: name of a call -> seconds of wall-clock time, of CPU time"""
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return self.answer()

    def stop(self) -> None:
        """End the process, if it has not ended."""
        self.process.kill()
        self.process.wait()


def measure(names: list[str], folder: pathlib.Path, n_threads: int, rounds: int) -> list[Row]:
    """:return: a row for each peer; those that could not be measured have a note only"""
    workers: dict[str, Worker] = {}
    found: dict[str, list[Row]] = {name: [] for name in names}
    about: dict[str, Row] = {}
    try:
        for name in names:
            try:
                workers[name] = Worker(name, folder, n_threads)
                about[name] = workers[name].answer()
            except FileNotFoundError:
                reason = f"python -m experiments.peer_speed env {folder} --only {PEERS[name].environment}"
                about[name] = {"note": f"no environment: {reason}"}
            except RuntimeError as error:
                about[name] = {"note": f"failed: {error}"}
                workers.pop(name).stop()
            print(f"{name}: {about[name]['note'] or 'ready'}", file=sys.stderr, flush=True)
        for _, (name, worker) in ((i, item) for i in range(rounds) for item in workers.items()):
            found[name].append(worker.measure())
    finally:
        for worker in workers.values():
            worker.stop()
    return [row_of(name, about[name], found[name], found.get(BASELINE, [])) for name in names]


def row_of(name: str, about: Row, rounds: list[Row], baseline: list[Row]) -> Row:
    """
    :return: medians over the rounds, and all rounds: seconds of wall-clock and of CPU time. ``times_DQN``: median of the
        ratios within a round, of the time of an update
    """

    def median(call: str, clock: int, factor: float) -> float | None:
        return float(np.median([one[call][clock] for one in rounds])) * factor if rounds and call in rounds[0] else None

    peer, step = PEERS[name], median("act", 0, 1.0)
    row = {
        "name": name,
        "version": about.get("version"),
        "n_step": peer.n_step,
        "forward": peer.forward,
        "trained": peer.trained,
    }
    row |= {"ms_update": median("update", 0, 1e3), "ms_cpu_update": median("update", 1, 1e3)}
    both = zip(rounds, baseline, strict=True) if baseline and row["ms_update"] is not None else ()
    ratios = [one["update"][0] / other["update"][0] for one, other in both]
    row |= {"times_DQN": float(np.median(ratios)) if ratios else None}
    row |= {"us_add": median("add", 0, 1e6), "us_sample": median("sample", 0, 1e6)}
    row |= {"bytes_per_transition": about.get("bytes_per_transition"), "steps_per_s": 1 / step if step else None}
    return {**row, "note": about["note"], "rounds": rounds}


def table(rows: list[Row]) -> str:
    """:return: Markdown, with the notes below"""

    def cell(value: Any) -> str:
        if isinstance(value, float):
            return f"{value:,.0f}" if abs(value) >= 99.95 else f"{value:#.3g}"
        return "-" if value is None else str(value)

    keys = [key for key in rows[0] if key not in ("note", "rounds")]
    lines = markdown([key.replace("_", " ") for key in keys], [[cell(row[key]) for key in keys] for row in rows])
    return "\n".join([lines, "", *(f"- {row['name']}: {row['note'].rstrip('.')}." for row in rows if row["note"])])


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Parse the given arguments, or else the command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.peer_speed", description=__doc__.strip().split("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    for command, known, text in (("env", ENVIRONMENTS, "create environments"), ("run", PEERS, "measure")):
        sub = commands.add_parser(command, help=text)
        sub.add_argument("folder", type=pathlib.Path, help="folder of the environments")
        sub.add_argument("--only", nargs="+", choices=list(known), default=list(known), metavar="NAME", help=", ".join(known))
        if command == "run":
            sub.add_argument("--threads", type=int, default=1, help="threads and cores of each peer")
            sub.add_argument("--rounds", type=int, default=20)
            sub.add_argument("--json", metavar="FILE", help="also write the rows to this file")
    args = parser.parse_args(arguments)
    for option in ("threads", "rounds") if args.command == "run" else ():
        if getattr(args, option) < 1:
            parser.error(f"--{option} must be an integer >= 1, got {getattr(args, option)}")
    return args


def main() -> None:
    """Create the environments, or measure, print and write."""
    args = parse()
    if args.command == "env":
        make_environments(args.folder, args.only)
        return
    from experiments.speed import surroundings
    from sb3_eqr.common.saving.files import atomic_write

    rows = measure(args.only, args.folder, args.threads, args.rounds)
    about = {**surroundings(args), "command": f"python -m experiments.peer_speed {' '.join(sys.argv[1:])}", "rows": rows}
    del about["tables"]
    print(f"{about['cpu']}, {args.threads} thread(s), {args.rounds} rounds\n\n{table(rows)}")
    if args.json:
        with atomic_write(args.json, "json") as file:
            file.write(json.dumps(about, indent=2).encode())


if __name__ == "__main__":
    main()
