"""The doors to RL Zoo: registration, hyperparameter files, messages."""

import re
import sys

import optuna
import pytest
import yaml
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS

from sb3_eqr import EqRQRDQN, EqRRainbow, zoo
from sb3_eqr.configurations import configuration_files
from sb3_eqr.zoo.__main__ import find_hyperparameters, main


@pytest.fixture
def sb3_eqr(monkeypatch, capfd):
    """Runs a command line; returns what it printed."""

    def call(line):
        monkeypatch.setattr(sys, "argv", ["sb3-eqr", *line.split()])
        main()
        return capfd.readouterr().out

    return call


@pytest.mark.parametrize(
    "line, message",
    [
        ("trian", "Did you mean 'train'?"),
        ("train --algo eqr_ranbow", "Did you mean 'eqr_rainbow'?"),
        ("enjoy --algo eqr_qrdnq", "Did you mean 'eqr_qrdqn'?"),
        ("train --algo eqr_qrdqn --env CartPol-v1", "Did you mean 'CartPole-v1'?"),
        ("train --algo eqr_qrdqn --env Blackjack-v1", "no entry for 'Blackjack-v1'; it has atari, CartPole-v1"),
        ("train --algo eqr_qrdqn --gym-packages nopackage", "'nopackage' cannot be imported"),
        ("train --algo eqr_qrdqn --conf-file nofile", "none of .*eqr_bbf"),
        ("train --algo eqr_qrdqn --conf-file no.yml", "there is no file 'no.yml'"),
        ("train --algo eqr_rainbow --conf-file eqr_qrdqn", "'n_quantiles' is no policy_kwargs of EqRRainbow"),
    ],
)
def test_wrong_use_is_told(sb3_eqr, capfd, line, message):
    with pytest.raises(SystemExit) as caught:
        sb3_eqr(line)
    assert caught.value.code == 2
    assert re.search(message, capfd.readouterr().err)


def test_unknown_keys_are_named_with_the_nearest(sb3_eqr, capfd, tmp_path):
    for entry, message in (
        ({"learning_rat": 0.1}, "'learning_rat' is no argument of EqRQRDQN. Did you mean 'learning_rate'?"),
        ({"policy_kwargs": {"n_block": 3}}, "'n_block' is no policy_kwargs of EqRQRDQN. Did you mean 'n_blocks'?"),
    ):
        (tmp_path / "own.yml").write_text(yaml.dump({"CartPole-v1": {"policy": "MlpPolicy", **entry}}))
        with pytest.raises(SystemExit):
            sb3_eqr(f"train --algo eqr_qrdqn --env CartPole-v1 --conf-file {tmp_path}/own.yml")
        assert message in capfd.readouterr().err


def test_train_enjoy_and_go_on(sb3_eqr, tmp_path):
    folder = f"-f {tmp_path}"
    shown = sb3_eqr(f"train --algo eqr_qrdqn --env CartPole-v1 -n 128 --eval-freq 100 --eval-episodes 1 --seed 1 {folder}")
    assert str(configuration_files()["eqr_qrdqn"]) in shown
    saved = tmp_path / "eqr_qrdqn" / "CartPole-v1_1"
    assert (saved / "CartPole-v1.zip").exists() and (saved / "best_model.zip").exists()
    assert EqRQRDQN.load(saved / "CartPole-v1.zip").num_timesteps == 128  # two rounds of 64
    shown = sb3_eqr(f"enjoy --algo eqr_qrdqn --env CartPole-v1 --no-render -n 60 {folder}")
    assert "Episode Reward" in shown or "Mean reward" in shown
    sb3_eqr(f"train --algo eqr_qrdqn --env CartPole-v1 -n 50 --eval-freq -1 -i {saved}/CartPole-v1.zip {folder}")
    assert (tmp_path / "eqr_qrdqn" / "CartPole-v1_2" / "CartPole-v1.zip").exists()


def test_configurations_by_name_and_stock_algorithms(sb3_eqr, tmp_path):
    own = {"CartPole-v1": {"policy": "MlpPolicy", "n_timesteps": 60, "policy_kwargs": {"v_max": 100.0}}}
    (tmp_path / "own.yml").write_text(yaml.dump(own))
    sb3_eqr(f"train --algo eqr_rainbow --env CartPole-v1 --conf-file {tmp_path}/own.yml --eval-freq -1 -f {tmp_path}")
    assert EqRRainbow.load(tmp_path / "eqr_rainbow" / "CartPole-v1_1" / "CartPole-v1.zip").policy.v_max == 100
    assert find_hyperparameters("eqr_rainbow", "eqr_bbf") == str(configuration_files()["eqr_bbf"])
    assert find_hyperparameters("qrdqn", None) is None
    sb3_eqr(f"train --algo dqn --env CartPole-v1 -n 60 --eval-freq -1 -f {tmp_path}")
    assert (tmp_path / "dqn" / "CartPole-v1_1" / "CartPole-v1.zip").exists()


@pytest.mark.parametrize("name", zoo.AGENTS)
def test_the_search_space_makes_agents(name):
    """Every drawn set of parameters builds an agent; the converter gives the same from what the study has stored."""
    zoo.register()
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    groups = set()
    for _ in range(8):
        trial = study.ask()
        sampled = HYPERPARAMS_SAMPLER[name](trial, 2, 1, {})
        assert HYPERPARAMS_CONVERTER[name](trial.params) == sampled
        model = ALGOS[name]("MlpPolicy", "CartPole-v1", buffer_size=100, device="cpu", **sampled)
        groups.add(str(model.policy.group))
        assert model.gradient_steps >= 1 and (name == "eqr_qrdqn") != ("v_max" in sampled["policy_kwargs"])
    assert len(groups) > 1
