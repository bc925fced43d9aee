"""examples/gpu_speed.py: it runs from start to end without a GPU, so that on one it only has to measure."""

import contextlib
import json
import pathlib
import runpy
import subprocess
import sys
import types

import pytest
import torch as th

from sb3_eqr.benchmark.speed.workload import EQR_AGENTS, fill, make_agent, train
from tests.test_fast import as_on_a_gpu, fake_cuda  # noqa: F401

ROOT = pathlib.Path(__file__).parent.parent
SCRIPT = ROOT / "examples" / "gpu_speed.py"


def run_script(folder, *arguments):
    command = [sys.executable, "-W", "ignore", str(SCRIPT), "--device", "cpu", "--smoke", "--json", "found.json", *arguments]
    environment = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PATH": ""}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout, json.loads((folder / "found.json").read_text())


def rows_of(part, name):
    return part["tables"][name]["rows"]


@pytest.mark.slow
def test_every_part_runs(tmp_path):
    shown, found = run_script(tmp_path, "--parts", "check", "steps", "seeds")
    assert list(found) == ["check", "steps", "seeds"]
    for part in found.values():
        assert {"gpu", "driver", "cuda", "torch", "cpus", "command", "date"} <= part["about"].keys()
        assert part["error"] is None and part["about"]["smoke"]
        assert all(table["title"] in shown for table in part["tables"].values())
    check, steps = found["check"], found["steps"]
    assert [row["captured"] for row in rows_of(check, "parameters")] == [0] * 4  # on a CPU it is the same update
    assert len(rows_of(check, "bf16")) == 2 * 4 and all(row["ok"] for row in rows_of(check, "bf16"))
    assert {row["waits"] for row in rows_of(check, "waits")} == {"not checked: no graph on cpu"}
    assert all(row["product"] > 0 and row["convolution"] > 0 for row in rows_of(steps, "rates"))
    for name in EQR_AGENTS:
        ms = {row["way"]: row["ms"] for row in rows_of(steps, f"updates_{name}")}
        assert ms.pop("ceiling: launches") is None and min(ms.values()) > 0
        assert {"eager", "captured", "captured + bf16", "captured + overlap", "its convolutions, eager"} < ms.keys()
    ways = [row["way"] for row in rows_of(steps, "env_steps")]
    assert ways == ["Pong alone", "eager", "captured", "captured + bf16", "captured + overlap"]
    assert [row["processes"] for row in rows_of(found["seeds"], "seeds")] == [1, 2]


@pytest.mark.slow
def test_a_run_is_gone_on_with(tmp_path):
    (tmp_path / "found.json").write_text(json.dumps({"check": "what was there"}))
    rows = []
    for minutes in ("0", "8", "8"):
        _, found = run_script(tmp_path, "--parts", "run", "bbf", "--minutes", minutes)
        assert list(found) == ["check", "run", "bbf"]
        rows.append([rows_of(found[name], name)[0] for name in ("run", "bbf")])
    for first, second, third in zip(*rows, strict=True):
        assert (first["steps"], first["calls"], first["ok"]) == (1, 1, None)
        assert (second["steps"], second["calls"]) == (60, 2) and second["seconds"] > first["seconds"]
        assert second["projected_seconds"] == second["seconds"] and second["ok"]
        assert third == second  # done
    assert rows[1][0]["updates"] == 60 and rows[1][1]["updates"] == 20  # two per step of learning


@pytest.mark.slow
def test_a_part_that_fails_is_told_and_the_others_are_measured(tmp_path):
    (tmp_path / "gpu_runs").mkdir()
    (tmp_path / "gpu_runs" / "run_smoke.zip").write_bytes(b"not a model")
    with pytest.raises(AssertionError, match="expected a whole file"):
        run_script(tmp_path, "--parts", "run", "bbf")
    found = json.loads((tmp_path / "found.json").read_text())
    assert "expected a whole file" in found["run"]["error"] and found["bbf"]["error"] is None


def test_two_updates_are_watched(monkeypatch, fake_cuda):  # noqa: F811
    """As on a GPU, whose calls are replaced: both updates are done, the watch is put back, what it finds is told."""
    script, modes = runpy.run_path(str(SCRIPT)), []
    monkeypatch.setattr(th.cuda, "set_sync_debug_mode", modes.append)
    kwargs = {"batch_size": 4, "prediction_depth": 1, "buffer_size": 60}
    model = as_on_a_gpu(make_agent(EQR_AGENTS[0], fast="overlap", **kwargs), monkeypatch)
    fill(model.replay_buffer, 50)
    assert script["two_updates"](model, "cpu")["waits"] == "not checked: no graph on cpu"
    for _ in range(3):
        train(model)
    assert script["has_graph"](model)
    found = script["two_updates"](model, "cpu")
    assert (found["waits"], found["ok"], model._n_updates) == ("no", True, 8) and modes == ["error", "default"]
    assert 0 < found["host_ms"] <= found["done_ms"]

    def waits(arrays):
        raise RuntimeError("called a synchronizing CUDA operation\nand more")

    monkeypatch.setattr(model, "_run_captured", waits)
    found = script["two_updates"](model, "cpu")
    assert (found["waits"], found["ok"]) == ("yes: called a synchronizing CUDA operation", False) and modes[-1] == "default"


def test_launches_are_counted(monkeypatch):
    """By the names that they have in a profile."""
    script = runpy.run_path(str(SCRIPT))
    names = ("cudaLaunchKernel", "cudaLaunchKernelExC", "cuLaunchKernel", "cudaMemcpyAsync", "aten::mul")
    events = [types.SimpleNamespace(key=name, count=100) for name in names]
    profile = types.SimpleNamespace(key_averages=lambda: events)
    monkeypatch.setattr(th.profiler, "profile", lambda activities: contextlib.nullcontext(profile))
    monkeypatch.setattr(th.cuda, "synchronize", lambda *_: None)
    monkeypatch.setattr(th.cuda, "_sleep", lambda cycles: None)
    model = types.SimpleNamespace(device=th.device("cuda"), batch_size=4, train=lambda **kwargs: None)
    ((name, ms),) = script["launches"](model).items()
    assert name.startswith("ceiling: 150 launches of ") and 0 < ms < 10  # of each of two updates


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("name", EQR_AGENTS)
def test_a_capture_that_fails_leaves_a_gpu_that_works(name):
    """What reads a number back cannot be captured: it runs as it is, and draws random numbers as before."""
    model = make_agent(name, device="cuda", fast="graph", buffer_size=200)
    fill(model.replay_buffer, 150)
    update = model._update_networks

    def reads_back(samples):
        outputs = update(samples)
        next(iter(outputs.values())).sum().item()
        return outputs

    model._update_networks = reads_back
    with pytest.warns(UserWarning, match="cannot be captured"):
        for _ in range(6):
            train(model)
    model._collect_metrics()
    assert model._captured.failure is not None and model._n_updates == 12
    assert th.isfinite(th.randn(8, device="cuda")).all()
