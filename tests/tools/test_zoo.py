"""The interface to RL Zoo: registration, hyperparameter files, error messages."""

import errno
import importlib.util
import os
import pathlib
import re
import signal
import subprocess
import sys

import gymnasium as gym
import huggingface_hub
import numpy as np
import optuna
import pytest
import torch as th
import yaml
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_checker import check_env

from sb3_eqr import DISCRETE, EqRQRDQN, EqRRainbow, cli, zoo
from sb3_eqr.cli import COMMANDS
from sb3_eqr.configurations import configuration_files
from sb3_eqr.envs.minatar import ChannelsFirstImage
from sb3_eqr.trust import read_plain, read_trusted
from sb3_eqr.zoo.__main__ import find_hyperparameters, parse
from sb3_eqr.zoo.entries import entry_name
from sb3_eqr.zoo.resuming import ResumableExperiment, RngPreserving, config_of
from tests.toys import ChainEnv, DictEnv, ImageEnv


@pytest.mark.parametrize(
    "line, message",
    [
        ("trian", "Did you mean 'train'?"),
        ("train --algo eqr_ranbow", "Did you mean 'eqr_rainbow'?"),
        ("enjoy --algo eqr_qrdnq", "Did you mean 'eqr_qrdqn'?"),
        ("train --algo eqr_qrdqn --env CartPol-v1", "Did you mean 'CartPole-v1'?"),
        ("train --algo eqr_qrdqn --env Blackjack-v1", r"observation_space must be a Box.*got Tuple\(.*Wrap the"),
        ("train --algo eqr_qrdqn --gym-packages nopackage", "'nopackage' cannot be imported"),
        ("train --algo eqr_qrdqn --env Nope-v0", "gymnasium. Environments of another package need --gym-packages PACKAGE"),
        ("enjoy --algo eqr_qrdqn --env Nope-v0", "gymnasium. Environments of another package need --gym-packages PACKAGE"),
        ("record_video --algo eqr_qrdqn --env Nope-v0 --gym-packages nopackage", "'nopackage' cannot be imported"),
        ("train --algo eqr_qrdqn --env Pendulum-v1 -n 50", r"action space.*use EqRSAC or EqRTQC\.$"),
        ("train --algo eqr_qrdqn --conf-file nofile", "--conf-file must be .* or one of .*eqr_bbf.*, got 'nofile'"),
        ("train --algo eqr_qrdqn --conf-file no.yml", "there is no file 'no.yml'"),
        ("train --algo eqr_rainbow --conf-file stock/qrdqn", "'n_quantiles' is not an argument of EqRRainbow's policy"),
        ("train --algo eqr_qrdqn --conf-file eqr_qrdqn.yml", "no file 'eqr_qrdqn.yml'. Did you mean 'eqr_qrdqn'?"),
        ("train --algo dqn --conf-file stock/qrdqn", "'n_quantiles' is not an argument of DQN's policy"),
        ("train --algo eqr_qrdqn -params n_stepz:3 gamma:0.9", "'n_stepz' is not an .* EqRQRDQN. Did you mean 'n_steps'?"),
        ("train --algo eqr_qrdqn --env MinAtar/Breakot-v1", "Did you mean 'MinAtar/Breakout-v1'?"),
        ("enjoy --algo eqr_qrdqn -f nowhere", "nowhere/eqr_qrdqn/?.* was not found.* train one first"),
        ("enjoy --algo eqr_qrdqn", "was not found.* train one first"),
        ("train --algo eqr_qrdqn --env SlidingBall-v0 --env-kwargs size:20", "SlidingBall-v0: size must be an integer >= 36"),
        ("train --algo eqr_qrdqn -i nothing.zip", "The trained_agent must be a valid path to a .zip file"),
        ("record_video --algo eqr_qrdqn -f nowhere", "was not found.* train one first"),
        ("train --algo eqr_qrdqn -params learning_rate:'1e-3'", "learning_rate must be a number, .*'1e-3', .* write 0.001"),
        ("train --algo eqr_qrdqn -params n_timesteps:'1e5'", "n_timesteps must be a number, .*'1e5', .* write 100000"),
        ("train --algo eqr_qrdqn -params learning_rate:'lin'", "must be .* lin_ and a number, got 'lin'"),
        ("train --algo eqr_qrdqn -params n_blocks:3", r"'n_blocks' is not .* Put it into policy_kwargs: dict\(n_blocks="),
        ("train --algo eqr_qrdqn -params policy_kwargs:dict(aet_coef=1)", "'aet_coef' is not .* Put it beside policy_kwargs"),
        ("train --algo eqr_qrdqn -params env_wrapper:'gymnasium.wrappers.Nope'", "env_wrapper must name .* attribute 'Nope'"),
        ("train --algo eqr_qrdqn -params env_wrapper:'Nope'", "env_wrapper must name .* got 'Nope'"),
        ("train --algo eqr_sac --env Pendulum-v1 -params noise_type:'white'", "noise_type must be one of .*, got 'white'"),
        ("train --algo eqr_sac --env Pendulum-v1 -params noise_type:'normal'", "noise_type needs noise_std, got none"),
        ("train --algo eqr_qrdqn -optimize --checkpoint-every 9", "are for single runs, got a search"),
        ("train --algo ppo --resume nowhere", "--algo must be eqr_qrdqn or eqr_rainbow .*, got ppo"),
        ("train --algo eqr_qrdqn --resume nowhere", "nowhere must be a checkpoint .*, got nothing"),
        ("train --algo eqr_qrdqn -n 0", "-n must be >= 1 step, or -1 for the number in the file, got 0"),
        ("train --algo eqr_qrdqn --checkpoint-every 0", "--checkpoint-every must be >= 1 step, got 0"),
        ("train --algo eqr_qrdqn --device cuda:1", "--device is cuda:1, but PyTorch finds no GPU"),
        ("all_plots -a qrdqn", "all_plots needs -a ALGO ..., -e ENV ... and -f FOLDER"),
        ("all_plots -a qrdqn -e CartPole -f nowhere", "needs runs on CartPole in nowhere/qrdqn, got none"),
    ],
)
def test_wrong_use_prints_an_error(sb3_eqr, line, message):
    assert re.search(message, sb3_eqr(line, code=2).err)


