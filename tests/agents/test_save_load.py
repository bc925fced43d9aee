"""Saving, loading, resuming, and wrong or damaged files."""

import base64
import io
import json
import pathlib
import pickle
import sys
import warnings
import zipfile
from copy import deepcopy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import QRDQN
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_eqr import EqRQRDQN, EqRRainbow, SequenceReplayBuffer
from sb3_eqr.common.saving.files import seal
from tests.models import EITHER, MAKERS, POLICIES, loss_terms, same, tensors
from tests.toys import ChainEnv, ImageEnv


def same_moments(*models):
    one, other = (model.policy.optimizer.state_dict()["state"] for model in models)
    return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)


@EITHER
@POLICIES
@pytest.mark.parametrize("switches", [{}, {"policy_kwargs": {"noisy": False, "dueling": False}, "prediction_depth": 0}])
def test_save_and_load(make, policy, env, switches, tmp_path):
    model = make(env(), policy, **switches).learn(46)
    observations = model.get_env().reset()
    actions, _ = model.predict(observations, deterministic=True)
    model.save(tmp_path / "model.zip")
    loaded = make.algorithm.load(tmp_path / "model.zip", env=env())
    assert same(model, loaded) and np.array_equal(loaded.predict(observations, deterministic=True)[0], actions)
    assert model.policy.optimizer.state_dict()["param_groups"] == loaded.policy.optimizer.state_dict()["param_groups"]
    assert same_moments(model, loaded)
    loaded.learn(44)  # training continues
    model.policy.save(str(tmp_path / "policy"))
    model.policy.online.save(str(tmp_path / "net"))
    alone = type(model.policy).load(str(tmp_path / "policy"))
    assert type(alone) is type(model.policy) and same(model, alone)
    for part in (make.algorithm.load(tmp_path / "model"), alone, type(model.policy.online).load(str(tmp_path / "net"))):
        assert np.array_equal(part.predict(observations, deterministic=True)[0], actions)


def test_save_and_load_by_file_object(make, model):
    model.save(file := io.BytesIO())
    model.save_replay_buffer(buffer := io.BytesIO())
    file.seek(0)
    buffer.seek(0)
    loaded = make.algorithm.load(file, env=ChainEnv())
    assert same(model, loaded)
    loaded.load_replay_buffer(buffer)
    assert loaded.replay_buffer.size() == 46


@EITHER
def test_checkpoints_made_in_the_middle_of_a_step_can_be_resumed(make, tmp_path):
    make(ChainEnv()).learn(120, callback=CheckpointCallback(50, str(tmp_path), save_replay_buffer=True))
    model = make.algorithm.load(tmp_path / "rl_model_100_steps", env=ChainEnv())
    model.load_replay_buffer(tmp_path / "rl_model_replay_buffer_100_steps")
    model.learn(50, reset_num_timesteps=False)
    assert model.num_timesteps == 150 and model.replay_buffer.size() == 99 + 50
    assert model.replay_buffer.timeouts[98, 0] or model.replay_buffer.dones[98, 0]  # the episode was truncated there


def test_attributes_can_be_excluded_and_added(make, tmp_path):
    model = make(ChainEnv())
    model.save(tmp_path / "a", exclude=["learning_rate"])
    model.custom = 3
    model.save(tmp_path / "b", exclude=["custom"])
    assert not hasattr(make.algorithm.load(tmp_path / "b"), "custom")
    model.save(tmp_path / "c")
    assert make.algorithm.load(tmp_path / "c").custom == 3


