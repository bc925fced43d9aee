"""Wrong input is refused before the first step; what goes wrong later loses nothing."""

import numpy as np
import pytest
import torch as th
from sb3_contrib.qrdqn.policies import QRDQNPolicy
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_eqr import EqRQRDQN
from tests.test_run import SMALL, make
from tests.toys import ChainEnv, ImageEnv, PoisonEnv


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"buffer_size": 5}, "prediction_depth \\+ 1 = 6 transitions per environment, found 5"),
        ({"policy_kwargs": {"group": "SU(2)"}}, "expected GL\\(n\\), SE\\(n\\).*found 'SU\\(2\\)'"),
        ({"policy_kwargs": {"group": "SO(1)"}}, "SO\\(n\\) with n >= 2"),
        ({"policy_kwargs": {"n_blocks": 0}}, "n_blocks: expected a whole number of at least 1, found 0"),
        ({"policy_kwargs": {"n_blocks": 2.5}}, "n_blocks"),
        ({"policy_kwargs": {"parameterization": "angles"}}, "parameterization: expected one of"),
        ({"policy_kwargs": {"net_arch": []}}, "at least one hidden layer.*shared_projection"),
        ({"policy_kwargs": {"group": "none"}}, "Pass get_coef=0"),
        ({"prediction_depth": -1}, "prediction_depth: expected a whole number of at least 0, found -1"),
        ({"prediction_depth": 1.5}, "prediction_depth"),
        ({"tau": 1.5}, "tau: expected a number in \\[0, 1\\], found 1.5"),
        ({"aet_coef": -1.0}, "aet_coef: expected a finite number of at least 0"),
        ({"reward_coef": float("nan")}, "reward_coef"),
        ({"shift_pixels": -4}, "shift_pixels"),
        ({"reward_loss": "huber"}, "reward_loss: expected one of"),
        ({"n_steps": 0}, "n_steps"),
        ({"gamma": 1.01}, "gamma"),
        ({"priority_alpha": -1.0}, "alpha"),
        ({"priority_beta": 1.4}, "beta"),
        ({"batch_size": 1}, "at least 2 samples"),
        ({"replay_buffer_class": ReplayBuffer}, "expected SequenceReplayBuffer"),
        ({"policy": QRDQNPolicy}, "expected a policy derived from EqRQRDQNPolicy"),
        ({"policy": "LstmPolicy"}, "LstmPolicy unknown"),
        ({"train_freq": (1, "hour")}, "'step' or 'episode'"),
    ],
    ids=str,
)
def test_arguments_out_of_range(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(ChainEnv(), **kwargs)


def test_a_buffer_is_counted_per_environment():
    with pytest.raises(ValueError, match="buffer_size=24"):
        make(make_vec_env(ChainEnv, 4), buffer_size=23)


def test_a_frame_stack_that_is_not_one():
    with pytest.raises(ValueError, match="expected a divisor"):
        make(ImageEnv((3, 36, 36)), "CnnPolicy", replay_buffer_kwargs={"frame_stack": 2})
    model = make(ImageEnv((4, 40, 36)), "CnnPolicy", replay_buffer_kwargs={"frame_stack": 4})
    with pytest.raises(ValueError, match="frame_stack=4: expected each observation"):
        model.learn(50)
    assert model.num_timesteps == 1


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("where, what", [("obs", "observation"), ("reward", "reward"), ("terminal", "observation")])
def test_bad_values_from_the_environment(where, what, value, normalize):
    env = make_vec_env(lambda: PoisonEnv(where, value, at=60))
    model = make(VecNormalize(env) if normalize else env)
    if (where, value, normalize) == ("terminal", np.inf, True):
        model.learn(100)  # VecNormalize clips it before anyone can see it: what is stored is finite
        assert th.isfinite(model.replay_buffer.sample(500).rollout_observations).all()
        return
    with pytest.raises(ValueError, match=f"step 60: expected finite .*{what}s? from the environment, found (nan|-?inf)"):
        model.learn(100)
    assert model.replay_buffer.size() == 59 and model._n_updates > 0
    assert all(th.isfinite(p).all() for p in model.policy.parameters())


def test_a_bad_first_observation_is_refused_before_the_first_step():
    model = make(PoisonEnv("reset"))
    with pytest.raises(ValueError, match="step 0: expected finite observations"):
        model.learn(10)
    assert model.num_timesteps == 0


@pytest.mark.parametrize("trained", [0, 5])
def test_losses_that_are_not_finite_leave_the_last_good_model(trained, tmp_path):
    model = make(ChainEnv()).learn(41 + trained)
    good = {name: p.clone() for name, p in model.policy.state_dict().items()}
    slots = len(model.policy.optimizer.state)
    model.replay_buffer.rewards[:] = 1e38  # finite, but not its square
    model.train(gradient_steps=2, batch_size=8)
    assert not all(th.isfinite(p).all() for p in model.policy.parameters())
    update = model._n_updates - 1
    with pytest.raises(FloatingPointError, match=f"update {update}: expected finite losses, found .*reward_loss = inf"):
        model.save(tmp_path / "model")
    after = model.policy.state_dict()
    assert all(th.equal(good[name], after[name]) for name in good)
    assert len(model.policy.optimizer.state) == slots
    states = [value for state in model.policy.optimizer.state.values() for value in state.values()]
    assert all(th.isfinite(value).all() for value in states)
    assert list(tmp_path.iterdir()) == []
    model.save(tmp_path / "model")  # what was kept can be saved
    assert EqRQRDQN.load(tmp_path / "model").num_timesteps == model.num_timesteps


def test_the_very_first_update_may_be_the_bad_one():
    model = make(ChainEnv(), learning_starts=1000).learn(60)
    good = {name: p.clone() for name, p in model.policy.state_dict().items()}
    model.replay_buffer.rewards[:] = 1e38
    model.train(gradient_steps=3, batch_size=8)
    with pytest.raises(FloatingPointError, match="update 1: "):
        model.dump_logs()
    assert all(th.equal(good[name], p) for name, p in model.policy.state_dict().items())
    model.replay_buffer.rewards[:] = 0.0
    model.train(gradient_steps=2, batch_size=8)
    model.dump_logs()
    assert all(th.isfinite(p).all() for p in model.policy.parameters())


def test_learning_stops_at_a_bad_update():
    model = make(ChainEnv(), learning_rate=1e30)
    with pytest.raises(FloatingPointError, match="Lower learning_rate"):
        model.learn(200)
    assert all(th.isfinite(p).all() for p in model.policy.parameters())


def test_greedy_exploration_is_warned_of():
    with pytest.warns(UserWarning, match="exploration_final_eps"):
        make(ChainEnv(), policy_kwargs={"noisy": False})


def test_small_settings_are_what_these_tests_think():
    assert SMALL["n_steps"] + SMALL["prediction_depth"] + 1 == 6