def test_no_settings_are_read_beside_what_is_no_checkpoint(sb3_eqr, tmp_path):
    """Those of another folder, even with ``--trust``, which would run their code."""
    ran, other = tmp_path / "ran", tmp_path / "other"
    other.mkdir()
    for name in ("config.yml", "args.yml"):
        (other / name).write_text(f"!!python/object/apply:os.makedirs [{ran}, 511, true]")
    line = f"train --algo eqr_qrdqn --resume {tmp_path / 'nowhere'} --trust"
    assert "must be a checkpoint" in sb3_eqr(line, code=2).err
    assert not ran.exists()


@pytest.mark.parametrize(
    "package, line, advice",
    [
        ("minatar", "train --algo eqr_qrdqn --env MinAtar/Breakout-v1", "pip install minatar"),
        ("ale_py", "train --algo eqr_qrdqn --env PongNoFrameskip-v4", 'pip install ".[atari]" in a clone of the repository'),
    ],
)
def test_missing_extras_are_named(sb3_eqr, monkeypatch, package, line, advice):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == package else find(name, *rest))
    assert advice in sb3_eqr(line, code=2).err


def test_a_missing_simulator_prints_how_to_install_it(sb3_eqr, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "Box2D", None)
    for name in [name for name in sys.modules if name.startswith("gymnasium.envs.box2d")]:
        monkeypatch.delitem(sys.modules, name)
    assert "gymnasium[box2d]" in sb3_eqr(f"train --algo eqr_qrdqn --env LunarLander-v3 -n 10 -f {tmp_path}", code=2).err


ENTRY = "CartPole-v1: {policy: MlpPolicy, n_timesteps: 100, "


@pytest.mark.parametrize(
    "text, message",
    [
        (f"{ENTRY} learning_rat: 0.1}}", "'learning_rat' is not an argument of EqRQRDQN. Did you mean 'learning_rate'?"),
        (f"{ENTRY} env_wrapper: rl_zoo3.wrappers.HistoryWrapper}}", "Use frame_stack: 4 instead"),
        (f"{ENTRY} normalize: true, frame_stack: 4}}", "RL Zoo normalises before it stacks. Leave one of them out."),
        (f"{ENTRY} policy_kwargs: {{n_block: 3}}}}", "'n_block' is not an argument of EqRQRDQN's policy. Did you mean 'n_bl"),
        (f"{ENTRY} policy_kwargs: dict(n_block=3)}}", "'n_block' is not an argument of EqRQRDQN's policy. Did you mean 'n_bl"),
        (f"{ENTRY} policy_kwargs: dict(n_block=)}}", "cannot be evaluated"),
        (f"{ENTRY} seed: 3}}", "'seed' is not allowed here, because RL Zoo sets it from --seed"),
        ("CartPole-v1: {policy: MlpPolicy}", "the section 'CartPole-v1' needs 'n_timesteps'"),
        ("CartPole-v1:", "the section 'CartPole-v1' needs 'policy'"),
        ("CartPole-v1: {policy: [}", "must be valid YAML"),
        ("", "own.yml must be a mapping, got None"),
    ],
)
def test_invalid_files_print_an_error(sb3_eqr, tmp_path, text, message):
    (tmp_path / "own.yml").write_text(text)
    assert message in sb3_eqr(f"train --algo eqr_qrdqn --env CartPole-v1 --conf-file {tmp_path}/own.yml", code=2).err


def test_options_can_be_abbreviated_as_in_rl_zoo(sb3_eqr, tmp_path):
    """A file passed as --conf is used, and errors are also found in abbreviated options."""
    (tmp_path / "own.yml").write_text("CartPole-v1: {policy: MlpPolicy, n_timesteps: 30, gamma: 0.5}")
    sb3_eqr(f"train --alg eqr_qrdqn --conf {tmp_path}/own.yml --eval-freq -1 -f {tmp_path}")
    assert EqRQRDQN.load(tmp_path / "eqr_qrdqn" / "CartPole-v1_1" / "CartPole-v1.zip").gamma == 0.5
    assert "'n_stepz' is not an argument" in sb3_eqr("train --alg eqr_qrdqn --hyperp n_stepz:3", code=2).err


