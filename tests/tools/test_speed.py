"""The speed script: what it counts is right, what it wraps it puts back, and it runs from start to end."""

import json
import subprocess
import sys
import types

import numpy as np
import pytest
import torch as th
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from sb3_eqr.benchmark.speed import play
from sb3_eqr.benchmark.speed.__main__ import PARTS, parse
from sb3_eqr.benchmark.speed.clock import Series, take_turns
from sb3_eqr.benchmark.speed.floor import Floor, find_convolutions
from sb3_eqr.benchmark.speed.steps import update_stages
from sb3_eqr.benchmark.speed.stopwatch import REST, Stage, Stopwatch, break_down
from sb3_eqr.benchmark.speed.tables import Sweep, Table, growth, verdict
from sb3_eqr.benchmark.speed.workload import DEPTH_0, EQR_AGENTS, fill, make_agent, train
from sb3_eqr.common.networks.encoders import ConvTrunk, ImpalaTrunk

# --- the floor -----------------------------------------------------------------------------------------------------------

# Outputs × filters × (weights of a filter) × 2, by hand for the network of Mnih et al. 2015 on 84×84×4
NATURE_FLOP = [20 * 20 * 32 * (8 * 8 * 4) * 2, 9 * 9 * 64 * (4 * 4 * 32) * 2, 7 * 7 * 64 * (3 * 3 * 64) * 2]
FORWARD = 6_553_600 + 5_308_416 + 3_612_672


def test_arithmetic_of_the_convolutions_by_hand():
    found = find_convolutions(ConvTrunk(4), (4, 84, 84))
    assert [conv.flop for conv in found] == NATURE_FLOP and sum(NATURE_FLOP) == FORWARD
    assert [conv.takes_images for conv in found] == [True, False, False]  # images need no gradient
    assert [conv.backward_flop for conv in found] == [6_553_600, 2 * 5_308_416, 2 * 3_612_672]


def test_arithmetic_of_another_trunk_as_pytorch_counts_it():
    trunk = ImpalaTrunk(4)
    with FlopCounterMode(display=False) as counter, th.no_grad():
        trunk(th.zeros(1, 4, 36, 36))
    assert sum(conv.flop for conv in find_convolutions(trunk, (4, 36, 36))) == counter.get_total_flops()


@pytest.mark.parametrize(
    ("name", "kwargs", "n_forward"),
    [(EQR_AGENTS[0], {}, 192), (DEPTH_0, {}, 32), (EQR_AGENTS[1], {"prediction_depth": 2, "batch_size": 8}, 24)],
)
def test_floor_follows_its_agent(name, kwargs, n_forward):
    floor = Floor(make_agent(name, buffer_size=64, **kwargs))
    n_trained = kwargs.get("batch_size", 32)
    assert (floor.n_forward, floor.n_trained) == (n_forward, n_trained)
    backward = 2 * FORWARD - NATURE_FLOP[0]
    assert floor.flop == FORWARD * (n_forward + n_trained) + backward * n_trained
    with FlopCounterMode(display=False) as counter:
        floor.step()
    assert counter.get_total_flops() == floor.flop


def test_floor_leaves_the_agent_alone():
    model = make_agent(EQR_AGENTS[0], buffer_size=64, prediction_depth=1, batch_size=2)
    before = [parameter.clone() for parameter in model.policy.parameters()]
    Floor(model).steps(2)
    assert all(th.equal(*pair) for pair in zip(before, model.policy.parameters(), strict=True))
    assert all(parameter.grad is None for parameter in model.policy.parameters())


# --- the stopwatch -------------------------------------------------------------------------------------------------------


class Clockwork:
    """Methods that take known times by a clock of their own."""

    def __init__(self):
        self.time = 0.0

    def inner(self):
        self.time += 1.0
        return "inner"

    def outer(self):
        self.time += 10.0
        self.inner()
        self.time += 10.0
        self.inner()

    def fails(self):
        self.time += 100.0
        raise KeyError


def test_nested_stages_count_once():
    work = Clockwork()
    watch = Stopwatch(lambda: work.time)

    def call():
        work.time += 1000.0
        work.outer()
        work.inner()

    stages = [Stage("outer", work, "outer"), Stage("inner", work, "inner")]
    assert watch.measure(stages, call) == {"outer": 20.0, "inner": 3.0, REST: 1000.0}
    assert watch.measure(stages, call) == {"outer": 20.0, "inner": 3.0, REST: 1000.0}
    assert watch.calls == {"outer": 2, "inner": 6}


