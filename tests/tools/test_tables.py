"""The tables of docs/results: differences, ratios and measures by hand."""

import json
import pathlib
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import t

from experiments.tables import (
    COMPARED,
    Compared,
    claim,
    compare,
    difference,
    differences,
    draw,
    forest,
    measure,
    ratio,
    series,
    table,
)
from sb3_eqr.benchmark.packed import read
from sb3_eqr.benchmark.scores import load_scores
from tests.tools.test_package import ROOT


def row(agent="a", game="Boxing", seed=0, score=1.0, **changes):
    """Four training episodes of a run of 100 steps."""
    episodes = {"step": [9, 25, 60, 95], "score": [0.0, 2.0, 0.0, 4.0], "length": [9, 16, 35, 35]}
    evaluations = [{"step": 50, "kind": "curve", "scores": [9.0]}, {"step": 100, "kind": "final", "scores": [score, score]}]
    found = {"agent": agent, "game": game, "seed": seed, "protocol": {"steps": 100}, "evaluations": evaluations, "losses": []}
    return found | {"training": episodes, "wall_clock_s": 60.0} | changes


def test_measures_by_hand():
    names = ("score", "end", "goals", "first_goal", "return", "minutes", "20-60", "goals0-60", "at9", "until50", "until100")
    assert [measure(row(), name) for name in names] == [1.0, 4.0, 2.0, 25.0, 1.5, 1.0, 1.0, 1.0, 50.0, 9.0, 5.0]
    assert (
        np.isnan(measure(row(stopped_at=59), "20-60")) and np.isnan(measure(row(), "R2")) and np.isnan(measure(row(), "at10"))
    )
    assert np.isnan(measure(row(stopped_at=59), "score"))  # its last evaluation is none of a trained agent
    assert measure(row(measures={"goals": 7}), "goals") == 7  # what was measured when the run was made
    logged = [{"step": 10, "aet_loss": 0.5}, {"step": 20, "aet_loss": 0.25}]
    assert measure(row(losses=logged), "train/aet_loss") == 0.25


def test_series_are_tenths_of_the_run():
    steps, goals = series(row(), "goals")
    assert steps.tolist() == [*range(10, 101, 10)] and goals.tolist() == [0, 0, 1, 0, 0, 0, 0, 0, 0, 1]
    assert series(row(), "return")[1][[0, 2]].tolist() == [0.0, 2.0] and np.isnan(series(row(), "td_loss")[1]).all()
    assert [values.tolist() for values in series(row(), "score")] == [[50, 100], [9.0, 1.0]]


def test_the_claim_is_in_standard_deviations_of_published_runs():
    """
    SPR's are 464.7 on Krull and 55.35 on Assault (reference_scores.csv); differences of 1 and -2 of these. The paper's Table 2
    has 5467.7 and 734.3, and for SPR 3688.9 and 571.0.
    """
    krull, assault = [row("a", "Krull", score=3464.7), row("b", "Krull", score=3000.0)], []
    for agent, score in (("a", 589.3), ("b", 700.0)):  # in training, because one of the runs was stopped
        games = {"step": [50_000, 60_000, 75_000], "score": [0.0, score - 9, score + 9], "length": [1, 1, 1]}
        assault.append(row(agent, "Assault", training=games, **({"stopped_at": 75_010} if agent == "a" else {})))
    lines = [
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in claim(krull + assault, ("a", "b"), ["Krull", "Assault"]).splitlines()[2:]
    ]
    assert [line[1:3] + line[-2:] for line in lines[:2]] == [
        ["final", "1", "1.00", "3.83"],
        ["training", "1", "-2.00", "2.95"],
    ]
    half = t.ppf(0.975, 1) * 1.5  # the standard deviation of 1 and -2 is 2.121, by the root of 2
    assert lines[2][-2:] == [f"-0.50 [{-0.5 - half:.1f}, {half - 0.5:.1f}]", "3.39"]


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
    draw(rows, "goals", tmp_path / "goals.png", ["a", "a without EqR"])
    assert (tmp_path / "goals.png").stat().st_size > 1_000