@pytest.mark.parametrize(
    ("algo", "env_id", "name", "policy"),
    [
        ("eqr_qrdqn", "FrozenLake-v1", "default", "MlpPolicy"),
        ("eqr_qrdqn", "SlidingBall-v0", "default-image", "CnnPolicy"),
        ("eqr_rainbow", "SmallImages-v0", "default-small-image", "CnnPolicy"),
        ("eqr_rainbow", "Dicts-v0", "default-dict", "MultiInputPolicy"),
        ("eqr_sac", "SmallImagesBox-v0", "default-small-image", "CnnPolicy"),
    ],
)
def test_an_environment_without_an_entry_uses_the_one_for_its_observations(
    sb3_eqr, register, tmp_path, algo, env_id, name, policy
):
    register("SmallImages-v0", lambda: ImageEnv((10, 10, 3)))
    register(
        "SmallImagesBox-v0", lambda: gym.wrappers.TransformAction(ImageEnv((10, 10, 3)), len, gym.spaces.Box(-1, 1, (1,)))
    )
    register("Dicts-v0", lambda: gym.wrappers.TimeLimit(DictEnv(), 30))
    out = sb3_eqr(f"train --algo {algo} --env {env_id} -n 90 -params learning_starts:40 --eval-freq -1 -f {tmp_path}").out
    assert (f"Using the section {name!r}" in out) == (name != "default")
    folder = tmp_path / algo / f"{env_id}_1"
    model = zoo.AGENTS[algo].load(folder / f"{env_id}.zip")
    assert model._n_updates > 0 and policy in (folder / env_id / "config.yml").read_text()


def test_an_environment_of_the_file_is_that_of_evaluations(sb3_eqr, tmp_path):
    """RL Zoo evaluates, films and uploads with the arguments of its command line, which args.yml has."""
    settings = "{policy: MlpPolicy, n_timesteps: 20, learning_starts: 100, env_kwargs: {sutton_barto_reward: true}}"
    (tmp_path / "mine.yml").write_text(f"CartPole-v1: {settings}")
    sb3_eqr(f"train --algo eqr_qrdqn --env CartPole-v1 --conf-file {tmp_path}/mine.yml --eval-freq 10 -f {tmp_path}/logs")
    run = tmp_path / "logs" / "eqr_qrdqn" / "CartPole-v1_1"
    assert yaml.unsafe_load((run / "CartPole-v1" / "args.yml").read_text())["env_kwargs"] == {"sutton_barto_reward": True}
    assert set(np.unique(np.load(run / "evaluations.npz")["results"])) <= {-1.0, 0.0}  # not the number of steps


def test_what_was_there_before_is_left_alone(sb3_eqr, tmp_path, monkeypatch):
    """RL Zoo finds no earlier run in a folder with brackets, and reads statistics of VecNormalize in the current folder."""
    run = tmp_path / "seeds[1-5]" / "eqr_qrdqn" / "CartPole-v1_1"
    run.mkdir(parents=True)
    (run / "CartPole-v1.zip").touch()
    sb3_eqr(f"train --algo eqr_qrdqn --env CartPole-v1 -n 60 -f {tmp_path}/seeds[1-5] -params batch_size:0", code=2)
    assert (run / "CartPole-v1.zip").is_file()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "CartPole-v1").mkdir()
    (tmp_path / "CartPole-v1" / "vecnormalize.pkl").write_bytes(b"not a pickle")
    sb3_eqr("train --algo eqr_qrdqn --env CartPole-v1 -n 10 --eval-freq -1 -f logs")


def test_wrappers_decide_which_entry_is_used(capfd):
    entries = {name: {} for name in ("default", "default-image", "default-small-image")}
    small = {"env_wrapper": [{"stable_baselines3.common.atari_wrappers.WarpFrame": {"width": 16, "height": 16}}]}
    assert entry_name(entries, "SlidingBall-v0", {}) == "default-image"
    assert entry_name(entries, "SlidingBall-v0", small) == "default-small-image"
    flat = {"env_wrapper": "gymnasium.wrappers.FlattenObservation"}
    assert entry_name(entries, "SlidingBall-v0", flat) == "default"
    assert entry_name({"default": {}, "default-dict": {}}, "SlidingBall-v0", {}) == "default"
    with pytest.raises(SystemExit):
        entry_name(entries, "SlidingBall-v0", {"env_kwargs": {"size": 20}})
    assert "SlidingBall-v0: size must be an integer >= 36, got 20" in capfd.readouterr().err


