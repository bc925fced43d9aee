"""examples/gpu_speed.py also runs completely without a GPU, which tests everything but its measurements."""

import json
import subprocess
import sys

import pytest

from benchmarks.workload import EQR_AGENTS
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
