"""What sb3-contrib tests for QRDQN, tested for every EqR agent: training, spaces, modes, callbacks, loggers."""

import re
from contextlib import nullcontext
from copy import deepcopy

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import QRDQN
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import (
    FakeImageEnv,
    IdentityEnv,
    IdentityEnvBox,
    IdentityEnvMultiBinary,
    IdentityEnvMultiDiscrete,
    SimpleMultiObsEnv,
)
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from torch import nn

from sb3_eqr import EqRQRDQN, GroupFeaturesExtractor, SequenceReplayBuffer
from sb3_eqr.common.networks.encoders import ConvExtractor, MlpExtractor, NormalizedExtractor
from tests.models import BOTH, EITHER, N_ATOMS, PAPER, PAPER_FLAT, SMALL, untrained
from tests.toys import ChainEnv, ImageEnv


@BOTH
@pytest.mark.parametrize("policy", ["MlpPolicy", "CnnPolicy", "MultiInputPolicy"])
def test_every_policy_runs_and_all_parameters_are_trained(make, policy, network):
    envs = {"MlpPolicy": ChainEnv, "CnnPolicy": ImageEnv, "MultiInputPolicy": SimpleMultiObsEnv}
    model = make(envs[policy](), policy, policy_kwargs=network)
    before = deepcopy(model.policy.state_dict())
    model.learn(46)
    assert untrained(model, before) == []
    assert all(th.isfinite(p).all() for p in model.policy.parameters())


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
    ],
    ids=lambda kwargs: re.sub(" at 0x\\w+", "", str(kwargs)),
)
def test_every_option_runs(make, kwargs):
    model = make(ChainEnv(), **kwargs).learn(62)
    assert model._n_updates > 0
    assert all(th.isfinite(p).all() for p in model.policy.parameters())


@pytest.mark.parametrize("env", [IdentityEnvBox(eps=0.5), IdentityEnvMultiBinary(), IdentityEnvMultiDiscrete()])
def test_wrong_action_spaces_raise(make, env):
    with pytest.raises(AssertionError, match="Wrap the environment with discrete actions"):
        make(env)


def test_actions_that_do_not_start_at_0_raise(make):
    env = ChainEnv()
    env.action_space = spaces.Discrete(3, start=1)
    with pytest.raises(AssertionError, match="TransformAction"):
        make(env)


@pytest.mark.parametrize("n_envs", [2, 5])
def test_several_environments(make, n_envs):
    model = make(make_vec_env(ChainEnv, n_envs), train_freq=2).learn(100)
    assert model.replay_buffer.n_envs == n_envs and model._n_updates > 0
    with pytest.raises(AssertionError, match="one env when doing episodic training"):
        make(make_vec_env(ChainEnv, 2), train_freq=(1, "episode")).learn(10)


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


def test_the_learning_rate_schedule_applies_to_the_latent_model(make):
    model = make(ChainEnv(), learning_rate=lambda progress: 1e-3 * progress).learn(50)
    (group,) = model.policy.optimizer.param_groups
    assert group["lr"] == 0.0 and {*map(id, model.policy.latent_model.parameters())} <= {*map(id, group["params"])}


