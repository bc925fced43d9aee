"""The speed script: its counts are correct, ratios are computed within rounds, and it runs completely."""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch as th

from experiments import speed, workload
from experiments.workload import EQR_AGENTS, NETWORKS, OFF, Series, Table, make_agent
from tests.tools.test_package import ROOT


def test_bytes_per_transition():
    stock, ours = (workload.bytes_per_transition(make_agent(name)) for name in ("QRDQN", "EqRQRDQN"))
    assert ours <= 8_500 < 56_000 < stock


class Cube(th.autograd.Function):
    """x³: two operations forward, three backward."""

    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(x)
        return x * x * x

    @staticmethod
    def backward(ctx, gradient):
        (x,) = ctx.saved_tensors
        return gradient * 3 * (x * x)


def test_operations_by_hand():
    x, weight, gradient = th.ones(2, 3, requires_grad=True), th.ones(4, 3), th.ones(2, 3)
    assert workload.count_operations(lambda: (x * x).sum()) == 2
    assert workload.count_operations(lambda: th.nn.functional.linear(x, weight)) == 1  # nested operations are not counted
    assert workload.count_operations(lambda: th.autograd.grad(x * gradient, x, gradient)) == 2
    assert workload.count_operations(lambda: th.autograd.grad(Cube.apply(x), x, gradient)) == 5


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


def test_a_table():
    rows = [{"name": "a", "the_ms": 0.12345, "none": None}, {"name": "long", "the_ms": 1234.5, "none": None}]
    lines = Table("t", "Title", rows, ["note"]).text().splitlines()
    assert lines == ["Title", "name  the ms", "a      0.123", "long   1,234", "note"]


def test_options():
    args = speed.parse([])
    assert args.only == ["updates"] and args.network == list(NETWORKS)
    args = speed.parse(["--only", "parts", "graph", "--network", "minatar", "cartpole"])
    assert args.only == ["parts", "graph"] and args.network == ["minatar", "cartpole"]


@pytest.mark.parametrize(
    "wrong, message",
    [
        ("--only stepz", "argument --only: invalid choice: 'stepz'"),
        ("--network doom", "argument --network: invalid choice: 'doom'"),
        ("--rounds 0", "--rounds must be an integer >= 1, got 0"),
    ],
)
def test_wrong_options(wrong, message, capsys):
    with pytest.raises(SystemExit):
        speed.parse(wrong.split())
    assert message in " ".join(capsys.readouterr().err.split())


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
