"""
Train several agents on an Atari game beside each other on one GPU, and keep the score of each game played in training.

    python -m experiments.atari_on_gpu rows.jsonl --settings defaults defaults_off --seeds 1 2 3 4 5
    python -m experiments.atari_on_gpu rows.jsonl --settings defaults defaults_off --table

One process per agent, whose updates are captured (``cuda_graph=True``). Runs end after ``--steps``, or once a file ``stop``
exists beside the rows, which are written every ten seconds. Rows of other runs in the file are kept, and finished runs are not
repeated.
"""

import argparse
import json
import multiprocessing
import pathlib
import queue
import time
from typing import Any

import numpy as np
import torch as th
import yaml
from scipy.stats import ttest_ind
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure

from experiments.probes import trunk
from sb3_eqr import EqRRainbow
from sb3_eqr.common.saving.files import atomic_write
from sb3_eqr.envs import make_atari100k_env

SETTINGS = pathlib.Path(__file__).parent / "settings" / "atari100k"
NOT_OF_THE_AGENT = ("policy", "n_timesteps", "frame_stack", "env_wrapper", "callback")
REPORT_EVERY = 500  # steps
WRITE_EVERY = 10.0  # seconds
PART = 20_000  # steps of a row of the table
SPAWN = multiprocessing.get_context("spawn")


class Report(BaseCallback):
    """Sends the state of a run with the raw score of each complete game, and stops the run once a file exists."""

    def __init__(self, row: dict[str, Any], rows: Any, stop: pathlib.Path):
        super().__init__()
        self._row, self._rows, self._stop = row, rows, stop
        self._games: list[tuple[int, float]] = []
        self._start = time.monotonic()

    def _on_step(self) -> bool:
        self._games += [
            (self.num_timesteps, float(info["episode"]["r"])) for info in self.locals["infos"] if "episode" in info
        ]
        if self.num_timesteps % REPORT_EVERY:
            return True
        self._send()
        return not self._stop.exists()

    def _on_training_end(self) -> None:
        self._send()

    def _send(self) -> None:
        captured = self.model._captured  # type: ignore[attr-defined]
        state = {"steps": self.num_timesteps, "updates": self.model._n_updates, "seconds": time.monotonic() - self._start}
        state["captured"] = captured is not None and captured._graph is not None
        self._rows.put({**self._row, **state, "games": list(self._games)})


def train(job: argparse.Namespace, settings: str, seed: int, rows: Any) -> None:
    """One process: one run."""
    th.set_num_threads(1)
    entry = yaml.safe_load((SETTINGS / f"{settings}.yml").read_text())["atari"]
    arguments = {key: value for key, value in entry.items() if key not in NOT_OF_THE_AGENT}
    arguments |= {"seed": seed, "device": job.device, "cuda_graph": job.device == "cuda"}
    model = EqRRainbow("CnnPolicy", make_atari100k_env(job.game, seed=seed), **arguments)
    model.set_logger(configure(None, []))
    device = th.cuda.get_device_name() if job.device == "cuda" else "cpu"
    row = {"game": job.game, "settings": settings, "seed": seed, "device": device, "torch": th.__version__}
    model.learn(job.steps, Report(row, rows, job.rows.parent / "stop"))
    if job.trunks:
        job.trunks.mkdir(parents=True, exist_ok=True)
        th.save(trunk(model).state_dict(), job.trunks / f"{settings}_{seed}.pt")


def key_of(row: dict[str, Any]) -> tuple[str, str, int]:
    """What distinguishes a run from others."""
    return row["game"], row["settings"], row["seed"]


def read(rows: pathlib.Path) -> dict[tuple[str, str, int], dict[str, Any]]:
    """The rows of a file by run; empty without a file."""
    lines = rows.read_text().splitlines() if rows.exists() else []
    return {key_of(row): row for row in map(json.loads, lines)}


def table(rows: list[dict[str, Any]], settings: list[str]) -> str:
    """
    A Markdown table of the mean score of the games that ended in each part of the training, per seed and averaged over seeds
    ± the standard error; then the difference of the first settings to the second, with its 95 % interval (Welch 1947,
    https://doi.org/10.1093/biomet/34.1-2.28). A part that a run did not reach the end of is left out.

    :param rows: rows of the file, one per run
    :param settings: at most two
    :return: the table
    """
    lines = [f"| steps | {' | '.join(settings)} | difference |", "|---" * (len(settings) + 2) + "|"]
    end = max(row["steps"] for row in rows)
    shared = min(row["steps"] for row in rows)  # every run reached this step: the last PART steps before it are a row, too
    for start, stop in sorted({*((n, n + PART) for n in range(0, end, PART)), (max(shared - PART, 0), shared)}):
        means = []
        for name in settings:
            scores = [
                [score for step, score in row["games"] if start < step <= stop]
                for row in rows
                if row["settings"] == name and row["steps"] >= stop
            ]
            means.append([float(np.mean(one)) for one in scores if one])
        if not any(means):
            continue
        cells = [
            f"{np.mean(m):.1f} ± {np.std(m, ddof=1) / len(m) ** 0.5:.1f} ({', '.join(f'{v:.1f}' for v in m)})"
            if len(m) > 1
            else ", ".join(f"{v:.1f}" for v in m)
            for m in means
        ]
        difference = ""
        if len(means) == 2 and min(map(len, means)) > 1:
            found = ttest_ind(*means, equal_var=False).confidence_interval()
            difference = f"{np.mean(means[0]) - np.mean(means[1]):.1f} [{found.low:.1f}, {found.high:.1f}]"
        lines.append(f"| {start:,} to {stop:,} | {' | '.join(cells)} | {difference} |")
    return "\n".join(lines)


def main() -> None:
    """Start the processes, and write their rows until all have ended; or print the table."""
    parser = argparse.ArgumentParser(description="Train several agents on an Atari game beside each other on one GPU.")
    parser.add_argument("rows", type=pathlib.Path, help="file of the results, one line per run")
    parser.add_argument("--game", default="Boxing", help="default: %(default)s")
    parser.add_argument("--settings", nargs="+", default=["defaults"], help="files of experiments/settings/atari100k")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="default: 0")
    parser.add_argument("--steps", type=int, default=100_000, help="default: %(default)s")
    parser.add_argument("--trunks", type=pathlib.Path, help="save the trunk of each agent here, for experiments.probes")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--table", action="store_true", help="print the table of a file of rows, run nothing")
    job = parser.parse_args()
    if job.table:
        print(table([row for row in read(job.rows).values() if row["game"] == job.game], job.settings))
        return
    rows, found = SPAWN.Queue(), read(job.rows)
    runs = [(settings, seed) for seed in job.seeds for settings in job.settings]
    runs = [run for run in runs if found.get((job.game, *run), {"steps": 0})["steps"] < job.steps]
    processes = [SPAWN.Process(target=train, args=(job, *run, rows)) for run in runs]
    for process in processes:
        process.start()
    is_last = False
    while not is_last:
        is_last = not any(process.is_alive() for process in processes)  # the rows that they left are read once more
        until = time.monotonic() + WRITE_EVERY
        while time.monotonic() < until:
            try:
                row = rows.get(timeout=1.0)
            except queue.Empty:
                if any(process.is_alive() for process in processes):
                    continue
                break
            found[key_of(row)] = max(row, found.get(key_of(row), row), key=lambda one: one["steps"])
        with atomic_write(job.rows, "jsonl") as file:
            file.write("".join(json.dumps(found[key]) + "\n" for key in sorted(found)).encode())


if __name__ == "__main__":
    main()
