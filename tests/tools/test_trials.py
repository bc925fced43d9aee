"""Trials of settings, and the linear probes of their agents."""

import json
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
import yaml

from experiments import ablation, probes
from experiments.probes import explained, probe
from experiments.trials import check_names, differences, merged, table
from sb3_eqr import EqRQRDQN
from sb3_eqr.envs import make_atari100k_env
from tests.toys import ImageEnv

ROW = {"trial": "a", "game": "Breakout", "seed": 0, "steps": 10, "agent": "rainbow", "changes": {"gamma": 0.9}}


def test_changes_are_merged_and_an_empty_dictionary_clears():
    entry = {"gamma": 0.9, "policy_kwargs": "dict(net_arch=[8], noisy=True)", "replay_buffer_kwargs": {"alpha": 0.5}}
    found = merged(entry, {"policy_kwargs": {"noisy": False}, "replay_buffer_kwargs": {}, "n_steps": 3})
    kept = {"net_arch": [8], "noisy": False}
    assert found == {"gamma": 0.9, "policy_kwargs": kept, "replay_buffer_kwargs": {}, "n_steps": 3}


def test_another_trial_of_the_same_name_is_refused():
    wanted = [("a", "Breakout", 1)]
    check_names([ROW], {"a": {"agent": "rainbow", "changes": {"gamma": 0.9}}}, wanted, 10)
    check_names([ROW], {"a": {"agent": "rainbow", "changes": {"gamma": 0.8}}}, wanted, 20)  # other steps
    with pytest.raises(SystemExit, match=r"a, Breakout, 10 steps: .* got .*0.9.* instead of .*0.8"):
        check_names([ROW], {"a": {"agent": "rainbow", "changes": {"gamma": 0.8}}}, wanted, 10)


def test_the_table_names_cells_with_fewer_seeds():
    """Scores 1 and 3 have the mean 2 and the standard error √2 / √2 = 1."""
    result = {"curve": [0.5], "seconds": 7.0}
    rows = [{**ROW, **result, "seed": seed, "score": score} for seed, score in ((0, 1.0), (1, 3.0))]
    rows.append({**ROW, **result, "game": "Freeway", "score": 4.0})
    assert table(rows, ["a"], ["Breakout", "Freeway"], 10).splitlines()[2] == (
        "| a | 2 | 2.00 ± 1.00, 0.50 ± 0.00 | 4.00, 0.50 (1) | 7 |"
    )


def test_ratios_have_intervals_by_the_delta_method():
    """
    Ratios 1.5 and 0.5. Only the entry varies, and on one game, where its mean 2 has the variance 1: the ratio 1.5 has the
    variance 1.5² · 1 / 2² = 0.5625, the average of two ratios a quarter of it, the standard deviation 0.375, and one degree of
    freedom, whose 97.5 % quantile is 12.706.
    """
    changed, entry = np.array([[3.0, 20.0]] * 2), np.array([[1.0, 40.0], [3.0, 40.0]])
    assert ablation.ratio(changed, entry) == pytest.approx((1.0, 1 - 0.375 * 12.7062, 1 + 0.375 * 12.7062), abs=1e-4)
    assert ablation.ratio(changed[:1], entry) == (1.0, -np.inf, np.inf)


def test_differences_have_welch_intervals():
    """
    Goals 3 and 1 against 0 and 0: the difference 2 has the standard error √(2 / 2) = 1 and one degree of freedom, whose 97.5 %
    quantile is tan(0.475 π) = 12.706. The last measures are constant.
    """
    rows = [
        {**ROW, "trial": trial, "game": "torus", "seed": seed, "return_in_all": goals, "score": 1.0, "probe": probe}
        for trial, values, probe in (("a", (3.0, 1.0), 0.75), ("b", (0.0, 0.0), 0.5))
        for seed, goals in enumerate(values)
    ]
    assert differences(rows, ["a", "b"], "b", "torus", 10).splitlines() == [
        "| compared with b | goals reached | greedy policy | R² |",
        "|---|---|---|---|",
        "| a | 2 [-10.71, 14.71] | 0 | 0.25 |",
    ]


