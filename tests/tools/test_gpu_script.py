"""examples/gpu_speed.py also runs completely without a GPU, which tests everything but its measurements."""

import json
import queue
import subprocess
import sys
from types import SimpleNamespace

import pytest
import torch as th

from experiments import atari_on_gpu
from experiments.atari_on_gpu import table
from experiments.workload import EQR_AGENTS
from tests.tools.test_package import ROOT

NO_GPU = "a CUDA graph needs a GPU, and the device is 'cpu'"


def run_script(folder, *arguments):
    script = ROOT / "examples" / "gpu_speed.py"
    command = [sys.executable, "-W", "ignore", str(script), "--device", "cpu", "--smoke", "--json", "found.json", *arguments]
    environment = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PATH": ""}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout, json.loads((folder / "found.json").read_text())


@pytest.mark.slow
def test_updates_and_processes_are_compared(tmp_path):
    shown, found = run_script(tmp_path, "--parts", "check", "steps", "seeds")
    assert list(found) == ["parameters", *(f"updates_{name}" for name in EQR_AGENTS), "env_steps", "seeds"]
    assert all(table["title"] in shown for table in found.values())
    assert [row["name"] for row in found["parameters"]["rows"]] == list(EQR_AGENTS)
    for row in found["parameters"]["rows"]:  # on a CPU all three are eager, and eager updates are deterministic
        assert row["eager_again"] == row["captured"] == 0 and row["capture"] == NO_GPU and row["ok"]
    for name in EQR_AGENTS:
        assert [row["way"] for row in found[f"updates_{name}"]["rows"]] == ["floor", "eager", "captured"]
        assert NO_GPU in found[f"updates_{name}"]["notes"][-1]
    assert [row["way"] for row in found["env_steps"]["rows"]] == ["eager", "captured"]
    assert [row["processes"] for row in found["seeds"]["rows"]] == [1, 2]


@pytest.mark.slow
def test_a_run_is_resumed(tmp_path):
    (tmp_path / "found.json").write_text(json.dumps({"parameters": "of an earlier call"}))
    rows = []
    for minutes in ("0", "8", "8"):
        _, found = run_script(tmp_path, "--parts", "run", "--minutes", minutes)
        assert found["parameters"] == "of an earlier call"
        rows += found["run"]["rows"]
    first, second, third = rows
    assert first["steps"] == 1 and first["updates"] == 0
    assert second["steps"] == 60 and second["updates"] == 60 and second["seconds"] > first["seconds"]  # 30 steps, two each
    assert third == second  # the run was already finished


def test_scores_of_several_runs_are_compared_by_part_of_the_training():
    """By hand: means 1, 3 and 5, 7, so both standard errors are 1, and Welch's interval has 2 degrees of freedom."""
    games = {("a", 0): [(9_000, 0.0), (20_000, 2.0), (25_000, 9.0)], ("a", 1): [(10_000, 3.0)], ("b", 0): [(1, 5.0)]}
    games["b", 1] = [(19_999, 7.0)]
    rows = [{"settings": name, "seed": seed, "steps": 25_000, "games": found} for (name, seed), found in games.items()]
    lines = table(rows, ["a", "b"]).splitlines()
    assert lines[2] == "| 0 to 20,000 | 2.0 ± 1.0 (1.0, 3.0) | 6.0 ± 1.0 (5.0, 7.0) | -4.0 [-10.1, 2.1] |"  # t is 4.303
    # The game of b that ended at step 1 is too early for the last 20,000 steps.
    assert lines[3] == "| 5,000 to 25,000 | 3.3 ± 0.3 (3.7, 3.0) | 7.0 |  |"
    assert len(lines) == 4  # no run reached 40,000


def test_a_file_of_rows_is_added_to(tmp_path, monkeypatch):
    """Rows of other runs stay, finished runs are not repeated, and the table has the rows of its game only."""
    rows = [{"game": game, "settings": "a", "seed": 0, "steps": 50, "games": [[9, 2.0]]} for game in ("Boxing", "Breakout")]
    file = tmp_path / "rows.jsonl"
    file.write_text("".join(json.dumps(row) + "\n" for row in rows))
    started = []

    class Process:
        def __init__(self, target, args):
            job, settings, seed, queue = args
            started.append((settings, seed))
            queue.put({"game": job.game, "settings": settings, "seed": seed, "steps": 50, "games": []})

        def start(self):
            pass

        def is_alive(self):
            return False

    monkeypatch.setattr(atari_on_gpu, "SPAWN", SimpleNamespace(Process=Process, Queue=queue.Queue))
    command = ["atari_on_gpu", str(file), "--settings", "a", "b", "--seeds", "0", "--steps", "50"]
    monkeypatch.setattr(sys, "argv", command)
    atari_on_gpu.main()
    assert started == [("b", 0)]
    assert [json.loads(line)["game"] for line in file.read_text().splitlines()] == ["Boxing", "Boxing", "Breakout"]


@pytest.mark.slow
def test_several_runs_write_one_file(tmp_path):
    command = [
        sys.executable,
        "-W",
        "ignore",
        "-m",
        "experiments.atari_on_gpu",
        str(tmp_path / "rows.jsonl"),
        "--device",
        "cpu",
    ]
    command += ["--settings", "defaults", "defaults_off", "--steps", "2002", "--trunks", str(tmp_path / "trunks")]
    environment = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PATH": ""}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [json.loads(line) for line in (tmp_path / "rows.jsonl").read_text().splitlines()]
    assert [(row["settings"], row["steps"], row["updates"], len(row["games"])) for row in rows] == [
        ("defaults", 2002, 2, 1),
        ("defaults_off", 2002, 2, 1),
    ]
    trunks = [th.load(tmp_path / "trunks" / f"{row['settings']}_0.pt", weights_only=True) for row in rows]
    shapes = [{name: value.shape for name, value in trunk.items()} for trunk in trunks]
    assert shapes[0] == shapes[1]