def test_a_run_without_a_model_names_those_with_one(sb3_eqr, tmp_path):
    for run, name in ((1, "CartPole-v1.zip"), (3, "best_model.zip"), (4, "notes.txt")):
        folder = tmp_path / "eqr_qrdqn" / f"CartPole-v1_{run}"
        folder.mkdir(parents=True)
        (folder / name).touch()
    shown = sb3_eqr(f"push_to_hub --algo eqr_qrdqn --env CartPole-v1 -f {tmp_path} --dry-run", code=2)
    assert "There are models in 1 and 3: pass --exp-id." in shown.err


def test_other_agents_can_be_trained(sb3_eqr, tmp_path):
    """With policies that are not of this package, and RL Zoo's own files."""
    own = "{policy: MlpLstmPolicy, n_timesteps: 16, n_steps: 8, batch_size: 8, policy_kwargs: {lstm_hidden_size: 8}}"
    (tmp_path / "own.yml").write_text(f"CartPole-v1: {own}")
    sb3_eqr(f"train --algo ppo_lstm --env CartPole-v1 --conf-file {tmp_path}/own.yml --eval-freq -1 -f {tmp_path}")
    assert (tmp_path / "ppo_lstm" / "CartPole-v1_1" / "CartPole-v1.zip").exists()


def test_only_the_settings_of_the_run_that_wrote_the_checkpoints_are_read(tmp_path):
    for folder in ("run/CartPole-v1", "run/checkpoints/checkpoint-1", "other", "mine/checkpoint-1"):
        (tmp_path / folder).mkdir(parents=True)
    for name, gamma in (("run/CartPole-v1", 0.9), ("other", 0.5)):
        (tmp_path / name / "config.yml").write_text(f"gamma: {gamma}")
        (tmp_path / name / "args.yml").write_text("n_timesteps: 7")
    of_run = {"gamma": 0.9, "n_timesteps": 7}
    expected = {
        "run": of_run,
        "run/checkpoints": of_run,
        "run/checkpoints/checkpoint-1": of_run,
        "mine": None,
        "mine/checkpoint-1": None,
    }
    for path, entry in expected.items():
        assert config_of(tmp_path / path, trust=True) == entry, path


def test_an_interrupted_run_is_resumed_exactly(sb3_eqr, tmp_path):
    line = f"train --algo eqr_qrdqn --env CartPole-v1 -n 1300 --eval-freq -1 -f {tmp_path}"
    sb3_eqr(f"{line} --seed 1 --checkpoint-every 500 -params learning_starts:100 gradient_steps:16")
    whole = tmp_path / "eqr_qrdqn" / "CartPole-v1_1"
    refused = sb3_eqr(f"{line} --seed 2 --resume {whole}", code=2)
    assert "leave out --hyperparams, --trained-agent and --seed" in refused.err
    assert "is already at step 1024. Pass -n above 1024." in sb3_eqr(f"{line} -n 500 --resume {whole}", code=2).err
    shown = sb3_eqr(f"{line} --resume {whole}/checkpoints/checkpoint-000000000512").out
    assert "Resuming at step 512" in shown and "Seed: 1\n" in shown
    resumed = tmp_path / "eqr_qrdqn" / "CartPole-v1_2"  # the runs that were refused left no folder
    first, second = (EqRQRDQN.load(folder / "CartPole-v1.zip") for folder in (whole, resumed))
    assert first.num_timesteps == second.num_timesteps == 1408  # a round of 128 steps
    for name, parameter in first.policy.state_dict().items():
        assert th.equal(parameter, second.policy.state_dict()[name]), name
    assert [read_plain(run / "CartPole-v1" / "args.yml")["seed"] for run in (whole, resumed)] == [1, 1]


def test_a_run_is_resumed_with_its_own_settings(sb3_eqr, tmp_path):
    line = f"train --algo eqr_qrdqn --env CartPole-v1 --conf-file eqr_qrdqn --eval-freq 100 --eval-episodes 1 -f {tmp_path}"
    changes = "n_envs:2 gradient_steps:1 gamma:0.9 learning_starts:20 policy_kwargs:dict(activation_fn=th.nn.ELU)"
    sb3_eqr(f"{line} -n 300 --checkpoint-every 100 -params {changes}")
    run = tmp_path / "eqr_qrdqn" / "CartPole-v1_1"
    assert (run / "CartPole-v1.zip").exists() and (run / "best_model.zip").exists()
    assert "pass --trust" in sb3_eqr(f"{line} -n 400 --resume {run}", code=2).err
    sb3_eqr(f"{line} -n 400 --resume {run} --trust")
    resumed = tmp_path / "eqr_qrdqn" / "CartPole-v1_2"
    assert np.load(resumed / "evaluations.npz")["timesteps"].tolist()[:4] == [100, 200, 300, 400]  # also those before
    assert (resumed / "best_model.zip").exists()
    model = EqRQRDQN.load(resumed / "CartPole-v1.zip", trust=True)
    assert (model.n_envs, model.gradient_steps, model.gamma) == (2, 1, 0.9) and model.num_timesteps >= 400
    settings = read_trusted(resumed / "CartPole-v1" / "config.yml")
    assert (settings["n_envs"], settings["gradient_steps"], settings["gamma"]) == (2, 1, 0.9)
    assert read_plain(resumed / "CartPole-v1" / "args.yml")["conf_file"] == "eqr_qrdqn"  # not the temporary file


