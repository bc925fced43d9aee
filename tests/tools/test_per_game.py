"""Scores per game of two agents."""

import pytest
from scipy.stats import t

from experiments.per_game import final_scores, table


def result(agent, game, seed, *scores):
    evaluations = [
        {"kind": "final", "step": 20, "scores": list(scores)},
        {"kind": "curve", "step": 10, "scores": [99.0]},
    ]
    return {"agent": agent, "game": game, "seed": seed, "evaluations": evaluations}


def test_the_last_evaluation_counts():
    assert final_scores([result("a", "Pong", 0, 1.0, 3.0), result("a", "Pong", 1, 5.0)]) == {("a", "Pong"): [2.0, 5.0]}


def test_difference_and_interval_by_hand():
    """Means 4 and 1, variances 4 and 1, three seeds each: s² = 5/3, (5/3)² / ((4/3)² / 2 + (1/3)² / 2) degrees of freedom."""
    scores = {("a", "Pong"): [2.0, 4.0, 6.0], ("b", "Pong"): [0.0, 1.0, 2.0], ("a", "Boxing"): [1.0, 2.0]}
    half = t.ppf(0.975, (25 / 9) / (16 / 18 + 1 / 18)) * (5 / 3) ** 0.5
    row = table(scores, ("a", "b")).splitlines()[2]
    assert row == f"| Pong | 4.00 ± 2.00 | 1.00 ± 1.00 | 3.00 [{3 - half:.2f}, {3 + half:.2f}] | 3, 3 |"
    assert half == pytest.approx(4.15, abs=0.1)  # t is 3.18 for 3 degrees of freedom
    assert len(table(scores, ("a", "b")).splitlines()) == 3  # b did not play Boxing
