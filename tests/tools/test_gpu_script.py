"""The runs that a GPU is lent for are complete without one."""

import subprocess
import sys

import pytest
import yaml

from sb3_eqr.benchmark.packed import read
from sb3_eqr.benchmark.suites import OWN_SUITES
from tests.tools.test_package import ROOT

SETTINGS = ROOT / "experiments" / "settings" / "atari"


def call(folder, *arguments):
    environment = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PATH": "", "SDL_VIDEODRIVER": "dummy"}
    command = [sys.executable, "-W", "ignore", "-m", "sb3_eqr.cli", *map(str, arguments)]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_several_atari_runs_are_stopped_packed_and_finished(tmp_path):
    """The command of docs/gpu.md, with shorter games and without a GPU."""
    suite = yaml.safe_load(OWN_SUITES.read_text())["atari100k"]
    suite |= {
        "steps": 330,
        "evaluation": suite["evaluation"] | {"n_envs": 2, "max_steps": 40, "curve": {"points": 1, "episodes": 1}},
    }
    (tmp_path / "suites.yml").write_text(yaml.safe_dump({"short": suite}))
    agents = [f"eqr_rainbow:{SETTINGS / name}.yml" for name in ("slow_target", "slow_target_eqr")]
    line = [*"benchmark run gpu --suite short --suite-file suites.yml --games Boxing --agents".split(), *agents]
    line += "--seeds 1 --device cpu --jobs 2 --episodes 2".split()
    assert "2 of 2 runs are left" in call(tmp_path, *line, "--stop-after", 2)
    assert "2 runs in rows.jsonl.xz" in call(tmp_path, "benchmark", "pack", "gpu", "rows.jsonl.xz")
    rows = read(tmp_path / "rows.jsonl.xz")[1]
    assert [row["agent"] for row in rows] == ["eqr_rainbow:slow_target", "eqr_rainbow:slow_target_eqr"]
    assert all(row["stopped_at"] < 330 and row["machine"]["updates"] == "eager" for row in rows)
    assert "All runs are finished" in call(tmp_path, *line)
    call(tmp_path, "benchmark", "pack", "gpu", "rows.jsonl.xz")
    for row in read(tmp_path / "rows.jsonl.xz")[1]:
        assert "stopped_at" not in row and row["resumed_exactly"] and len(row["evaluations"][-1]["scores"]) == 2