def test_a_killed_run_is_named_by_enjoy_and_resumed_to_its_own_end(sb3_eqr, tmp_path):
    files = f"--algo eqr_qrdqn --env CartPole-v1 -f {tmp_path}"
    few_updates = "-params learning_starts:20 train_freq:4 gradient_steps:1"
    sb3_eqr(f"train {files} -n 240 --eval-freq -1 --checkpoint-every 100 {few_updates}")
    run = tmp_path / "eqr_qrdqn" / "CartPole-v1_1"
    (run / "CartPole-v1.zip").unlink()  # as if it was killed
    line = f"sb3-eqr train {files} --resume {run}"
    assert line in sb3_eqr(f"enjoy {files} --no-render", code=2).err
    sb3_eqr(line.removeprefix("sb3-eqr "))
    assert EqRQRDQN.load(tmp_path / "eqr_qrdqn" / "CartPole-v1_2" / "CartPole-v1.zip").num_timesteps == 240


def test_agents_with_classes_of_their_own_can_be_played(sb3_eqr, own_extractor, tmp_path, monkeypatch):
    monkeypatch.setitem(ALGOS, "eqr_qrdqn", EqRQRDQN)
    (tmp_path / "own.yml").write_text(f'CartPole-v1: {{policy: MlpPolicy, n_timesteps: 60, policy_kwargs: "{own_extractor}"}}')
    files = f"-f {tmp_path} --algo eqr_qrdqn --env CartPole-v1"
    train = f"train {files} --conf-file {tmp_path}/own.yml --eval-freq -1 -params prediction_depth:0"
    sb3_eqr(train)
    assert re.search(r"my_extractor.*Mine.*pass --trust", sb3_eqr(f"enjoy {files} -n 5 --no-render", code=2).err)
    sb3_eqr(f"enjoy {files} -n 5 --no-render --trust")
    sb3_eqr(f"{train} -i {tmp_path}/eqr_qrdqn/CartPole-v1_1/CartPole-v1.zip --trust")
    again = EqRQRDQN.load(tmp_path / "eqr_qrdqn" / "CartPole-v1_2" / "CartPole-v1.zip", trust=True)
    assert "Mine" in str(again.policy.online.features_extractor)


def test_a_resumed_run_is_evaluated_in_its_own_environment(sb3_eqr, tmp_path, monkeypatch):
    """Also if the command does not repeat --env-kwargs."""
    line = f"train --algo eqr_qrdqn --env FrozenLake-v1 --eval-freq 100 --eval-episodes 1 -f {tmp_path}"
    few_updates = "-params learning_starts:20 train_freq:4 gradient_steps:1"
    sb3_eqr(f"{line} -n 200 --checkpoint-every 100 --env-kwargs is_slippery:False {few_updates}")
    made, create_envs = [], ResumableExperiment.create_envs

    def watched(self, *args, **kwargs):
        made.append(self.eval_env_kwargs if kwargs.get("eval_env") else self.env_kwargs)
        return create_envs(self, *args, **kwargs)

    monkeypatch.setattr(ResumableExperiment, "create_envs", watched)
    run = tmp_path / "eqr_qrdqn" / "FrozenLake-v1_1"
    sb3_eqr(f"{line} -n 240 --resume {run}")
    assert made == [{"is_slippery": False}] * 2
    (run / "FrozenLake-v1" / "args.yml").unlink()
    monkeypatch.chdir(run)
    with pytest.raises(ValueError, match=r"must have args\.yml beside config\.yml"):
        config_of(pathlib.Path("."), trust=True)
    with pytest.raises(ValueError, match=r"must have args\.yml beside config\.yml"):
        config_of(run, trust=True)


class Drawing(BaseCallback):
    """Uses all random generators, as an evaluation with random actions does."""

    def _on_step(self):
        return np.random.rand() + th.rand(1).item() + self.model.action_space.sample() < 10


@pytest.mark.slow
def test_evaluations_of_a_run_with_checkpoints_do_not_change_it():
    def train(callback):
        model = EqRQRDQN("MlpPolicy", ChainEnv(), learning_starts=20, buffer_size=200, batch_size=8, seed=0)
        return model.learn(60, callback).policy.state_dict()

    alone, watched, changed = train(None), train(RngPreserving(Drawing())), train(Drawing())
    assert all(th.equal(value, watched[name]) for name, value in alone.items())
    assert not all(th.equal(value, changed[name]) for name, value in alone.items())


def test_a_disk_that_cannot_be_written_prints_an_error(sb3_eqr, tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(tmp_path))

    monkeypatch.setattr("os.makedirs", refuse)
    shown = sb3_eqr(f"train --algo eqr_qrdqn --env CartPole-v1 -f {tmp_path}", code=2)
    assert f"train: [Errno 30] Read-only file system: '{tmp_path}'. Free some space, or pass another" in shown.err