def test_defaults_are_those_of_table_5(make):
    """Or of docs/gradients.md, where they differ from the paper."""
    env = VecFrameStack(make_vec_env(lambda: ImageEnv((84, 84, 1))), 4)
    model = make.algorithm("CnnPolicy", env, device="cpu")
    assert (model.batch_size, model.gamma, model.learning_rate, model.max_grad_norm) == (32, 0.99, 1e-4, 10)
    assert (model.learning_starts, model.gradient_steps, model.n_steps, model.prediction_depth) == (None, 2, 10, 5)
    assert (model.train_freq.frequency, model.train_freq.unit.value, model.tau) == (1, "step", 1.0)
    buffer = model.replay_buffer
    assert (buffer.alpha, buffer.beta, buffer.final_beta) == (0.5, 0.4, 1.0)
    assert (model.shift_pixels, model.intensity_scale) == (4, 0.05)
    assert (model.aet_coef, model.symmetry_coef, model.reward_coef) == (1, 1, 5)  # means over M = 5 steps
    assert (model.exploration_fraction * 100_000, model.exploration_final_eps) == (2_000, 0)
    adam = model.policy.optimizer.defaults
    assert (adam["betas"], adam["eps"]) == ((0.9, 0.999), 1.5e-4)
    assert model.frame_stack == 4 and model.aux_gradient_share == 1.0
    policy = model.policy
    assert (policy.layer_norm, policy.head_input, policy.options.projection, policy.options.latent_tau) == (
        True,
        "trunk",
        "own",
        1.0,
    )
    assert isinstance(policy.online.features_extractor, NormalizedExtractor)
    assert isinstance(policy.online.features_extractor.trunk, ConvExtractor)
    latent = policy.latent_model
    assert latent.projection.weight.shape == (256, 72) and latent.predictor.weight.shape == (256, 256)
    papers = make.algorithm("CnnPolicy", env, device="cpu", policy_kwargs=PAPER).policy
    assert isinstance(papers.online.features_extractor.trunk, ConvExtractor)
    for policy, n_features, sigma_init in ((model.policy, 3136, 0.1), (papers, 72, 0.5)):
        head, layer = policy.online.head, policy.group_layer
        assert (head.n_atoms, policy.net_arch, policy.sigma_init) == (51, [256], sigma_init) and head.value is not None
        # σ₀ divided by the square root of the number of inputs
        assert head.first[0].weight_sigma[0, 0].item() == pytest.approx(sigma_init / n_features**0.5)
        assert (str(layer.group), layer.n_blocks, policy.latent_model.state_dim) == ("SE(2)", 12, 72)
        assert policy.online.features_extractor.features_dim == n_features
        assert sum(p.numel() for p in layer.to_algebra.parameters()) == (3136 + 1) * 36
        assert policy.latent_model.transition[0].out_features == 256
    vectors = make.algorithm("MlpPolicy", ChainEnv(), device="cpu").policy.online.features_extractor
    assert isinstance(vectors.trunk, MlpExtractor) and vectors.features_dim == 256


@pytest.mark.parametrize(("total_timesteps", "expected"), [(300, 30), (19_990, 1_999), (20_000, 2_000), (100_000, 2_000)])
def test_learning_starts_after_a_tenth_of_the_first_run_and_at_most_2000_steps(make, total_timesteps, expected):
    model = make.algorithm("MlpPolicy", ChainEnv(), device="cpu")
    model._setup_learn(total_timesteps, None)
    assert model.learning_starts == expected
    model._setup_learn(50, None)
    assert model.learning_starts == expected


def test_the_last_table_has_the_updates_after_the_last_episode(make, tmp_path):
    model = make(ChainEnv(), "MlpPolicy", learning_starts=20)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(63)
    last = pd.read_csv(tmp_path / "progress.csv").iloc[-1]
    assert last["time/total_timesteps"] == 63 and last["train/n_updates"] == model._n_updates
    assert np.isfinite(last["train/td_loss"])


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
    assert make(ChainEnv(), policy_kwargs={"group": "T(2)", "n_blocks": None}).policy.latent_model.n_blocks == 32  # Table 5


def test_float_images(make):
    env = ImageEnv((3, 40, 36), dtype=np.float32)
    model = make(env, "CnnPolicy", policy_kwargs={"normalize_images": False}).learn(46)
    assert model.objective.augment.image_keys == [""]  # augmented like other images
    policy_kwargs = {**PAPER, "normalize_images": False, "features_extractor_class": GroupFeaturesExtractor}
    encoder = make(env, "CnnPolicy", policy_kwargs=policy_kwargs).policy.online.features_extractor
    assert isinstance(encoder.trunk, ConvExtractor)
    with pytest.raises(ValueError, match="normalize_images=False"):
        make(env, "CnnPolicy")
    with pytest.raises(ValueError, match="MlpPolicy for vectors"):
        make(ChainEnv(), "CnnPolicy")
    with pytest.raises(ValueError, match="at least 36x36"):
        make(ImageEnv((3, 20, 20)), "CnnPolicy")


class TinyExtractor(BaseFeaturesExtractor):
    def __init__(self, observation_space, features_dim=5):
        super().__init__(observation_space, features_dim)
        n_input = int(np.prod(observation_space.shape))
        self.net = nn.Sequential(nn.Flatten(), nn.Linear(n_input, features_dim), nn.BatchNorm1d(features_dim), nn.ReLU())

    def forward(self, obs):
        return self.net(obs)


class OwnConvolutions(ConvExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space, layers=[[8, 8, 4]])