def test_a_comparison_by_hand(monkeypatch):
    """
    One game: means 4 and 1, variances 4 and 1, so that the pooled standard deviation is √2.5, and Welch's interval as above.
    Two games, whose scores become 0 at 0 and 1 at 2 and 20: the means of (1, 2, 3) and (1, 2, 3), and of (0, 0.5, 1) twice.
    """
    scores = {
        ("with", "Pong"): (2.0, 4.0, 6.0),
        ("without", "Pong"): (0.0, 1.0, 2.0),
        ("with", "Boxing"): (20.0, 40.0, 60.0),
        ("without", "Boxing"): (0.0, 10.0, 20.0),
    }
    rows = [row(agent, game, seed, s) for (agent, game), each in scores.items() for seed, s in enumerate(each)]
    for i, found in enumerate(rows):
        found["evaluations"][0]["scores"] = [float(i)]  # after 50 steps
    bounds = SimpleNamespace(normalisation=SimpleNamespace(scores={"Pong": (0.0, 2.0), "Boxing": (0.0, 20.0)}))
    monkeypatch.setattr("experiments.tables.read", lambda file: (bounds, rows))
    one = compare(pathlib.Path(), "Pong", ["file"], ["Pong"], ("with", "without"), "score", "page.md")
    half = t.ppf(0.975, (25 / 9) / (16 / 18 + 1 / 18)) * (5 / 3) ** 0.5
    assert one.means == (4.0, 1.0) and one.difference == 3.0 and one.ends == pytest.approx((3 - half, 3 + half))
    assert one.spread == pytest.approx(2.5**0.5) and (one.steps, one.seeds) == (100, 3)
    both = compare(pathlib.Path(), "both", ["file"], ["Pong", "Boxing"], ("with", "without"), "score", "page.md")
    assert both.means == (2.0, 0.5)
    assert compare(pathlib.Path(), "Pong", ["file"], ["Pong"], ("with", "without"), "until50", "page.md").steps == 50


def test_verdicts_follow_from_the_intervals(tmp_path):
    ends = {"better with EqR": (0.5, 5.5), "no clear difference": (-1.0, 7.0), "worse with EqR": (-0.19, -0.01)}
    means = [(4.0, 1.0), (4.0, 1.0), (0.285, 0.385)]
    found = [Compared("Pong", 1_000, m, e, 1.5, 5, "page.md") for m, e in zip(means, ends.values(), strict=True)]
    assert [one.verdict for one in found] == list(ends)
    assert differences(found).splitlines()[2:] == [
        "|[Pong](page.md)|1,000|5|4.0|1.0|3.0 [0.5, 5.5]|better with EqR|",
        "|[Pong](page.md)|1,000|5|4.0|1.0|3.0 [−1.0, 7.0]|no clear difference|",
        "|[Pong](page.md)|1,000|5|0.28|0.39|−0.10 [−0.19, −0.01]|worse with EqR|",
    ]
    forest(found, tmp_path / "differences.png")
    assert (tmp_path / "differences.png").stat().st_size > 1_000


def test_the_page_of_results_shows_the_kept_runs():
    """Every row of the table of docs/results/index.md, from five seeds or more; each task once."""
    found = [compare(ROOT / "docs" / "results", *arguments) for arguments in COMPARED]
    page = (ROOT / "docs" / "results" / "index.md").read_text(encoding="utf-8")
    assert all(line in page for line in differences(found).splitlines())
    assert page.count("\n|[") == len(found) == len({one.task for one in found}) and min(one.seeds for one in found) >= 5


@pytest.mark.parametrize("file", sorted((ROOT / "docs" / "results").rglob("*.jsonl.xz")), ids=lambda path: path.name)
def test_kept_runs_can_be_read(file):
    """Each run once, with the keys that a report needs."""
    suite, rows = read(file)
    runs = [(found["agent"], found["game"], found["seed"]) for found in rows]
    assert len(set(runs)) == len(runs) > 0 and {game for _, game, _ in runs} <= set(suite.games)
    needed = {"protocol", "entry", "versions", "machine", "started", "evaluations", "training", "losses", "wall_clock_s"}
    assert all(needed <= found.keys() for found in rows)
    assert "/root/" not in json.dumps(rows)
    finished = [found for found in rows if "stopped_at" not in found]
    if finished:  # older rows have no lengths of evaluated episodes
        n_episodes = sum(len(part["scores"]) for found in finished for part in found["evaluations"])
        assert len(load_scores(file)) == n_episodes + sum(len(found["training"]["score"]) for found in finished)