def test_an_entry_of_ones_own(sb3_eqr, tmp_path):
    (tmp_path / "own.yml").write_text(f"{ENTRY} frame_stack: 3, policy_kwargs: {{v_max: 100.0}}}}")
    sb3_eqr(f"train --algo eqr_rainbow --env CartPole-v1 --conf-file {tmp_path}/own.yml --eval-freq -1 -f {tmp_path}")
    model = EqRRainbow.load(tmp_path / "eqr_rainbow" / "CartPole-v1_1" / "CartPole-v1.zip")
    assert model.policy.v_max == 100 and model.observation_space.shape == (3 * 4,)


def test_a_signal_to_end_saves_the_agent_and_one_before_training_leaves_no_folder(sb3_eqr, tmp_path, monkeypatch):
    line = f"train --algo eqr_qrdqn --env CartPole-v1 -n 900 -params learning_starts:100 --eval-freq -1 -f {tmp_path}"
    monkeypatch.setattr(EqRQRDQN, "train", lambda *_, **__: signal.raise_signal(signal.SIGTERM))
    shown = sb3_eqr(line)
    assert "EqRQRDQN: SO(3)^12, euler; auxiliary losses: AET 2. Set by the hyperparameters: " in shown.out
    model = EqRQRDQN.load(tmp_path / "eqr_qrdqn" / "CartPole-v1_1" / "CartPole-v1.zip")
    assert 100 < model.num_timesteps < 900
    monkeypatch.setattr(EqRQRDQN, "_setup_model", lambda *_: signal.raise_signal(signal.SIGTERM))
    sb3_eqr(line, code=130)
    assert not (tmp_path / "eqr_qrdqn" / "CartPole-v1_2").exists()


def test_a_trial_that_diverges_is_pruned_and_does_not_end_the_search(monkeypatch):
    def diverge(self, trial):
        raise FloatingPointError("losses must be finite")

    monkeypatch.setattr(ResumableExperiment.__base__, "objective", diverge)
    study = optuna.create_study()
    study.optimize(object.__new__(ResumableExperiment).objective, n_trials=2)
    assert [trial.state.name for trial in study.trials] == ["PRUNED"] * 2


def test_the_name_of_a_repository_is_not_a_number_of_steps():
    assert parse(["--algo", "eqr_qrdqn", "-orga", "us", "-name", "mine"]).n_timesteps == -1


def test_configurations_by_name_and_stock_algorithms():
    assert find_hyperparameters("eqr_rainbow", "eqr_bbf") == str(configuration_files()["eqr_bbf"])
    assert find_hyperparameters("qrdqn", None) is None


@pytest.mark.parametrize("name", zoo.AGENTS)
def test_the_search_space_makes_agents(name):
    """Every sample of parameters builds an agent, and the converter restores the sample from the study."""
    zoo.register(policy_kwargs={"log_std": 1, "group": "T(2)", "n_blocks": 4})  # the search keeps the first, not the second
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    groups = set()
    for _ in range(8):
        trial = study.ask()
        sampled = HYPERPARAMS_SAMPLER[name](trial, 2, 1, {"using_her_replay_buffer": False})
        assert HYPERPARAMS_CONVERTER[name](trial.params) == sampled and sampled["policy_kwargs"]["log_std"] == 1
        del sampled["policy_kwargs"]["log_std"]
        env = "CartPole-v1" if name in DISCRETE else "Pendulum-v1"
        model = ALGOS[name]("MlpPolicy", env, buffer_size=100, device="cpu", **sampled)
        groups.add(str(model.policy.options.group))
        assert model.gradient_steps >= 1 and (name == "eqr_rainbow") == ("v_max" in sampled["policy_kwargs"])
    assert len(groups) > 1


@pytest.mark.slow
def test_the_flags_of_rl_zoo_together(sb3_eqr, tmp_path):
    """Training, playing and resuming with subprocesses, normalisation, TensorBoard, checkpoints and a saved buffer."""
    wrappers = "[{rl_zoo3.wrappers.DelayedRewardWrapper: {delay: 2}}, rl_zoo3.wrappers.MaskVelocityWrapper]"
    entry = f"{{policy: MlpPolicy, n_timesteps: 200, n_envs: 2, normalize: true, env_wrapper: {wrappers}, "
    entry += "learning_starts: 50, learning_rate: lin_0.001, policy_kwargs: 'dict(net_arch=[16])'}"
    (tmp_path / "own.yml").write_text(f"CartPole-v1: {entry}")
    base = f"--algo eqr_qrdqn --env CartPole-v1 -f {tmp_path} --num-threads 1"
    train = f"train {base} --conf-file {tmp_path}/own.yml --vec-env subproc --eval-freq 100 --eval-episodes 1 --seed 3"
    sb3_eqr(f"{train} -P --save-replay-buffer --save-freq 100 -tb {tmp_path}/tb")
    run = tmp_path / "eqr_qrdqn" / "CartPole-v1_1"
    model = EqRQRDQN.load(run / "CartPole-v1.zip")
    assert model.n_envs == 2 and model.num_timesteps == 200
    assert (run / "rl_model_200_steps.zip").exists() and (run / "CartPole-v1" / "vecnormalize.pkl").exists()
    assert list((tmp_path / "tb").rglob("events.*"))
    assert "Loading" in sb3_eqr(f"enjoy {base} --no-render -n 30").out
    shown = sb3_eqr(f"{train} -n 100 -i {run}/CartPole-v1.zip -params learning_starts:0 exploration_initial_eps:0.05").out
    assert "Loading replay buffer" in shown and "Loading saved VecNormalize stats" in shown
    continued = EqRQRDQN.load(tmp_path / "eqr_qrdqn" / "CartPole-v1_2" / "CartPole-v1.zip")
    assert continued.num_timesteps == 100 and continued._n_updates == model._n_updates + 100  # two steps, two updates