@EITHER
def test_options_can_be_changed_on_loading(make, tmp_path):
    make(ChainEnv()).save(tmp_path / "model")
    loaded = make.algorithm.load(tmp_path / "model", env=ChainEnv(), prioritized_replay=False, n_steps=5)
    assert type(loaded.replay_buffer) is SequenceReplayBuffer
    loaded.learn(46)
    assert loaded.replay_buffer.n_steps == 5
    off = ({"symmetry_coef": 0.0}, {"reward_coef": 0.0}, {"prediction_depth": 0}, {"aet_coef": 0.0, "double_q": False})
    for change in off:
        make.algorithm.load(tmp_path / "model", env=ChainEnv(), **change).learn(46)
    make(ChainEnv(), prediction_depth=0).save(tmp_path / "plain")
    richer = make.algorithm.load(tmp_path / "plain", env=ChainEnv(), prediction_depth=3).learn(46)
    assert loss_terms(richer, richer.replay_buffer.sample(8)).losses["aet"].shape == (8,)


def test_a_different_seed_can_be_passed_to_load(make, tmp_path):
    make(ChainEnv(), seed=0).learn(50).save(tmp_path / "model")
    draws = []
    for kwargs in ({}, {}, {"seed": 1}, {"seed": 2}):
        make.algorithm.load(tmp_path / "model", env=ChainEnv(), **kwargs)
        draws.append((np.random.random(), th.rand(1).item()))
    assert draws[0] == draws[1] and len(set(draws)) == 3


def test_set_env_and_different_numbers_of_environments(make, tmp_path):
    model = make(make_vec_env(ChainEnv, 2)).learn(46)
    model.set_env(make_vec_env(ChainEnv, 2))
    model.learn(60, reset_num_timesteps=False)
    model.save(tmp_path / "model")
    loaded = make.algorithm.load(tmp_path / "model", env=make_vec_env(ChainEnv, 3))
    loaded.learn(46)
    with pytest.raises(AssertionError, match="number of environments"):
        loaded.set_env(make_vec_env(ChainEnv, 2))
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        make.algorithm.load(tmp_path / "model", env=ImageEnv())


def test_set_parameters(make, model, tmp_path):
    other, third = make(ChainEnv(), seed=1), make(ChainEnv(), seed=2)
    assert not same(model, other)
    other.set_parameters(model.get_parameters())
    model.save(tmp_path / "model")
    third.set_parameters(str(tmp_path / "model"))
    assert same(model, other) and same(model, third)

    parameters = model.get_parameters()
    missing = deepcopy(parameters)
    name = next(name for name in missing["policy"] if name.startswith("latent_model.transition"))
    del missing["policy"][name]
    with pytest.raises(RuntimeError, match="Missing key"):
        other.set_parameters(missing)
    other.set_parameters(missing, exact_match=False)
    wider = make(ChainEnv(), policy_kwargs={"latent_hidden_dim": 24})
    before = tensors(wider)
    with pytest.raises(RuntimeError, match="size mismatch"):
        wider.set_parameters(parameters)
    assert same(before, wider)  # a call that fails changes nothing


@EITHER
def test_the_optimisers_averages_get_the_memory_layout_of_their_parameters(make):
    """PyTorch's fused Adam reads both in the order of memory."""
    model = make(ImageEnv(), "CnnPolicy").learn(44)
    parameters = deepcopy(model.get_parameters())
    expected = [state["exp_avg"].clone() for state in parameters["policy.optimizer"]["state"].values()]
    for state in parameters["policy.optimizer"]["state"].values():
        state["exp_avg"] = state["exp_avg"].contiguous()
    model.set_parameters(parameters)
    found = {p: state["exp_avg"] for p, state in model.policy.optimizer.state.items()}
    assert any(not p.is_contiguous() for p in found)  # channels last
    assert [p.stride() for p in found] == [average.stride() for average in found.values()]
    assert same(list(found.values()), expected)


def is_copied(name):
    """Batch norm's statistics, and counts; the running mean of features is averaged as parameters are."""
    return "running_" in name and not name.endswith("center.running_mean")