def test_one_stage_of_two_methods_inside_each_other():
    work = Clockwork()
    stages = [Stage("both", work, "outer"), Stage("both", work, "inner")]
    assert Stopwatch(lambda: work.time).measure(stages, lambda: work.outer()) == {"both": 22.0, REST: 0.0}


def test_methods_are_put_back():
    work, module = Clockwork(), types.SimpleNamespace(function=len)
    inner, before = Clockwork.inner, dict(vars(work))
    stages = [Stage("on the object", work, "outer"), Stage("on the class", Clockwork, "inner")]
    stages += [Stage("of a module", module, "function"), Stage("fails", work, "fails")]
    watch = Stopwatch(lambda: work.time)
    with pytest.raises(KeyError), watch.watching(stages):
        assert work.inner() == "inner" and module.function([1, 2]) == 2
        assert "outer" in vars(work) and Clockwork.inner is not inner
        work.fails()
    assert Clockwork.inner is inner and module.function is len and vars(work).keys() == before.keys()
    assert watch.seconds["fails"] == 100.0 and watch.calls["on the class"] == 1


def test_breakdown_in_turns():
    work, order = Clockwork(), []

    def called(name):
        order.append(name)
        work.time += 5.0
        work.outer()

    stages = [Stage("outer", work, "outer"), Stage("inner", work, "inner")]
    found = break_down({name: (stages, lambda name=name: called(name)) for name in "ab"}, 3, lambda: work.time)
    assert order == list("ababab")
    assert found["b"].calls == {"outer": 1, "inner": 2}
    assert (found["a"].median(), found["a"].median("outer"), found["a"].median("inner", REST)) == (27.0, 20.0, 7.0)


def test_a_stage_that_is_gone_or_unused_is_told():
    work = Clockwork()
    watch = Stopwatch(lambda: work.time)
    with pytest.raises(AttributeError, match="stage 'b': expected a method 'is_gone' of Clockwork"):
        watch.measure([Stage("a", work, "inner"), Stage("b", work, "is_gone")], work.inner)
    assert "inner" not in vars(work)  # the first one is back
    with pytest.raises(RuntimeError, match="found none of outer"):
        Stopwatch(lambda: work.time).measure([Stage("outer", work, "outer")], lambda: work.inner())


@pytest.mark.parametrize("name", EQR_AGENTS)
def test_stages_of_an_update(name):
    """The table fits the agents as they are, and timing changes no number."""
    kwargs = {"buffer_size": 64, "batch_size": 4, "prediction_depth": 2}
    models = [make_agent(name, **kwargs) for _ in range(2)]
    for index, model in enumerate(models):
        fill(model.replay_buffer, 40)
        model.set_random_seed(1)
        if index == 0:
            train(model)
        else:
            spent = Stopwatch().measure(update_stages(model), lambda: train(models[1]))
    assert all(seconds > 0 for seconds in spent.values())
    for pair in zip(*(model.policy.parameters() for model in models), strict=True):
        assert th.equal(*pair)
    assert "forward" not in vars(models[1].policy.latent_model) and nn.utils.clip_grad_norm_.__module__.startswith("torch")


# --- figures and tables --------------------------------------------------------------------------------------------------


def test_growth_against_arithmetic():
    assert growth([2.0, 4.0, 12.0], [1.0, 2.0, 3.0]) == [1.0, 1.0, 2.0]
    assert growth([2.0, 1.0], [1.0, 1.0]) == [1.0, 0.5]
    assert [verdict([g]) for g in (0.5, 1.0, 1.25, 1.26)] == ["ok", "ok", "ok", "grows faster"]


def test_sweep_as_a_table():
    sweep = Sweep("s", "A sweep", "size", [1, 2000], {"a_ms": [0.5, 2.0]}, {"a_ms": [1.0, 2.0]}, "units")
    table = sweep.table()
    assert table.rows[1] == {"size": 2000, "a_ms": 2.0, "a_ms_growth": 2.0, "verdict": "grows faster"}
    lines = table.text().splitlines()
    assert lines[:3] == ["A sweep", "size   a ms  growth       verdict", "1      0.50    1.00            ok"]
    assert lines[3] == "2,000  2.00    2.00  grows faster"
    assert lines[4].endswith("arithmetic: units") and json.loads(json.dumps(table.data()))["rows"] == table.rows


