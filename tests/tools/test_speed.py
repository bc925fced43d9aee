"""The speed script: calls take turns, ratios are computed within rounds, and it runs completely."""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch as th

from experiments import speed, workload
from experiments.workload import EQR_AGENTS, OFF, Series
from tests.tools.test_package import ROOT


def test_calls_are_timed_alternately():
    order = []
    calls = {name: lambda name=name: order.append(name) for name in "ab"}
    timings = workload.take_turns(calls, rounds=3, n_per_call=2)
    assert order == list("ab" * 4)  # the first round is a warm-up
    assert [len(numbers) for name in "ab" for numbers in timings[name]] == [3] * 4


def test_ratios(monkeypatch):
    ms, more = np.array([1.0, 2.0, 3.0]), np.array([2.0, 4.0, 7.0])
    fast, slow = Series(ms, ms), Series(more, 3 * more)
    monkeypatch.setattr(th, "get_num_threads", lambda: 1)
    assert slow.ratio(fast) == 6.0  # of CPU time
    monkeypatch.setattr(th, "get_num_threads", lambda: 2)
    assert slow.ratio(fast) == 2.0


@pytest.mark.slow
def test_script_prints_its_tables(tmp_path):
    parts = ["--only", "updates", "--network", "minatar"]
    command = [sys.executable, "-m", "experiments.speed", "--threads", "1", "--rounds", "1", *parts]
    done = subprocess.run([*command, "--json", tmp_path / "speed.json"], check=True, capture_output=True, text=True, cwd=ROOT)
    found = json.loads((tmp_path / "speed.json").read_text())
    assert {"command", "threads", "versions"} <= found.keys() and done.stdout.startswith(found["cpu"])
    tables = found["tables"]
    assert list(tables) == ["updates_minatar"]
    assert all(table["title"] in done.stdout for table in tables.values())
    operations = {row["name"]: row["operations"] for row in tables["updates_minatar"]["rows"]}
    assert (operations["DQN"], operations["QRDQN"]) == (140, 170)
    for name in EQR_AGENTS:
        assert operations[name] > operations[name + OFF]


@pytest.mark.slow
def test_parts():
    """Forward: 64 windows of two passes through 4×256×((2 + 1) · 51) of QRDQN; its parts do not exceed the whole."""
    args = speed.parse(["--network", "cartpole", "--rounds", "1", "--threads", "1"])
    (table,) = speed.measure_parts(args)
    stock, without, with_eqr = table.rows
    forward = 64 * (4 * 256 + 256 * 2 * 51) * 2  # multiply and add; two actions
    assert stock["MFLOP"] == pytest.approx(4 * forward / 1e6, rel=0.1)  # online and target forward, online backward twice
    assert stock["MFLOP"] < without["MFLOP"] < with_eqr["MFLOP"]
    for row in (without, with_eqr):
        parts = [row[f"{part}_ms"] for part in ("sample", "Adam", "losses", "backward", "clip", "target")]
        assert min(parts) > 0 and 0.5 * row["update_ms"] < sum(parts) < row["update_ms"]


@pytest.mark.slow
def test_captured_updates_are_compared_with_eager_ones():
    """What a GPU is lent for, on a CPU: all three agents are eager, and eager updates are deterministic."""
    (table,) = speed.measure_graph(speed.parse(["--rounds", "1", "--threads", "1"]))
    assert [row["name"] for row in table.rows] == list(EQR_AGENTS)
    for row in table.rows:
        assert row["eager_again"] == row["captured"] == 0 and row["ok"]
        assert row["capture"] == "a CUDA graph needs a GPU, and the device is 'cpu'"