def test_after_another_dtype_targets_follow_the_new_tensors(make):
    model = make(ChainEnv(), tau=0.25, policy_kwargs={"latent_norm": "batch", "latent_tau": None}).learn(44)
    policy = model.policy.double()
    with th.no_grad():
        for online, _ in policy.target_copy.pairs:
            for name, statistic in online.named_buffers():
                statistic.add_("running_" in name)  # or the copies would be equal anyway
    states = [(online.state_dict(), copy.state_dict()) for online, copy in policy.target_copy.pairs]
    expected = [
        {name: online[name].clone() if is_copied(name) else 0.75 * value + 0.25 * online[name] for name, value in copy.items()}
        for online, copy in states
    ]
    policy.update_target(0.25)
    n_statistics = n_averaged = 0
    for (_, copy), values in zip(states, expected, strict=True):
        for name, value in values.items():
            n_statistics += is_copied(name)
            n_averaged += name.endswith("center.running_mean")
            if "num_batches" not in name:
                th.testing.assert_close(copy[name], value, msg=name)
    assert n_statistics > 0 and n_averaged > 0


def test_a_loaded_replay_buffer_keeps_the_models_beta(make, tmp_path):
    make(ChainEnv()).learn(46).save_replay_buffer(tmp_path / "buffer")
    model = make(ChainEnv(), replay_buffer_kwargs={"beta": 0.9, "final_beta": 0.8})
    with pytest.warns(UserWarning, match="saved at step 46"):
        model.load_replay_buffer(tmp_path / "buffer")
    model.learn(60)
    assert model.replay_buffer.beta == pytest.approx(0.8, abs=0.02)


def test_a_resumed_run_equals_an_uninterrupted_one(make, tmp_path):
    """Saved after 80 of 160 steps, with one reset before and one after, while n, γ, ε and the learning rate are annealed."""
    resets = {"interval": 30, "initial_n_steps": 6, "initial_gamma": 0.9, "annealing_steps": 45}
    network = {"act_with_target": True, "optimizer_class": "AdamW", "optimizer_kwargs": {"weight_decay": 0.1}}
    settings = {"buffer_size": 120, "exploration_fraction": 0.8, "learning_rate": lambda p: 1e-3 * p, "tau": 0.05}
    whole = make(make_vec_env(ChainEnv, 2), **settings, resets=resets, policy_kwargs=network)
    states = []

    class Save(BaseCallback):
        """Between two rounds of the training loop, after an update and before the next step."""

        def _on_rollout_start(self):
            if self.num_timesteps == 80:
                whole.save(tmp_path / "model")
                whole.save_replay_buffer(tmp_path / "buffer")
                states.extend(whole.get_env().env_method("state_dict"))

        def _on_step(self):
            return True

    whole.learn(160, Save())
    env = make_vec_env(ChainEnv, 2)
    env.reset()  # Monitor requires it
    for index, state in enumerate(states):
        env.env_method("load_state_dict", state, indices=index)
    model = make.algorithm.load(tmp_path / "model", env, "cpu", force_reset=False, trust=True)  # it has a pickled lambda
    model.load_replay_buffer(tmp_path / "buffer")
    assert model._resets.done == [30] and not same(model, whole)
    model.learn(80, reset_num_timesteps=False)
    assert model.num_timesteps == 160 and model._n_updates == whole._n_updates and model._resets.done == [30, 60, 90]
    assert same(model, whole) and same_moments(model, whole)


# ---------------------------------------------------------------------------------------------- wrong files


def test_a_file_of_another_class(make, tmp_path):
    for algorithm in (QRDQN, DQN):
        algorithm("MlpPolicy", ChainEnv(), buffer_size=100, device="cpu").save(tmp_path / "stock")
        for trust in (False, True):  # the error must not suggest trusting a file that cannot be loaded
            with pytest.raises(ValueError, match=r"stock must be a file written by EqR\w+\.save, got an agent .* of \S+qn"):
                make.algorithm.load(tmp_path / "stock", env=ChainEnv(), trust=trust)