def test_table_without_rows_says_why():
    assert Table("t", "Title", {}, [], ["left out"]).text() == "Title\nleft out"


def test_taking_turns():
    order = []
    calls = {name: lambda name=name: order.append(name) for name in "ab"}
    timings = take_turns(calls, rounds=3, n_per_call=2)
    assert order == list("ab" * 4)  # the first round does not count
    assert [len(timings[name].ms) for name in "ab"] == [3, 3]


def test_ratios_are_within_rounds():
    fast, slow = Series(np.array([1.0, 2.0, 3.0]), None), Series(np.array([2.0, 4.0, 7.0]), None)
    assert slow.ratio(fast) == 2.0 and slow.beyond(fast) == 2.0 and fast.median_faults is None and slow.median == 4.0


def test_options():
    assert parse([]).only == list(PARTS)
    assert parse(["--sizes"]).only == [*PARTS, "sizes"]
    assert parse(["--only", "steps,stages"]).only == ["steps", "stages"]


@pytest.mark.parametrize(
    "wrong, message",
    [
        ("--only stepz", "--only: expected parts of steps, stages, collection, evaluation, sizes, found 'stepz'"),
        ("--plot a.png", "--plot: there is nothing to draw without --sizes"),
        ("--rounds 0", "--rounds: expected at least 1, found 0"),
        ("--largest 100", "--largest: expected at least 10000, found 100"),
        pytest.param(
            "--device cuda",
            "--device: expected cpu, found 'cuda'",
            marks=pytest.mark.skipif(th.cuda.is_available(), reason="for machines without a GPU"),
        ),
    ],
)
def test_wrong_options(wrong, message, capsys):
    with pytest.raises(SystemExit):
        parse(wrong.split())
    assert message in " ".join(capsys.readouterr().err.split())


# --- the whole -----------------------------------------------------------------------------------------------------------


def run_script(*arguments):
    command = [sys.executable, "-m", "sb3_eqr.benchmark.speed", "--threads", "1", "--rounds", "1", *map(str, arguments)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


@pytest.mark.slow
def test_script_prints_its_tables(tmp_path):
    shown = run_script("--only", "steps,stages,collection", "--json", tmp_path / "speed.json")
    found = json.loads((tmp_path / "speed.json").read_text())
    assert {"cpu", "command", "threads", "versions", "tables"} <= found.keys()
    tables = found["tables"]
    for table in tables.values():
        assert table["title"] in shown and all(note in shown for note in table["notes"])
    steps = {row["name"]: row for row in tables["steps"]["rows"]}
    assert list(steps) == ["floor", "DQN (stock)", "QRDQN (stock)", "EqRQRDQN", "EqRRainbow", "EqRQRDQN, depth 0"]
    assert steps["EqRQRDQN"]["bytes_per_transition"] <= 8_500 < 56_000 < steps["QRDQN (stock)"]["bytes_per_transition"]
    whole = {row["stage"]: row["EqRQRDQN_ms"] for row in tables["stages"]["rows"]}
    assert sum(whole.values()) == pytest.approx(2 * whole["whole"], rel=1e-3)  # of one round the parts add up
    assert "4.247 GFLOP" in shown
    for row in tables["collection_atari"]["rows"]:
        assert row["ms_emulator"] + row["ms_on_top"] == pytest.approx(row["ms"], rel=1e-3)


@pytest.mark.slow
def test_evaluation_is_measured(monkeypatch):
    """A few short games, where the script plays a hundred."""
    for name, value in {"EPISODES": 2, "ONE_BY_ONE": 1, "MAX_STEPS": 20}.items():
        monkeypatch.setattr(play, name, value)
    (table,) = play.measure_evaluation(1, "cpu")
    assert [row["name"] for row in table.rows] == ["evaluate_policy, 1 environment, 1 games", "benchmark's evaluate, 2 games"]
    assert all(row["steps_per_second"] > 0 for row in table.rows)


@pytest.mark.slow
def test_script_measures_cost_against_size(tmp_path):
    run_script("--only", "sizes", "--largest", 10_000, "--json", tmp_path / "sizes.json")
    tables = json.loads((tmp_path / "sizes.json").read_text())["tables"]
    assert list(tables) == ["stored_transitions", "n_envs", "M", "K", "group"]
    entries = [row["state_entries"] for row in tables["group"]["rows"]]
    assert entries == [12 * 9, 12 * 16, 12 * 36, 12 * 16]  # 12 matrices: 3×3, 4×4, 6×6, 4×4