def run_sb3_eqr(line, folder, **environment):
    """Run a command line in its own process."""
    command = [sys.executable, "-m", "sb3_eqr.zoo", *line.split()]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **environment}
    return subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


@pytest.mark.slow
def test_two_processes_share_one_search(tmp_path):
    """Trials are shared; none is lost or repeated."""
    line = "train --algo eqr_qrdqn --env CartPole-v1 -n 120 -params learning_starts:100 -optimize --max-total-trials 6 "
    line += "--n-trials 6 --n-evaluations 2 --eval-episodes 1 --storage search.log --study-name s --no-optim-plots -f logs"
    processes = [run_sb3_eqr(f"{line} --seed {seed}", tmp_path) for seed in (1, 2)]
    shown = [process.communicate(timeout=200)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], shown
    storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(tmp_path / "search.log")))
    trials = optuna.load_study(study_name="s", storage=storage).trials
    assert {trial.state for trial in trials} <= {optuna.trial.TrialState.COMPLETE, optuna.trial.TrialState.PRUNED}
    told = [int(number) for text in shown for number in re.findall(r"Trial (\d+) (?:finished|pruned)", text)]
    assert len(trials) >= 6 and sorted(told) == list(range(len(trials)))  # each one once, in one of the two processes


@pytest.mark.slow
def test_weights_and_biases_offline(tmp_path):
    pytest.importorskip("wandb")
    line = "train --algo eqr_qrdqn --env CartPole-v1 -n 1100 --eval-freq -1 --track --wandb-project-name eqr -f logs"
    process = run_sb3_eqr(line, tmp_path, WANDB_MODE="offline", WANDB_SILENT="true")
    shown, _ = process.communicate(timeout=200)
    assert process.returncode == 0, shown
    assert list((tmp_path / "wandb").glob("offline-run-*/run-*.wandb"))
    assert list((tmp_path / "runs").rglob("events.*"))