def test_the_agents_reject_each_others_files(tmp_path):
    EqRQRDQN("MlpPolicy", ChainEnv(), buffer_size=100, device="cpu").save(tmp_path / "quantiles")
    with pytest.raises(ValueError, match=r"policy must be derived from EqRRainbowPolicy, got .*EqRQRDQNPolicy"):
        EqRRainbow.load(tmp_path / "quantiles")


def test_parameters_for_another_support(tmp_path):
    MAKERS[1](ChainEnv()).save(tmp_path / "model")
    other = MAKERS[1](ChainEnv(), policy_kwargs={"v_max": 100.0})
    with pytest.raises(ValueError, match=r"support: .* for '\[-10.0, 100.0\]', got parameters for '\[-10.0, 10.0\]'"):
        other.set_parameters(str(tmp_path / "model"))
    other.save(tmp_path / "other")
    loaded = EqRRainbow.load(tmp_path / "other")
    assert (loaded.policy.v_min, loaded.policy.v_max) == (-10, 100) and loaded.q_net.support[-1] == 100


def test_parameters_of_another_group(make, tmp_path):
    """SE(2) with 4 blocks and GL(2) with 3 blocks have Lie algebras of the same size."""
    model = make(ChainEnv(), policy_kwargs={"group": "SE(2)", "n_blocks": 4}, prediction_depth=0)
    other = make(ChainEnv(), policy_kwargs={"group": "T(2)", "n_blocks": 18}, prediction_depth=0)
    twisted = make(ChainEnv(), policy_kwargs={"group": "SE(2)", "n_blocks": 4, "parameterization": "exp"}, prediction_depth=0)
    model.save(tmp_path / "model")
    for wrong in (other, twisted):
        before = tensors(wrong)
        with pytest.raises(ValueError, match=r"group: parameters must be for .*, got parameters for 'SE\(2\)\^4, euler'"):
            wrong.set_parameters(str(tmp_path / "model"))
        assert same(before, wrong)
    with pytest.raises(ValueError, match="policy kwargs"):
        make.algorithm.load(tmp_path / "model", policy_kwargs={"group": "T(2)"})
    with pytest.raises(ValueError, match="got parameters for 'SE"):
        make.algorithm.load(tmp_path / "model", custom_objects={"policy_kwargs": other.policy_kwargs})


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_truncated_files(make, model, share, tmp_path):
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    for name in ("model.zip", "buffer.pkl"):
        content = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(content[: int(len(content) * share)])
    with pytest.raises(ValueError, match="truncated"):
        make.algorithm.load(tmp_path / "model")
    buffer = model.replay_buffer
    with pytest.raises(ValueError, match="must be a complete replay buffer written by"):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is buffer


def test_a_flipped_byte_is_detected_anywhere(model, tmp_path):
    model.save_replay_buffer(tmp_path / "buffer")
    path, buffer = tmp_path / "buffer.pkl", model.replay_buffer
    content = path.read_bytes()
    rewards = buffer.rewards.tobytes()
    assert rewards in content
    for place in [content.index(rewards) + k for k in range(0, len(rewards), 37)]:
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        with pytest.raises(ValueError, match="it has changed since it was saved"):
            model.load_replay_buffer(path)
    assert model.replay_buffer is buffer


def test_a_loaded_replay_buffer_replaces_the_models(model, tmp_path):
    """Also in a model without one; it warns if the file is from another step."""
    model.save_replay_buffer(tmp_path / "buffer")
    old, model.replay_buffer = model.replay_buffer, None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(2):
            model.load_replay_buffer(tmp_path / "buffer")
            for name in ("actions", "rewards", "dones", "timeouts"):
                assert np.array_equal(getattr(old, name), getattr(model.replay_buffer, name))
    model.learn(4, reset_num_timesteps=False)
    with pytest.warns(UserWarning, match="saved at step 46, but the model is at step 50"):
        model.load_replay_buffer(tmp_path / "buffer")