@pytest.mark.parametrize("group", ["SE(2)", None])
def test_an_extractor_derived_from_ours_may_have_its_own_arguments(make, group):
    network = {"features_extractor_class": OwnConvolutions, "group": group}
    model = make(ImageEnv(), "CnnPolicy", policy_kwargs=network, symmetry_coef=0.0)
    assert model.predict(model.get_env().reset())[0].shape == (1,)


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


@pytest.mark.parametrize("algorithm", [QRDQN, DQN, PPO])
@pytest.mark.parametrize(
    "env, policy", [(ChainEnv, "MlpPolicy"), (ImageEnv, "CnnPolicy"), (SimpleMultiObsEnv, "MultiInputPolicy")]
)
def test_the_group_encoder_works_with_stock_algorithms(algorithm, env, policy):
    policy_kwargs = {
        "features_extractor_class": GroupFeaturesExtractor,
        "features_extractor_kwargs": {"group": "SO(3)", "n_blocks": 4},
    }
    kwargs = {"n_steps": 32, "batch_size": 16} if algorithm is PPO else {"learning_starts": 16, "buffer_size": 100}
    model = algorithm(policy, env(), policy_kwargs=policy_kwargs, device="cpu", **kwargs).learn(40)
    features = model.policy.extract_features(
        *(model.policy.obs_to_tensor(model.get_env().reset())[:1]),
        model.policy.features_extractor if algorithm is PPO else online_network(model).features_extractor,
    )
    blocks = features.view(-1, 4, 3, 3)
    th.testing.assert_close(blocks @ blocks.mT, th.eye(3).expand_as(blocks), rtol=0, atol=1e-5)


def online_network(model):
    return model.quantile_net if isinstance(model, QRDQN) else model.q_net


@EITHER
@pytest.mark.parametrize("env", [lambda: gym.make("FrozenLake-v1"), lambda: gym.make("CliffWalking-v1")])
def test_discrete_observations(make, env):
    assert make(env()).learn(80)._n_updates > 0


@EITHER
@pytest.mark.parametrize("space", [spaces.MultiDiscrete([4, 3]), spaces.MultiBinary(5)])
def test_multi_discrete_and_multi_binary_observations(make, space):
    class Env(ChainEnv):
        def __init__(self):
            super().__init__()
            self.observation_space = space

        def observe(self):
            return self.observation_space.sample()

    assert make(Env()).learn(80)._n_updates > 0


def test_images_in_dict_observations_are_augmented(make):
    model = make(SimpleMultiObsEnv(channel_last=True), "MultiInputPolicy")
    assert model.objective.augment.image_keys == ["img"]
    model.learn(46)
    obs = {"img": th.randint(0, 256, (4, 1, 36, 36), dtype=th.uint8), "vec": th.rand(4, 5)}
    augmented = model.objective.augment(obs)
    assert th.equal(augmented["vec"], obs["vec"]) and not th.allclose(augmented["img"] * 255, obs["img"].float(), atol=0.5)
    with pytest.raises(ValueError, match="MultiInputPolicy"):
        make(SimpleMultiObsEnv(), "MlpPolicy")


@EITHER
def test_frame_stacks_are_detected_and_each_frame_is_stored_once(make):
    env = VecFrameStack(make_vec_env(ImageEnv, 2), 4)
    model = make(env, "CnnPolicy", buffer_size=400).learn(100)
    assert model.frame_stack == 4 and model.replay_buffer.nbytes / 400 < 1.3 * 36 * 36
    whole = make(env, "CnnPolicy", buffer_size=400, replay_buffer_kwargs={"frame_stack": 1}).learn(100)
    assert whole.frame_stack == 1
    sideways = VecFrameStack(make_vec_env(lambda: ImageEnv((1, 40, 36))), 2, channels_order="last")
    assert make(sideways, "CnnPolicy").frame_stack == 1  # frames are concatenated along the width
    np.random.seed(0)
    a = model.replay_buffer.sample(200)
    np.random.seed(0)
    b = whole.replay_buffer.sample(200)
    assert a.rollout_observations.shape == b.rollout_observations.shape == (200, 2, 4, 36, 36)


# ---------------------------------------------------------------------------------------------- modes