def test_pushing_to_the_hub_and_loading_from_it(sb3_eqr, tmp_path, monkeypatch):
    """A video, and the folder for the Hub with model card, video, model and settings."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    base = "--algo eqr_qrdqn --env CartPole-v1"
    assert str(configuration_files()["eqr_qrdqn"]) in sb3_eqr(f"train {base} -n 64 --eval-freq -1").out
    sb3_eqr(f"record_video {base} -f logs -n 20 -o videos")
    assert [path.suffix for path in (tmp_path / "videos").iterdir() if path.stat().st_size > 1000] == [".mp4"]
    assert "nothing was uploaded" in sb3_eqr(f"push_to_hub {base} -f logs -n 20 -orga us --dry-run").out
    folder = tmp_path / "hub" / "eqr_qrdqn-CartPole-v1"
    names = {path.name for path in folder.iterdir()}
    assert {"README.md", "replay.mp4", "eqr_qrdqn-CartPole-v1.zip", "config.yml", "args.yml", "results.json"} <= names
    card = (folder / "README.md").read_text()
    head = yaml.safe_load(card.split("---")[1])
    assert head["library_name"] == "stable-baselines3" and "sb3-eqr" in head["tags"]
    assert head["model-index"][0]["name"] == "EqRQRDQN"
    assert "sb3-eqr enjoy --algo eqr_qrdqn" in card and "rl_zoo3" not in card
    assert EqRQRDQN.load(folder / "eqr_qrdqn-CartPole-v1.zip").num_timesteps == 128  # a round

    # Downloading, with the folder in place of the Hub.
    fetch = f"load_from_hub {base} -f fetched -orga us"
    assert "TRUST_REMOTE_CODE=True sb3-eqr" in sb3_eqr(fetch, code=2).err and "TRUST_REMOTE_CODE=True sb3-eqr" in card

    def download(repo_id, filename, **_):
        assert repo_id == "us/eqr_qrdqn-CartPole-v1"
        if not (folder / filename).exists():
            raise huggingface_hub.errors.LocalEntryNotFoundError(filename)
        return str(folder / filename)

    monkeypatch.setenv("TRUST_REMOTE_CODE", "True")
    monkeypatch.setattr(huggingface_hub, "hf_hub_download", download)
    sb3_eqr(fetch)
    shown = sb3_eqr(f"enjoy {base} --no-render -n 60 -f fetched").out
    assert "Loading" in shown and ("Episode Reward" in shown or "Mean reward" in shown)


@pytest.mark.parametrize("env_id", ["MinAtar/Breakout-v1", "BlindCliffwalk-v0"])
def test_environments_can_be_rendered(env_id):
    """Every frame is uint8 and not blank."""
    env = gym.make(env_id, render_mode="rgb_array")
    if env_id.startswith("MinAtar"):
        env = ChannelsFirstImage(env)
        assert env.observation_space.shape[1:] == (10, 10) and env.reset(seed=0)[0].max() == 255
    env.reset(seed=0)
    picture = env.render()
    assert picture.dtype == np.uint8 and picture.shape in ((320, 320, 3), (32, 320, 3))
    assert picture.max() > 200 and picture.min() < 100
    assert picture[0, 0].tolist() == picture[31, 31].tolist()  # one cell is 32 pixels wide
    check_env(env.unwrapped if env_id == "BlindCliffwalk-v0" else env, skip_render_check=True)


@pytest.mark.slow
def test_hyperparameter_search_on_minatar(sb3_eqr, tmp_path):
    """The search keeps the entry's small encoder, because Atari's has filters larger than these images."""
    line = "train --algo eqr_rainbow --env MinAtar/Breakout-v1 -n 30 --seed 1 -params learning_starts:25 buffer_size:100"
    line += f" -optimize --n-evaluations 1 --eval-episodes 1 --no-optim-plots -f {tmp_path}"
    shown = sb3_eqr(f"{line} --max-total-trials 1 --study-name a --storage sqlite:///{tmp_path}/a.db")
    assert "Number of finished trials:  1" in shown.out
    entry = yaml.safe_load(shown.out.partition("As a file for --conf-file:")[2])["MinAtar/Breakout-v1"]
    assert entry["policy"] == "CnnPolicy" and "n_timesteps" in entry  # also what was not searched,
    assert entry["learning_starts"] == 25  # and what the command line changed
    layers = {"features_extractor_kwargs": {"layers": [[16, 3, 1]]}}
    assert entry["policy_kwargs"].items() >= layers.items() and {"gamma", "gradient_steps"} <= entry.keys()
    assert [path.suffix for path in (tmp_path / "eqr_rainbow").iterdir() if path.is_dir()] == []  # no run to play
    again = sb3_eqr(f"{line} --max-total-trials 1 --study-name a --storage sqlite:///{tmp_path}/a.db")  # has finished
    assert yaml.safe_load(again.out.partition("As a file for --conf-file:")[2])["MinAtar/Breakout-v1"] == entry


def test_the_command_without_rl_zoo(monkeypatch):
    """Prints one line instead of a traceback."""
    for name in [name for name in sys.modules if name.startswith("sb3_eqr.zoo")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rl_zoo3.import_envs", None)
    monkeypatch.setattr(sys, "argv", ["sb3-eqr", "train"])
    with pytest.raises(SystemExit, match=r'sb3-eqr: .*pip install "\.\[zoo\]" in a clone of the repository'):
        cli.main()


def test_the_help_lists_every_command(sb3_eqr):
    """With what it does; an unknown command or option gets the closest one."""
    lines = [line for line in sb3_eqr("--help").out.splitlines() if line.startswith("  ")]
    assert [line.split()[0] for line in lines[:-2]] == [*COMMANDS["zoo"], "benchmark", "visualize"]
    assert "got 'tran'. Did you mean 'train'?" in sb3_eqr("tran", code=2).err
    assert "--agets a. Did you mean '--agents'?" in sb3_eqr("benchmark run x --agets a", code=2).err


@pytest.mark.slow
def test_plots_with_a_stock_agent(sb3_eqr, tmp_path, monkeypatch):
    import matplotlib.pyplot

    matplotlib.use("Agg")
    monkeypatch.setattr("matplotlib.pyplot.show", matplotlib.pyplot.show)  # so that it is restored
    monkeypatch.chdir(tmp_path)
    line = "--env CartPole-v1 -n 64 --eval-freq 32 --eval-episodes 2"
    for algo in ("eqr_qrdqn", "qrdqn", "eqr_qrdqn", "qrdqn"):
        sb3_eqr(f"train --algo {algo} {line}")
    table = sb3_eqr("all_plots -a eqr_qrdqn qrdqn -e CartPole-v1 -f logs --no-million --no-display -o results").out
    assert re.search(r"CartPole-v1\W+\d+ \+/- \d+\W+\d+ \+/- \d+", table)
    sb3_eqr("plot_from_file -i results -o curves.png --format png --no-million")
    assert (tmp_path / "curves.png").stat().st_size > 5_000
    sb3_eqr("plot_train -a eqr_qrdqn -e CartPole-v1 -f logs -w 2")
    sb3_eqr("all_plots -a eqr_qrdqn qrdqn -e CartPole-v1 -f logs")
    assert (tmp_path / "all_plots-1.png").stat().st_size > 5_000  # saved, because there is no display
    sb3_eqr(f"train --algo dqn {line[:-1]}1")
    shown = sb3_eqr("all_plots -a dqn -e CartPole-v1 -f logs --no-display", code=2)
    assert "two evaluations of two episodes each" in shown.err