def test_a_replay_buffer_of_another_size_and_several_environments_loads(make, tmp_path):
    """Eight environments, and eight transitions of each in the buffer that loads, sixteen in the saved one."""
    large, small = (make(make_vec_env(ChainEnv, 8), buffer_size=np.int64(8 * n), learning_starts=200) for n in (16, 8))
    large.learn(64).save_replay_buffer(tmp_path / "buffer")
    with pytest.warns(UserWarning, match="saved at step 64"):
        small.load_replay_buffer(tmp_path / "buffer")
    assert small.replay_buffer.buffer_size == 16
    assert np.array_equal(small.replay_buffer._episode_starts, large.replay_buffer._episode_starts)


class Runs:
    def __reduce__(self):
        return pathlib.Path.touch, (pathlib.Path("ran"),)


def members_of(path):
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def rewrite(source, path, **changes):
    """Change members of a zip file, and seal it again, as an attacker can."""
    members = members_of(source) | changes
    with open(path, "wb+") as file:
        with zipfile.ZipFile(file, "w") as archive:
            for name, content in members.items():
                archive.writestr(name, content)
        seal(file)


def test_loading_executes_no_code(make, model, tmp_path, monkeypatch):
    """Pickles in place of every file, and inside a model."""
    monkeypatch.chdir(tmp_path)
    model.save("model")
    evil = pickle.dumps(Runs())
    data = json.loads(members_of("model.zip")["data"])
    forged = {":serialized:": base64.b64encode(evil).decode()}
    for name in ("policy_class", "verbose", "anything"):
        rewrite("model.zip", "forged.zip", data=json.dumps({**data, name: forged}))
        for load in (make.algorithm.load, lambda path: make.algorithm.load(path, env=ChainEnv())):
            with pytest.raises(ValueError, match="pass trust=True"):
                load("forged")
        model.set_parameters("forged")  # does not read attributes
        model.load_representation("forged")
    rewrite("model.zip", "weights.zip", **{"policy.pth": evil})
    for load in (make.algorithm.load, model.set_parameters, model.load_representation):
        with pytest.raises(Exception, match=r"weights_only|Weights only"):
            load("weights")
    pathlib.Path("buffer.pkl").write_bytes(evil)
    with pytest.raises(ValueError, match="pass trust=True"):
        model.load_replay_buffer("buffer")
    with open("buffer.pkl", "wb") as file:
        np.savez(file, data=np.array([Runs()], dtype=object))
    with pytest.raises(ValueError, match=r"must be a complete replay buffer written by .*another zip file"):
        model.load_replay_buffer("buffer")
    assert not pathlib.Path("ran").exists()
    make.algorithm.load("forged", trust=True)
    assert pathlib.Path("ran").exists()


def test_a_buffer_of_more_environments_is_named(make, model, tmp_path):
    make(make_vec_env(ChainEnv, 2)).save_replay_buffer(tmp_path / "two")
    with pytest.raises(ValueError, match="n_envs must be 1, the agent's number of environments, got 2"):
        model.load_replay_buffer(tmp_path / "two")


def test_files_that_are_not_replay_buffers_of_this_package(make, model, tmp_path):
    QRDQN("MlpPolicy", ChainEnv(), buffer_size=100, device="cpu").save_replay_buffer(tmp_path / "stock")
    make(ImageEnv(), "CnnPolicy").save_replay_buffer(tmp_path / "images")
    relative = next(maker for maker in MAKERS if maker is not make)
    relative(ChainEnv()).save_replay_buffer(tmp_path / "relative")
    for name in ("stock", "images", "relative"):
        with pytest.raises(ValueError, match=r"must be a (complete )?replay buffer"):
            model.load_replay_buffer(tmp_path / name, trust=True)
        assert model.replay_buffer.size() == 46
    for other in ({"prioritized_replay": False}, {"replay_buffer_kwargs": {"alpha": 0.9}}):
        make(ChainEnv(), **other).save_replay_buffer(tmp_path / "other")
        with pytest.raises(ValueError, match=r"must be a (complete )?replay buffer"):
            model.load_replay_buffer(tmp_path / "other")


