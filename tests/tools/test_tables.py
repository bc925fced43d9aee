"""The tables of docs/results: differences, ratios and measures by hand."""

import json

import numpy as np
import pytest
from scipy.stats import t

from experiments.tables import difference, draw, measure, ratio, series, table
from sb3_eqr.benchmark.packed import read
from tests.tools.test_package import ROOT


def row(agent="a", game="Boxing", seed=0, score=1.0, **changes):
    """Four training episodes of a run of 100 steps."""
    episodes = {"step": [9, 25, 60, 95], "score": [0.0, 2.0, 0.0, 4.0], "length": [9, 16, 35, 35]}
    evaluations = [{"step": 50, "kind": "curve", "scores": [9.0]}, {"step": 100, "kind": "final", "scores": [score, score]}]
    found = {"agent": agent, "game": game, "seed": seed, "protocol": {"steps": 100}, "evaluations": evaluations, "losses": []}
    return found | {"training": episodes, "wall_clock_s": 60.0} | changes


def test_measures_by_hand():
    names = ("score", "end", "goals", "first_goal", "return", "minutes", "20-60", "at9")
    assert [measure(row(), name) for name in names] == [1.0, 4.0, 2.0, 25.0, 1.5, 1.0, 1.0, 50.0]
    assert (
        np.isnan(measure(row(stopped_at=59), "20-60")) and np.isnan(measure(row(), "R2")) and np.isnan(measure(row(), "at10"))
    )
    assert measure(row(measures={"goals": 7}), "goals") == 7  # what was measured when the run was made
    logged = [{"step": 10, "latent/skill": 0.5}, {"step": 20, "aet_loss": 0.25}]
    assert measure(row(losses=logged), "skill") == 0.5 and measure(row(losses=logged), "train/aet_loss") == 0.25


def test_series_are_tenths_of_the_run():
    steps, goals = series(row(), "goals")
    assert steps.tolist() == [*range(10, 101, 10)] and goals.tolist() == [0, 0, 1, 0, 0, 0, 0, 0, 0, 1]
    assert series(row(), "return")[1][[0, 2]].tolist() == [0.0, 2.0] and np.isnan(series(row(), "td_loss")[1]).all()


def test_differences_have_welch_intervals():
    """Means 4 and 1, variances 4 and 1, three seeds each: s² = 5/3, (5/3)² / ((4/3)² / 2 + (1/3)² / 2) degrees of freedom."""
    half = t.ppf(0.975, (25 / 9) / (16 / 18 + 1 / 18)) * (5 / 3) ** 0.5
    found = difference(np.array([2.0, 4.0, 6.0]), np.array([0.0, 1.0, 2.0]))
    assert found == f" (3.00 [{3 - half:.2f}, {3 + half:.2f}])" and half == pytest.approx(4.15, abs=0.1)
    assert difference(np.array([1.0, 1.0]), np.array([0.0, 0.0])) == difference(np.array([1.0]), np.array([0.0, 2.0])) == ""


def test_ratios_have_intervals_by_the_delta_method():
    """
    Ratios 1.5 and 0.5. Only the entry varies, and on one game, where its mean 2 has the variance 1: the ratio 1.5 has the
    variance 1.5² · 1 / 2² = 0.5625, the average of two ratios a quarter of it, the standard deviation 0.375, and one degree of
    freedom, whose 97.5 % quantile is 12.706.
    """
    changed, entry = np.array([[3.0, 20.0]] * 2), np.array([[1.0, 40.0], [3.0, 40.0]])
    assert ratio(changed, entry) == pytest.approx((1.0, 1 - 0.375 * 12.7062, 1 + 0.375 * 12.7062), abs=1e-4)
    assert ratio(changed[:1], entry) == (1.0, -np.inf, np.inf)


def test_a_table_by_hand(tmp_path):
    """Scores 1 and 3 have the mean 2 and the standard error √2 / √2 = 1; the ratios are 1.5 and 0.5."""
    scores = {
        ("a", "Pong"): (1.0, 3.0),
        ("b", "Pong"): (3.0, 3.0),
        ("a", "Boxing"): (40.0, 40.0),
        ("b", "Boxing"): (20.0, 20.0),
    }
    rows = [row(agent, game, seed, s) for (agent, game), both in scores.items() for seed, s in enumerate(both)]
    assert table(rows, ["score"], "a", is_ratio=True).splitlines() == [
        "| agent | seeds | Pong, score | Boxing, score | score, relative |",
        "|---|---|---|---|---|",
        "| a | 2 | 2.00 ± 1.00 | 40.0 ± 0.00 |  |",
        "| b | 2 | 3.00 ± 0.00 | 20.0 ± 0.00 | 1.00 [-3.76, 5.76] |",
    ]
    assert table(rows[:4], ["score"], None, each=True).splitlines()[2] == "| a | 2 | 1.00, 3.00 |"
    draw(rows, "goals", tmp_path / "goals.png")
    assert (tmp_path / "goals.png").stat().st_size > 1_000


@pytest.mark.parametrize("file", sorted((ROOT / "docs" / "results").rglob("*.jsonl.xz")), ids=lambda path: path.name)
def test_kept_runs_can_be_read(file):
    """Each run once, with the keys that a report needs."""
    suite, rows = read(file)
    runs = [(found["agent"], found["game"], found["seed"]) for found in rows]
    assert len(set(runs)) == len(runs) > 0 and {game for _, game, _ in runs} <= set(suite.games)
    needed = {"protocol", "entry", "versions", "machine", "started", "evaluations", "training", "losses", "wall_clock_s"}
    assert all(needed <= found.keys() for found in rows)
    assert "/root/" not in json.dumps(rows)
