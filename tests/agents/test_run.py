"""What sb3-contrib tests for QRDQN, tested for every EqR agent: training, spaces, modes, callbacks, loggers."""

import re
from contextlib import nullcontext
from copy import deepcopy
from itertools import product

import numpy as np
import pandas as pd
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import QRDQN
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import IdentityEnv, SimpleMultiObsEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from torch import nn

from sb3_eqr import EqRQRDQN, GroupFeaturesExtractor, SequenceReplayBuffer
from sb3_eqr.common.networks.encoders import ConvExtractor, NormalizedExtractor
from tests.models import BOTH, EITHER, N_ATOMS, PAPER, PAPER_FLAT, POLICIES, SMALL, all_finite, draw, same, tensors, untrained
from tests.toys import ChainEnv, ImageEnv, SampledEnv


@BOTH
@POLICIES
def test_every_policy_runs_and_all_parameters_are_trained(make, policy, env, network):
    model = make(env(), policy, policy_kwargs=network)
    before = deepcopy(model.policy.state_dict())
    model.learn(46)
    assert untrained(model, before) == [] and all_finite(model)


@EITHER
@pytest.mark.parametrize(
    "kwargs",
    [
        {"train_freq": 4},
        {"train_freq": (3, "step"), "gradient_steps": -1},
        {"train_freq": (1, "episode")},
        {"n_steps": 1},
        {"n_steps": 10, "prediction_depth": 0},
        {"policy_kwargs": {"reward_loss": "categorical"}},
        {"symmetry_coef": 0, "reward_coef": 0},
        {"aet_coef": 0, "symmetry_coef": 0},
        {"aet_coef": 0, "reward_coef": 0},
        {"double_q": False, "prioritized_replay": False, "tau": 0.01},
        {"target_update_interval": 30},
        {"policy_kwargs": {"dueling": False}},
        {"policy_kwargs": {"noisy": False}},
        {"policy_kwargs": {"net_arch": [], "projection": "own"}},
        {"policy_kwargs": {**PAPER, "net_arch": []}, "aet_coef": 0},
        {"policy_kwargs": PAPER_FLAT, "aux_gradient_share": None},
        {"policy_kwargs": {"head_input": "state"}},
        {"policy_kwargs": {"layer_norm": False}},
        {"policy_kwargs": {"latent_tau": None}, "tau": 0.01},
        {"policy_kwargs": {"group": "GL(2)"}},
        {"policy_kwargs": {"group": "SO(3)", "parameterization": "exp"}},
        {"policy_kwargs": {"group": "SE(2)^2 x SO(3)", "n_blocks": None}},
        {"policy_kwargs": {"group": "none(8)", "n_blocks": None}, "symmetry_coef": 0},
        {"policy_kwargs": {"group": None}, "symmetry_coef": 0},
        {"policy_kwargs": {"optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"weight_decay": 0.1}}},
        {"learning_rate": lambda progress: 1e-3 * progress, "max_grad_norm": None},
        {"replay_buffer_class": SequenceReplayBuffer, "learning_starts": 0},
        {"policy_kwargs": {"aet_loss": "contrastive"}},
        {"policy_kwargs": {"projection": "none"}},
        {"policy_kwargs": {"whiten": True}},
        {"policy_kwargs": {"whiten": True, "group": "SO(3)", "parameterization": "gram-schmidt"}},
        {"policy_kwargs": {"state_dependent_actions": False, "aet_loss": "contrastive"}, "td_coef": 0.0, "symmetry_coef": 0.0},
        {"td_coef": 0.0, "aet_coef": 0.0},
    ],
    ids=lambda kwargs: re.sub(" at 0x\\w+", "", str(kwargs)),
)
def test_every_option_runs_and_is_saved(make, kwargs, tmp_path):
    model = make(ChainEnv(), **kwargs).learn(52)
    assert model._n_updates > 0 and all_finite(model)
    model.save(tmp_path / "model")
    loaded = make.algorithm.load(tmp_path / "model", ChainEnv(), trust=True)
    assert loaded.policy.options == model.policy.options and same(model, loaded)
    loaded.learn(44)


WRONG_ACTIONS = [spaces.Box(-1, 1, (1,)), spaces.MultiBinary(2), spaces.MultiDiscrete([2, 2]), spaces.Discrete(3, start=1)]


@pytest.mark.parametrize("space", WRONG_ACTIONS)
def test_wrong_action_spaces_raise(make, space):
    env = ChainEnv()
    env.action_space = space
    advice = "TransformAction" if isinstance(space, spaces.Discrete) else "Wrap the environment with discrete actions"
    with pytest.raises(AssertionError, match=advice):
        make(env)


@pytest.mark.parametrize("n_envs", [2, 5])
def test_several_environments(make, n_envs):
    model = make(make_vec_env(ChainEnv, n_envs), train_freq=2).learn(100)
    assert model.replay_buffer.n_envs == n_envs and model._n_updates > 0


def test_the_callers_dictionaries_are_not_changed(make):
    policy_kwargs, buffer_kwargs = {"net_arch": [16]}, {"handle_timeout_termination": False}
    model = make.algorithm("MlpPolicy", ChainEnv(), **SMALL, policy_kwargs=policy_kwargs, replay_buffer_kwargs=buffer_kwargs)
    model.learn(46)
    assert policy_kwargs == {"net_arch": [16]} and buffer_kwargs == {"handle_timeout_termination": False}
    assert model.policy.optimizer.defaults["eps"] == 1.5e-4  # Table 5
    for name, expected in (("AdamW", 1.5e-4), (th.optim.Adam, 1.5e-4), ("RAdam", 1e-8)):  # RAdam keeps PyTorch's default
        named = make(ChainEnv(), policy_kwargs={"optimizer_class": name})
        assert named.policy.optimizer.defaults["eps"] == expected
    own = make(ChainEnv(), policy_kwargs={"optimizer_kwargs": {"betas": (0.5, 0.9)}})
    assert own.policy.optimizer.defaults["betas"] == (0.5, 0.9) and own.policy.optimizer.defaults["eps"] == 1.5e-4


@pytest.mark.parametrize(("total_timesteps", "expected"), [(300, 30), (19_990, 1_999), (20_000, 2_000), (100_000, 2_000)])
def test_learning_starts_after_a_tenth_of_the_first_run_and_at_most_2000_steps(make, total_timesteps, expected):
    model = make.algorithm("MlpPolicy", ChainEnv(), device="cpu").learn(0)  # learning nothing chooses nothing
    model._setup_learn(total_timesteps, None)
    assert model.learning_starts == expected
    model._setup_learn(50, None)
    assert model.learning_starts == expected


@EITHER
def test_the_last_table_has_the_updates_after_the_last_episode(make, tmp_path):
    model = make(ChainEnv(), "MlpPolicy", learning_starts=20)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(63)
    last = pd.read_csv(tmp_path / "progress.csv").iloc[-1]
    assert last["time/total_timesteps"] == 63 and last["train/n_updates"] == model._n_updates
    assert np.isfinite(last["train/td_loss"])


@EITHER
def test_no_step_has_two_rows_in_the_log(make, tmp_path):
    class FiveSteps(ChainEnv):
        def step(self, action):
            self.position = 0.0
            return super().step(1)

    model = make(FiveSteps(5), learning_starts=20)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(30, log_interval=1)  # ends with an episode
    assert pd.read_csv(tmp_path / "progress.csv")["time/total_timesteps"].tolist() == [5, 10, 15, 20, 25, 30]


# ---------------------------------------------------------------------------------------------- observations


@pytest.mark.parametrize("shape", [(40, 36, 3), (3, 40, 36)])
def test_images_channels_first_and_last(make, shape):
    model = make(ImageEnv(shape), "CnnPolicy").learn(46)
    obs = model.get_env().reset()
    assert obs.shape == (1, 3, 40, 36)
    raw = ImageEnv(shape).observation_space.sample()
    action, _ = model.predict(raw, deterministic=True)
    assert action.shape == ()
    first = raw if shape[0] == 3 else raw.transpose(2, 0, 1)
    assert model.predict(first[None], deterministic=True)[0].tolist() == [action]


def test_a_given_group_encoder_gets_the_group_arguments(make):
    own = {**PAPER, "features_extractor_class": GroupFeaturesExtractor, "group": "SO(3)", "n_blocks": 2}
    encoder = make(ChainEnv(), policy_kwargs=own).policy.online.features_extractor
    assert (str(encoder.group_layer.group), encoder.group_layer.n_blocks) == ("SO(3)", 2)
    own["features_extractor_kwargs"] = {"group": "T(2)"}
    assert str(make(ChainEnv(), policy_kwargs=own).policy.online.features_extractor.group_layer.group) == "T(2)"
    for group, n_blocks in {"T(2)": 32, "T(3)": 21, "T(72)": 1, "T(72)^3": 3}.items():  # T(2): Table 5
        policy = make(ChainEnv(), policy_kwargs={"group": group, "n_blocks": None}).policy
        assert policy.latent_model.n_blocks == n_blocks, group


def test_float_images(make):
    env = ImageEnv((3, 40, 36), dtype=np.float32)
    model = make(env, "CnnPolicy", policy_kwargs={"normalize_images": False}).learn(46)
    assert model.objective.augment.image_keys == [""]  # augmented like other images
    policy_kwargs = {**PAPER, "normalize_images": False, "features_extractor_class": GroupFeaturesExtractor}
    encoder = make(env, "CnnPolicy", policy_kwargs=policy_kwargs).policy.online.features_extractor
    assert isinstance(encoder.trunk, ConvExtractor)


class TinyExtractor(BaseFeaturesExtractor):
    def __init__(self, observation_space, features_dim=5):
        super().__init__(observation_space, features_dim)
        n_input = int(np.prod(observation_space.shape))
        self.net = nn.Sequential(nn.Flatten(), nn.Linear(n_input, features_dim), nn.BatchNorm1d(features_dim), nn.ReLU())

    def forward(self, obs):
        return self.net(obs)


class RunningMean(BaseFeaturesExtractor):
    """Keeps statistics in train mode, by code of its own; notes the sizes of the batches that they are of."""

    def __init__(self, observation_space, sizes):
        super().__init__(observation_space, 3)
        self.register_buffer("mean", th.zeros(3))
        self.sizes = sizes

    def forward(self, obs):
        if self.training:
            self.sizes.append(len(obs))
            self.mean.lerp_(obs.mean(dim=0), 0.1)
        return obs - self.mean


def test_an_extractor_with_statistics_of_its_own_has_a_target(make):
    sizes = []
    network = {"features_extractor_class": RunningMean, "features_extractor_kwargs": {"sizes": sizes}}
    make(ChainEnv(), policy_kwargs=network, batch_size=8).learn(43).train(1, 8)
    assert set(sizes) == {8}  # the observations before the transitions; all others are computed in eval mode


class OwnConvolutions(ConvExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space, layers=[[8, 8, 4]])


@pytest.mark.parametrize("group", ["SE(2)", None])
def test_an_extractor_derived_from_ours_may_have_its_own_arguments(make, group):
    network = {"features_extractor_class": OwnConvolutions, "group": group}
    model = make(ImageEnv(), "CnnPolicy", policy_kwargs=network, symmetry_coef=0.0)
    assert model.predict(model.get_env().reset())[0].shape == (1,)


@EITHER
@BOTH
def test_a_custom_extractor_becomes_the_trunk(make, network):
    kwargs = {"features_extractor_class": TinyExtractor, "features_extractor_kwargs": {"features_dim": 7}}
    model = make(ImageEnv(), "CnnPolicy", policy_kwargs={**network, **kwargs}).learn(46)
    policy = model.policy
    encoder = policy.online.features_extractor
    assert isinstance(encoder, GroupFeaturesExtractor if network is PAPER else NormalizedExtractor)
    assert isinstance(encoder.trunk, TinyExtractor)
    assert policy.group_layer.to_algebra.in_features == 7
    # With batch norm, online features in train mode differ from target features.
    objective = model.objective
    assert objective.target_encoder is policy.target.features_extractor
    assert objective.latent_encoder is (policy.latent_encoder or policy.target.features_extractor) is not encoder
    model = make(ImageEnv(), "CnnPolicy", policy_kwargs={**network, "features_extractor_class": NatureCNN}).learn(46)
    assert model.policy.group_layer.to_algebra.in_features == 512


@EITHER
def test_options_that_a_callback_changes_hold_from_the_next_round(make):
    """With tau=1, the online encoder serves as the target's; a target that moves slowly has its own."""
    model = make(ChainEnv())

    def change(_locals, _globals):
        if model.num_timesteps == 44:
            model.tau, model.double_q = 0.1, False
        return True

    model.learn(46, change)
    assert model.objective.target_encoder is model.policy.target.features_extractor and not model.objective.double_q


@POLICIES
@pytest.mark.parametrize("algorithm, network", [(QRDQN, "quantile_net"), (DQN, "q_net"), (PPO, None)])
def test_the_group_encoder_works_with_stock_algorithms(algorithm, network, env, policy):
    encoder = {"features_extractor_class": GroupFeaturesExtractor}
    encoder["features_extractor_kwargs"] = {"group": "SO(3)", "n_blocks": 4}
    kwargs = {"n_steps": 32, "batch_size": 16} if algorithm is PPO else {"learning_starts": 16, "buffer_size": 100}
    model = algorithm(policy, env(), policy_kwargs=encoder, device="cpu", **kwargs).learn(40)
    observation, _ = model.policy.obs_to_tensor(model.get_env().reset())
    extractor = (getattr(model, network) if network else model.policy).features_extractor
    blocks = model.policy.extract_features(observation, extractor).view(-1, 4, 3, 3)
    th.testing.assert_close(blocks @ blocks.mT, th.eye(3).expand_as(blocks), rtol=0, atol=1e-5)


@EITHER
@pytest.mark.parametrize("space", [spaces.Discrete(16), spaces.MultiDiscrete([4, 3]), spaces.MultiBinary(5)])
def test_discrete_observations(make, space):
    assert make(SampledEnv(space)).learn(80)._n_updates > 0


def test_images_in_dict_observations_are_augmented(make):
    model = make(SimpleMultiObsEnv(channel_last=True), "MultiInputPolicy")
    assert model.objective.augment.image_keys == ["img"]
    model.learn(46)
    obs = {"img": th.randint(0, 256, (4, 1, 36, 36), dtype=th.uint8), "vec": th.rand(4, 5)}
    augmented = model.objective.augment(obs)
    assert th.equal(augmented["vec"], obs["vec"]) and not th.allclose(augmented["img"] * 255, obs["img"].float(), atol=0.5)


@EITHER
def test_frame_stacks_are_detected_and_each_frame_is_stored_once(make):
    env = VecFrameStack(make_vec_env(ImageEnv, 2), 4)
    model = make(env, "CnnPolicy", buffer_size=400).learn(100)
    assert model.frame_stack == 4 and model.replay_buffer.nbytes / 400 < 1.3 * 36 * 36
    whole = make(env, "CnnPolicy", buffer_size=400, replay_buffer_kwargs={"frame_stack": 1}).learn(100)
    assert whole.frame_stack == 1
    sideways = VecFrameStack(make_vec_env(lambda: ImageEnv((1, 40, 36))), 2, channels_order="last")
    assert make(sideways, "CnnPolicy").frame_stack == 1  # frames are concatenated along the width
    a, b = draw(model.replay_buffer, 200), draw(whole.replay_buffer, 200)
    assert a.rollout_observations.shape == b.rollout_observations.shape == (200, 2, 4, 36, 36)


# ---------------------------------------------------------------------------------------------- modes


def test_batch_norm_statistics_change_in_training_only(make):
    model = make(ImageEnv(), "CnnPolicy", policy_kwargs={"features_extractor_class": TinyExtractor}, learning_starts=30)

    def statistics():
        return tensors([b for name, b in model.policy.named_buffers() if "running_" in name or "batches" in name])

    start = statistics()
    model.learn(25)  # no update yet, and collecting must not change them
    obs = model.get_env().reset()
    model.predict(obs, deterministic=True)
    model.predict(obs, deterministic=False)
    assert same(start, statistics())
    model.learn(40)
    trained = statistics()
    assert not same(start, trained)
    model.predict(obs)
    evaluate_policy(model, model.get_env(), n_eval_episodes=2)
    assert same(trained, statistics())


def test_train_mode_applies_to_the_trained_networks_only(make):
    policy = make(ChainEnv()).policy
    for mode, put in product((True, False), (policy.train, policy.set_training_mode)):
        policy.train(not mode)
        put(mode)
        assert policy.training == mode and policy.online.training == mode
        assert all(module.training == mode for module in policy.latent_model.modules())
        assert not any(m.training for m in [*policy.target.modules(), *policy.latent_target.modules()])


@EITHER
@BOTH
def test_target_networks_follow_the_online_ones(make, network):
    policy = make(ChainEnv(), policy_kwargs=network).learn(60).policy
    pairs = policy.target_copy.pairs
    if network is PAPER:
        assert len(pairs) == 2 and policy.latent_target_copy is policy.target_copy  # network, latent model
    else:
        assert len(pairs) == 1 and len(policy.latent_target_copy.pairs) == 1
        pairs = [*pairs, *policy.latent_target_copy.pairs]
    for online, target in pairs:
        for a, b in zip(online.state_dict().values(), target.state_dict().values(), strict=True):
            assert th.equal(a, b) or a.dtype == th.int64  # num_batches_tracked is not used by inference


@EITHER
@pytest.mark.parametrize("tau", [1.0, 0.5])
def test_the_target_follows_after_each_update(make, tau):
    """So a round of four updates is the same as four rounds of one."""
    models = []
    for rounds in ([4], [1, 1, 1, 1]):
        models.append(make(ChainEnv(), tau=tau, policy_kwargs={"latent_tau": None}).learn(46))
        for n_updates in rounds:
            models[-1].train(n_updates, 8)
    assert same(*models)


def test_exploration_is_random_then_noisy_and_prediction_is_neither(make):
    model = make(ChainEnv(), learning_starts=0, exploration_fraction=0.5)
    model.policy.online.head.advantage[-1].weight_sigma.data.fill_(1.0)
    model.learn(20)
    assert model.exploration_rate == 0.0  # ε is 0, so only the noise explores
    obs = np.zeros((1, 3), dtype=np.float32)
    model.policy.set_training_mode(False)  # as collect_rollouts does
    noisy = {int(model.predict(obs, deterministic=False)[0][0]) for _ in range(60)}
    clean = {int(model.predict(obs, deterministic=True)[0][0]) for _ in range(60)}
    assert len(noisy) > 1 and len(clean) == 1
    rates = [model.exploration_schedule(progress) for progress in (1.0, 0.75, 0.5, 0.0)]
    np.testing.assert_allclose(rates, [1.0, 0.5, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("beta, final_beta", [(0.4, 1.0), (0.8, 0.2)])
def test_beta_and_counters(make, beta, final_beta):
    kwargs = {"beta": beta, "final_beta": final_beta}
    model = make(ChainEnv(), train_freq=1, gradient_steps=3, learning_starts=50, replay_buffer_kwargs=kwargs).learn(60)
    assert model._n_updates == 3 * 10
    # The last update comes after the last step.
    assert model.replay_buffer.beta == pytest.approx(final_beta)
    model._current_progress_remaining = 0.5
    model.train(1, 8)
    assert model.replay_buffer.beta == pytest.approx((beta + final_beta) / 2)


# ---------------------------------------------------------------------------------------------- learning


@pytest.mark.slow
@EITHER
def test_identity_environment_is_learned(make):
    env = DummyVecEnv([lambda: IdentityEnv(10)])
    settings = {"n_steps": 1, "prediction_depth": 1, "gamma": 0.4, "learning_rate": 3e-3, "train_freq": 2, "gradient_steps": 1}
    settings |= {"learning_starts": 100, "batch_size": 32, "exploration_fraction": 0.3, "exploration_final_eps": 0.05}
    network = {make.n_atoms_name: 25, "net_arch": [64], "n_blocks": 12, "noisy": False}
    model = make(env, **settings, policy_kwargs=network, buffer_size=3000).learn(1500)
    evaluate_policy(model, env, n_eval_episodes=20, reward_threshold=90, warn=False)
    obs = env.reset()
    assert np.shape(model.predict(obs)[0]) == np.shape(obs)


def test_terminal_observations_behind_vec_normalize_are_stored(make):
    class Recorded(SampledEnv):
        def observe(self):
            seen.append(super().observe())
            return seen[-1]

    seen, env = [], Recorded(spaces.Box(-1, 1, (3,), np.float32))
    model = make(VecNormalize(DummyVecEnv([lambda: env])), learning_starts=1_000).learn(100)
    buffer = model.replay_buffer
    rows = np.flatnonzero(buffer.dones[:, 0])
    assert buffer.timeouts[rows, 0].tolist() == [1, 0] * 5
    np.testing.assert_allclose(buffer.rewards[:100, 0], [*np.linspace(0.1, 1, 10)] * 10, rtol=1e-6)
    stored = buffer._stores[""].observations(rows, np.zeros_like(rows), following=True)
    np.testing.assert_allclose(stored, seen[10::11], atol=1e-5)  # of each episode, the reset's observation and ten more


@pytest.mark.parametrize("kind", [None, ValueError, KeyboardInterrupt])
def test_the_step_at_which_a_callback_stops_learn_is_stored(make, kind):
    """By its answer or by an exception; the next call of ``learn`` goes on from there."""

    class Clock(SampledEnv):
        def observe(self):
            return np.full(1, self.time, np.float32)

    def stop(found, _):
        if kind is not None and found["self"].num_timesteps == 15:
            raise kind("stop")
        return found["self"].num_timesteps < 15

    model = make(Clock(spaces.Box(0, 10, (1,), np.float32)), learning_starts=1_000)
    with nullcontext() if kind is None else pytest.raises(kind):
        model.learn(100, callback=stop)
    model.learn(5, reset_num_timesteps=False)
    buffer, rows = model.replay_buffer, np.arange(20)
    now, then = (buffer._stores[""].observations(rows, 0 * rows, following=f)[:, 0].tolist() for f in (False, True))
    assert now == [*range(10), *range(10)] and then == [n + 1 for n in now]
    ends = buffer.dones[:20, 0] + buffer.timeouts[:20, 0] > 0
    assert buffer.pos == 20 and np.flatnonzero(ends).tolist() == [9, 19]


@pytest.mark.parametrize("place", ["step", "reset"])
def test_a_run_that_is_interrupted_in_the_environment_begins_a_new_episode(make, place):
    """By Ctrl-C after the environment has moved: the step that nobody saw, or half of one, is not stored."""

    class Clock(SampledEnv):
        stops = iter([KeyboardInterrupt])

        def observe(self):
            return np.full(1, self.time, np.float32)

        def reset(self, **kwargs):
            if place == "reset" and self.n_episodes == 1:
                for error in self.stops:
                    raise error
            return super().reset(**kwargs)

        def step(self, action):
            found = super().step(action)
            if place == "step" and self.n_episodes == 1 and self.time == 5:
                for error in self.stops:
                    raise error
            return found

    model = make(Clock(spaces.Box(0, 10, (1,), np.float32)), learning_starts=1_000)
    with pytest.raises(KeyboardInterrupt):
        model.learn(100)
    model.learn(15, reset_num_timesteps=False)
    buffer, n_before = model.replay_buffer, 14 if place == "step" else 9
    rows = np.arange(n_before + 15)
    now, then = (buffer._stores[""].observations(rows, 0 * rows, following=f)[:, 0].tolist() for f in (False, True))
    assert now == [*[*range(10), *range(10)][:n_before], *range(10), *range(5)] and buffer.pos == len(rows)
    assert then == [n + 1 for n in now]


def test_each_call_of_learn_writes_its_last_log(make, tmp_path):
    model = make(SampledEnv(spaces.Box(-1, 1, (3,), np.float32), length=1_000))
    model.set_logger(configure(str(tmp_path), ["csv"]))
    for _ in range(3):
        model.learn(60)  # no episode ends, and all three end at step 60
    assert pd.read_csv(tmp_path / "progress.csv")["time/total_timesteps"].tolist() == [60, 60, 60]


@EITHER
def test_errors_of_callbacks_are_not_the_environments(make):
    class Short(ChainEnv):
        def step(self, action):
            return super().step(action)[:4]

    with pytest.raises(AttributeError, match="no_such_method"):
        make(ChainEnv()).learn(10, callback=lambda found, _: found["env"].env_method("no_such_method"))
    with pytest.raises(
        ValueError, match="step 0: the environment must follow gymnasium's interface, got ValueError: not enough"
    ):
        make(Short()).learn(10)


@EITHER
def test_episodes_that_end_the_training_are_counted(make):
    """``StopTrainingOnMaxEpisodes`` ends twenty calls of ``learn``, each with the last step of an episode."""
    model = make(ImageEnv(length=5), "CnnPolicy", learning_starts=1_000)
    for _ in range(20):
        model.learn(1_000, StopTrainingOnMaxEpisodes(1), reset_num_timesteps=False)
    ends = model.replay_buffer.dones[:100, 0] + model.replay_buffer.timeouts[:100, 0] > 0
    assert model.num_timesteps == model.replay_buffer.pos == 100 and np.flatnonzero(ends).tolist() == [*range(4, 100, 5)]
    assert model._episode_num == len(model.ep_info_buffer) == 20


def test_predict_shapes(make):
    model = make(make_vec_env(ChainEnv, 3))
    obs = np.zeros((3, 3), dtype=np.float32)
    assert model.predict(obs)[0].shape == (3,)
    assert model.predict(obs[0])[0].shape == ()
    assert model.policy(th.zeros(4, 3)).shape == (4,)
    online = model.policy.online
    outputs = online(th.zeros(4, 3)) if make.algorithm is EqRQRDQN else online.head(online.features(th.zeros(4, 3)))
    assert outputs.shape == (4, N_ATOMS, 3)
    with pytest.raises(ValueError, match="Gym API"):
        model.predict(ChainEnv().reset())


@EITHER
def test_eval_and_checkpoint_callbacks(make, tmp_path):
    """EvalCallback calls logger.dump, which also writes what training has recorded, as with QRDQN."""
    eval_env = VecNormalize(make_vec_env(ChainEnv), training=False)
    callbacks = [
        EvalCallback(eval_env, eval_freq=40, n_eval_episodes=2, best_model_save_path=str(tmp_path), verbose=0),
        CheckpointCallback(50, str(tmp_path), save_replay_buffer=True, save_vecnormalize=True),
    ]
    model = make(VecNormalize(make_vec_env(ChainEnv)), gradient_steps=1)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(105, callback=callbacks, log_interval=None)
    header = (tmp_path / "progress.csv").read_text().splitlines()[0].split(",")
    assert {"train/td_loss", "train/loss", "eval/mean_reward"} <= set(header)
    made = {path.name for path in tmp_path.iterdir()}
    assert {"best_model.zip", "rl_model_50_steps.zip", "rl_model_replay_buffer_100_steps.pkl"} <= made
    assert not any("partial" in name for name in made)


# ---------------------------------------------------------------------------------------------- logger


def test_logger_has_every_key(make, tmp_path, monkeypatch):
    model = make(ChainEnv(length=10))
    model.set_logger(configure(str(tmp_path), ["csv", "tensorboard"]))
    recorded = {}
    monkeypatch.setattr(model.logger, "dump", lambda step=0: recorded.update(model.logger.name_to_value))
    model.learn(100, log_interval=1)
    losses = {"td_loss", "aet_loss", "symmetry_loss", "reward_loss", "loss", "grad_norm", "mean_q_value"}
    keys = {f"train/{name}" for name in losses} | {"train/beta", "train/n_updates", "train/learning_rate"}
    assert keys <= recorded.keys()
    assert {"rollout/ep_rew_mean", "rollout/exploration_rate", "time/fps"} <= recorded.keys()
    assert all(np.isfinite(recorded[key]) and isinstance(recorded[key], (float, int)) for key in keys)


def test_tensorboard(make, tmp_path):
    make(ChainEnv(length=10), tensorboard_log=str(tmp_path)).learn(60, log_interval=1)
    assert [path.name for path in tmp_path.iterdir()] == [f"{make.algorithm.__name__}_1"]
    assert any("tfevents" in path.name for path in (tmp_path / f"{make.algorithm.__name__}_1").iterdir())


def test_flags_as_arrays_are_stored(make):
    """As in SB3, whose DummyVecEnv takes arrays of shape (1,)."""

    class Flags(ChainEnv):
        def step(self, action):
            observation, reward, terminated, truncated, info = super().step(action)
            return observation, reward, np.array([terminated]), np.array([truncated]), info

    plain, model = (make(make_vec_env(env), learning_starts=1_000).learn(60) for env in (ChainEnv, Flags))
    for name in ("dones", "timeouts", "rewards"):
        assert np.array_equal(getattr(plain.replay_buffer, name), getattr(model.replay_buffer, name)), name