def test_a_save_that_fails_leaves_the_old_file(make, tmp_path, monkeypatch):
    model = make(ChainEnv())
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def break_off(*args, **kwargs):
        raise OSError("No space left on device")

    monkeypatch.setattr(th, "save", break_off)
    monkeypatch.setattr(zipfile.ZipFile, "open", break_off)
    for save in (model.save, model.save_replay_buffer):
        with pytest.raises(OSError, match="No space"):
            save(tmp_path / ("model" if save == model.save else "buffer"))
    assert before == {path.name: path.read_bytes() for path in tmp_path.iterdir()}


@EITHER
@pytest.mark.parametrize("as_object", [False, True])
def test_a_file_cannot_name_an_environment_to_make(make, as_object, tmp_path):
    """``gym.make`` imports the module in "module:Name-v0"."""
    make(ChainEnv()).save(path := tmp_path / "model.zip")
    data = json.loads(members_of(path)["data"])
    rewrite(path, path, data=json.dumps({**data, "env": "antigravity:CartPole-v1"}))
    loaded = make.algorithm.load(io.BytesIO(path.read_bytes()) if as_object else path)
    assert loaded.env is None and "antigravity" not in sys.modules


@EITHER
@pytest.mark.parametrize("ending", ["", ".zip", "/", "//"])
def test_every_way_to_write_a_path_is_checked(make, ending, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make(ChainEnv()).save("model")
    for start in ("", "./", f"{tmp_path}/"):
        assert make.algorithm.load(f"{start}model{ending}").seed == 0
    content = pathlib.Path("model.zip").read_bytes()
    pathlib.Path("model.zip").write_bytes(content[:-3000])
    with pytest.raises(ValueError, match="must be a complete file"):
        make.algorithm.load(f"./model{ending}")


@EITHER
def test_moments_of_another_shape_are_refused(make, model):
    """SB3 loads them, and fused Adam then writes beyond their memory."""
    parameters = deepcopy(model.get_parameters())
    first = parameters["policy.optimizer"]["state"][0]
    first["exp_avg"] = first["exp_avg"].flatten()[:1].clone()
    before = tensors(model)
    with pytest.raises(ValueError, match=r"exp_avg of the optimiser must have the shape of its parameter, .*, got \(1,\)"):
        model.set_parameters(parameters)
    assert same(before, model)
    model.learn(4, reset_num_timesteps=False)


@pytest.mark.parametrize("optimizer", ["Adafactor", "SGD", "RMSprop", "Adagrad"])
def test_moments_of_other_optimizers_are_loaded(optimizer, tmp_path):
    """Those of Adafactor have not the shape of their parameter."""
    model = MAKERS[1](ChainEnv(), policy_kwargs={"optimizer_class": optimizer}).learn(46)
    model.save(tmp_path / "model")
    loaded = MAKERS[1].algorithm.load(tmp_path / "model", ChainEnv())
    assert len(loaded.policy.optimizer.state) == len(model.policy.optimizer.state)


class OwnBox(spaces.Box):
    """A space that is saved as a pickle."""


def test_a_buffer_of_a_space_of_ones_own_needs_trust(make, tmp_path):
    env = ChainEnv()
    env.observation_space = OwnBox(-1, 1, (3,), np.float32)
    model = make(env).learn(40)
    model.save_replay_buffer(tmp_path / "buffer")
    with pytest.raises(ValueError, match=r"a pickle of .*OwnBox"):
        model.load_replay_buffer(tmp_path / "buffer")
    model.load_replay_buffer(tmp_path / "buffer", trust=True)
    assert isinstance(model.replay_buffer.observation_space, OwnBox)