def test_batch_norm_statistics_change_in_training_only(make):
    model = make(ImageEnv(), "CnnPolicy", policy_kwargs={"features_extractor_class": TinyExtractor}, learning_starts=30)

    def statistics():
        return [b.clone() for name, b in model.policy.named_buffers() if "running_" in name or "batches" in name]

    start = statistics()
    assert len(start) > 0
    model.learn(25)  # no update yet, and collecting must not change them
    obs = model.get_env().reset()
    for _ in range(3):
        model.predict(obs, deterministic=True)
        model.predict(obs, deterministic=False)
    assert all(th.equal(a, b) for a, b in zip(start, statistics(), strict=True))
    model.learn(40)
    trained = statistics()
    assert not all(th.equal(a, b) for a, b in zip(start, trained, strict=True))
    model.predict(obs)
    evaluate_policy(model, model.get_env(), n_eval_episodes=2)
    assert all(th.equal(a, b) for a, b in zip(trained, statistics(), strict=True))


def test_train_mode_applies_to_the_trained_networks_only(make):
    policy = make(ChainEnv()).policy
    for mode in (True, False):
        policy.set_training_mode(mode)
        assert policy.training == mode and policy.online.training == mode
        assert all(module.training == mode for module in policy.latent_model.modules())
        assert not any(m.training for m in [*policy.target.modules(), *policy.latent_target.modules()])


@BOTH
def test_target_networks_follow_the_online_ones(make, network):
    policy = make(ChainEnv(), policy_kwargs=network).learn(80).policy
    pairs = policy.target_copy.pairs
    if network is PAPER:
        assert len(pairs) == 2 and policy.latent_target_copy is policy.target_copy  # network, latent model
    else:
        assert len(pairs) == 1 and len(policy.latent_target_copy.pairs) == 1
        pairs = [*pairs, *policy.latent_target_copy.pairs]
    for online, target in pairs:
        for a, b in zip(online.state_dict().values(), target.state_dict().values(), strict=True):
            assert th.equal(a, b) or a.dtype == th.int64  # num_batches_tracked is not used by inference
    slow = make(ChainEnv(), tau=0.5, policy_kwargs=network)
    before = [p.clone() for _, target in slow.policy.target_copy.pairs for p in target.parameters()]
    with th.no_grad():
        for p in {p for online, _ in slow.policy.target_copy.pairs for p in online.parameters()}:  # p of AET may be shared
            p.add_(1.0)
    slow.policy.update_target(0.5)
    after = [p for _, target in slow.policy.target_copy.pairs for p in target.parameters()]
    for a, b in zip(before, after, strict=True):
        th.testing.assert_close(b, a + 0.5)


@EITHER
@pytest.mark.parametrize("tau", [1.0, 0.5])
def test_the_target_follows_after_each_update(make, tau):
    """So a round of four updates is the same as four rounds of one."""
    states = []
    for rounds in ([4], [1, 1, 1, 1]):
        model = make(ChainEnv(), tau=tau, policy_kwargs={"latent_tau": None}).learn(46)
        for n_updates in rounds:
            model.train(n_updates, 8)
        states.append(model.policy.state_dict())
    assert all(th.equal(value, states[1][name]) for name, value in states[0].items())


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


def test_beta_and_counters(make):
    model = make(ChainEnv(), train_freq=1, gradient_steps=3, learning_starts=50, replay_buffer_kwargs={"beta": 0.4})
    model.learn(60)
    assert model._n_updates == 3 * 10
    # The last update comes after the last step, when β is 1.
    assert model.replay_buffer.beta == pytest.approx(1.0)
    model._current_progress_remaining = 0.5
    model.train(1, 8)
    assert model.replay_buffer.beta == pytest.approx(0.7)


def test_n_and_gamma_may_change_during_training(make):
    model = make(ChainEnv()).learn(46)
    model.n_steps, model.gamma = 2, 0.5
    model.train(1, 8)
    assert model.replay_buffer.n_steps == 2
    samples = model.replay_buffer.sample(100)
    assert set(samples.discounts.flatten().tolist()) <= {0.5, 0.25}


# ---------------------------------------------------------------------------------------------- learning