def test_the_ablation_compares_with_the_entry_game_by_game(tmp_path):
    """
    Of one component 1.5 and 0.5 times the entry's mean score on the two games, 1 on average, whatever the games' units. A seed
    that has run on one game only does not count. All seeds of a game are equal, so the interval is a point.
    """
    scores = {"recipe": (2.0, 40.0), "get": (3.0, 20.0)}
    rows = [
        {"trial": trial, "game": game, "seed": seed, "score": score, "curve": [0.0, 10.0], "skill": [0.9, 0.5]}
        for trial, both in scores.items()
        for game, score in zip(ablation.GAMES, both, strict=True)
        for seed in (0, 1)
    ]
    rows.append({**rows[0], "seed": 2, "score": 1e6})
    trials = {name: [row for row in rows if row["trial"] == name] for name in scores}
    assert ablation.matrix(trials["recipe"], "score").tolist() == [[2.0, 40.0]] * 2
    assert ablation.table(trials).splitlines()[2:] == [
        "| the entry | 2 | 2.00 ± 0.00 | 40.00 ± 0.00 | 1 | 1 | 0.90, 0.50 |",
        "| GET loss only | 2 | 3.00 ± 0.00 | 20.00 ± 0.00 | 1.00 [1.00, 1.00] | 1.00 [1.00, 1.00] | 0.90, 0.50 |",
    ]
    ablation.draw(trials, tmp_path / "ablation.png")
    assert (tmp_path / "ablation.png").stat().st_size > 1_000


def test_a_failed_trial_is_an_error(tmp_path):
    (tmp_path / "trials.yml").write_text(yaml.safe_dump({"wrong": {"agent": "rainbow", "changes": {"gama": 0.9}}}))
    command = [
        sys.executable,
        "-m",
        "experiments.trials",
        str(tmp_path / "trials.yml"),
        "--rows",
        str(tmp_path / "rows.jsonl"),
    ]
    found = subprocess.run([*command, "--games", "Breakout", "--seeds", "0"], capture_output=True, text=True, check=False)
    assert found.returncode == 1
    assert "gama" in found.stderr and "These runs failed, see their errors above: ('wrong', 'Breakout', 0)" in found.stderr


def test_probing_changes_nothing_and_separates_trunk_and_group():
    """The target is a linear function of the trunk's features: R² is 1 for them, less for 2 blocks of SO(2)."""
    network = {
        "group": "SO(2)",
        "n_blocks": 2,
        "whiten": True,
        "head_input": "state",
        "features_extractor_kwargs": {"features_dim": 8},
    }
    settings = {"learning_starts": 20, "buffer_size": 60, "batch_size": 8, "symmetry_coef": 0.0, "seed": 0}
    model = EqRQRDQN("CnnPolicy", ImageEnv(), **settings, policy_kwargs={**network, "projection": "none"}).learn(40)
    rng = np.random.default_rng(0)
    seen = rng.integers(0, 256, (6_000, 1, 36, 36), dtype=np.uint8)
    with th.no_grad():
        trunk = model.policy.online.features_extractor.trunk.eval()
        known = trunk(th.as_tensor(seen) / 255).double().numpy() @ rng.normal(size=8)
    before = {key: value.clone() for key, value in model.policy.state_dict().items()}
    model.policy.train()
    found = probe(model, (seen, {"target": known}))
    assert json.dumps(list(found)) == '["trunk", "state"]'
    assert found["trunk"]["target"] > 0.95 and found["state"]["target"] < found["trunk"]["target"] - 0.02
    assert all(th.equal(value, before[key]) for key, value in model.policy.state_dict().items())
    assert model.policy.training


def test_r2_of_noise():
    """Two inputs with weights 3 and 4 and noise of variance 25: R² is 25 / 50."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(6_000, 2))
    assert explained(x, x @ [3.0, 4.0] + 5 * rng.normal(size=6_000)) == pytest.approx(0.5, abs=0.04)


def test_a_ball_that_is_not_in_play_has_no_position(monkeypatch):
    """Breakout's frames say so as well: between bricks and paddle, nothing but the ball is lit."""
    monkeypatch.setattr(probes, "N_FRAMES", 150)
    env = make_atari100k_env("Breakout", n_envs=1, seed=0)
    still = SimpleNamespace(predict=lambda obs, deterministic: (np.zeros(1, dtype=int), None))
    seen, known = probes.watch(still, env, "ALE/Breakout", np.random.default_rng(0))
    is_out, is_lit = np.isnan(known["ball: y"]), (seen[:, 40:74, 5:79, -1] > 0).any(axis=(1, 2))
    is_between = (known["ball: y"] > 90) & (known["ball: y"] < 175)
    assert is_out.any() and is_between.any() and np.array_equal(np.isnan(known["ball: x"]), is_out)
    assert not is_lit[is_out].any() and is_lit[is_between].all()