@BOTH
def test_a_run_with_singular_states_of_gl_stays_finite(make, network):
    """Every state is the zero matrix, so no state has an inverse."""
    model = make(ChainEnv(), policy_kwargs={**network, "group": "GL(2)"})
    policy, to_algebra = model.policy, model.policy.group_layer.to_algebra
    th.nn.init.zeros_(to_algebra.weight)
    th.nn.init.zeros_(to_algebra.bias)
    for copy in (policy.target_copy, policy.latent_target_copy):
        copy.update(1.0)
    observations = th.rand(2, 3)
    assert (policy.latent_model.embedding(policy.online.features(observations)) == 0).all()
    assert (policy.latent_target.embedding(policy.target.features(observations)) == 0).all()
    model.learn(100)
    assert model._n_updates > 0 and all(th.isfinite(p).all() for p in policy.parameters())
    assert (to_algebra.weight != 0).any()


@EITHER
def test_identity_environment_is_learned(make):
    env = DummyVecEnv([lambda: IdentityEnv(10)])
    model = make(
        env,
        n_steps=1,
        prediction_depth=1,
        gamma=0.4,
        learning_rate=3e-3,
        train_freq=2,
        gradient_steps=1,
        learning_starts=100,
        batch_size=32,
        exploration_fraction=0.3,
        exploration_final_eps=0.05,
        policy_kwargs={make.n_atoms_name: 25, "net_arch": [64], "n_blocks": 12, "noisy": False},
        buffer_size=3000,
    ).learn(1500)
    evaluate_policy(model, env, n_eval_episodes=20, reward_threshold=90, warn=False)
    obs = env.reset()
    assert np.shape(model.predict(obs)[0]) == np.shape(obs)


def test_vec_normalize(make):
    env = VecNormalize(make_vec_env(ChainEnv, 2))
    model = make(env).learn(100)
    samples = model.replay_buffer.sample(50, env=env)
    store = model.replay_buffer._stores[""]
    raw = store.observations(*np.divmod(samples.indices, 2), following=False)
    np.testing.assert_allclose(samples.observations, env.normalize_obs(raw), rtol=1e-6)
    assert samples.rollout_rewards.abs().max() <= env.clip_reward
    model.learn(20, reset_num_timesteps=False)


class Drawn(gym.Env):
    """
    Random observations and the time as reward, in episodes of ten steps, every other of which is truncated; keeps the last
    observation of each.
    """

    def __init__(self, space):
        self.observation_space, self.action_space, self.last = space, spaces.Discrete(2), []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.time += 1
        found = self.observation_space.sample()
        if self.time == 10:
            self.last.append(found)
        ends, truncated = self.time == 10, len(self.last) % 2 == 1
        return found, float(self.time), ends and not truncated, ends and truncated, {}


def test_terminal_observations_behind_vec_normalize_are_stored(make):
    env = Drawn(spaces.Box(-1, 1, (3,), np.float32, seed=0))
    model = make(VecNormalize(DummyVecEnv([lambda: env])), learning_starts=1_000).learn(100)
    buffer = model.replay_buffer
    rows = np.flatnonzero(buffer.dones[:, 0])
    assert buffer.timeouts[rows, 0].tolist() == [1, 0] * 5
    assert buffer.rewards[:100, 0].tolist() == [*range(1, 11)] * 10
    stored = buffer._stores[""].observations(rows, np.zeros_like(rows), following=True)
    assert len(rows) == len(env.last) == 10
    np.testing.assert_allclose(stored, env.last, atol=1e-5)


@pytest.mark.parametrize("kind", [None, ValueError, KeyboardInterrupt])
def test_the_step_at_which_a_callback_stops_learn_is_stored(make, kind):
    """By its answer or by an exception; the next call of ``learn`` goes on from there."""

    class Clock(Drawn):
        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return np.zeros(1, np.float32), {}

        def step(self, action):
            return np.full(1, self.time + 1, np.float32), *super().step(action)[1:]

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
    outputs = online(th.zeros(4, 3)) if make.algorithm is EqRQRDQN else online.log_probs(th.zeros(4, 3))
    assert outputs.shape == (4, N_ATOMS, 3)
    with pytest.raises(ValueError, match="Gym API"):
        model.predict(ChainEnv().reset())


def test_eval_and_checkpoint_callbacks(make, tmp_path):
    callbacks = [
        EvalCallback(make_vec_env(ChainEnv), eval_freq=40, n_eval_episodes=2, best_model_save_path=str(tmp_path), verbose=0),
        CheckpointCallback(50, str(tmp_path), save_replay_buffer=True, save_vecnormalize=True),
    ]
    env = VecNormalize(make_vec_env(ChainEnv))
    eval_env = VecNormalize(make_vec_env(ChainEnv), training=False)
    callbacks[0].eval_env = eval_env
    make(env, gradient_steps=1).learn(105, callback=callbacks)
    made = {path.name for path in tmp_path.iterdir()}
    assert {"best_model.zip", "rl_model_50_steps.zip", "rl_model_replay_buffer_100_steps.pkl"} <= made
    assert not any("partial" in name for name in made)
    model = make.algorithm.load(tmp_path / "rl_model_100_steps", env=env)
    model.load_replay_buffer(tmp_path / "rl_model_replay_buffer_100_steps")
    assert model.replay_buffer.size() == 99
    model.learn(5, reset_num_timesteps=False)


# ---------------------------------------------------------------------------------------------- logger


def test_logger_has_every_key(make, tmp_path, monkeypatch):
    model = make(ChainEnv(length=10))
    model.set_logger(configure(str(tmp_path), ["csv", "tensorboard"]))
    reads = []
    plain = th.Tensor.item
    monkeypatch.setattr(th.Tensor, "item", lambda self: reads.append(1) or plain(self))
    recorded = {}
    monkeypatch.setattr(model.logger, "dump", lambda step=0: recorded.update(model.logger.name_to_value))
    model.learn(100, log_interval=1)
    losses = {"td_loss", "aet_loss", "symmetry_loss", "reward_loss", "loss", "grad_norm", "mean_q_value"}
    keys = {f"train/{name}" for name in losses} | {"train/beta", "train/n_updates", "train/learning_rate"}
    assert keys <= recorded.keys()
    assert {"rollout/ep_rew_mean", "rollout/exploration_rate", "time/fps"} <= recorded.keys()
    assert all(np.isfinite(recorded[key]) and isinstance(recorded[key], (float, int)) for key in keys)


def test_logged_metrics_are_means_over_the_updates_since_the_last_dump(make):
    model = make(ChainEnv())
    model.set_logger(configure(None, []))
    for values in ((1.0, 3.0), (5.0, 7.0)):
        model._monitor.start_round(0)
        for value in values:
            model._monitor.add({"loss": th.tensor(value), "grad_norm": th.tensor(value + 1)})
        model._log_last_round()
    logged = model.logger.name_to_value
    assert (logged["train/loss"], logged["train/grad_norm"]) == (4.0, 5.0)
    model.logger.dump()
    model._log_last_round()
    assert not any("train/" in key for key in model.logger.name_to_value)


def test_callbacks_that_dump_the_logger_write_the_losses(make, tmp_path):
    """EvalCallback calls logger.dump, which also writes what training has recorded, as with QRDQN."""
    model = make(ChainEnv())
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(
        100, callback=EvalCallback(make_vec_env(ChainEnv), eval_freq=30, n_eval_episodes=1, verbose=0), log_interval=None
    )
    header = (tmp_path / "progress.csv").read_text().splitlines()[0].split(",")
    assert {"train/td_loss", "train/loss", "eval/mean_reward"} <= set(header)


def test_tensorboard(make, tmp_path):
    make(ChainEnv(length=10), tensorboard_log=str(tmp_path)).learn(60, log_interval=1)
    assert [path.name for path in tmp_path.iterdir()] == [f"{make.algorithm.__name__}_1"]
    assert any("tfevents" in path.name for path in (tmp_path / f"{make.algorithm.__name__}_1").iterdir())


def test_progress_bar_and_fake_images(make):
    env = FakeImageEnv(screen_height=40, screen_width=40, n_channels=1, discrete=True)
    make(env, "CnnPolicy").learn(50, progress_bar=True)
    assert isinstance(env.action_space, spaces.Discrete)


def test_flags_as_arrays_are_stored(make):
    """As in SB3, whose DummyVecEnv takes arrays of shape (1,)."""

    class Flags(ChainEnv):
        def step(self, action):
            observation, reward, terminated, truncated, info = super().step(action)
            return observation, np.array([reward]).item(), np.array([terminated]), np.array([truncated]), info

    plain, model = (make(make_vec_env(env), learning_starts=1_000).learn(60) for env in (ChainEnv, Flags))
    for name in ("dones", "timeouts", "rewards"):
        assert np.array_equal(getattr(plain.replay_buffer, name), getattr(model.replay_buffer, name)), name
