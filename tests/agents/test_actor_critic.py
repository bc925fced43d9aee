"""EqRSAC and EqRTQC: SAC and TQC, unchanged, beside a latent model that is trained apart."""

import itertools
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

from sb3_eqr import EqRQRDQN, ExactCheckpointCallback, PrioritizedSequenceReplayBuffer
from sb3_eqr.common.actor_critic import BeforeSamples
from sb3_eqr.common.saving import models
from sb3_eqr.eqr_sac import EqRSAC
from sb3_eqr.eqr_tqc import EqRTQC
from tests.models import same, tensors

SMALL = {"learning_starts": 30, "buffer_size": 500, "batch_size": 8, "device": "cpu", "seed": 0}
NETWORK = {"net_arch": [16], "latent_hidden_dim": 16, "group": "SE(2)", "n_blocks": 3}
NET = {"net_arch": [16]}
OFF = {"prediction_depth": 0, "policy_kwargs": {"head_input": "observation", **NET}}
PAIRS = pytest.mark.parametrize("agent, stock", [(EqRSAC, SAC), (EqRTQC, TQC)], ids=["EqRSAC", "EqRTQC"])
EACH = pytest.mark.parametrize("agent", [EqRSAC, EqRTQC])
BOX = spaces.Box(-1, 1, (3,))


class MoveEnv(gym.Env):
    """A point moves by the action; the last of the three numbers is noise. Episodes end outside, or after 20 steps."""

    action_space = spaces.Box(-2, 2, (2,))

    def __init__(self, observation_space=BOX):
        self.observation_space = observation_space

    def observe(self):
        self.place = np.append(self.place[:2], self.np_random.uniform(-1, 1)).astype(np.float32)
        if self.observation_space == BOX:
            return self.place
        image = self.np_random.integers(0, 256, (3, 40, 40), dtype=np.uint8)
        return {"image": image, "place": self.place} if isinstance(self.observation_space, spaces.Dict) else image

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.time = self.np_random.uniform(-0.5, 0.5, 3), 0
        return self.observe(), {}

    def step(self, action):
        self.place = self.place + 0.2 * np.append(action, 0.0)
        self.time += 1
        is_outside = bool(np.abs(self.place[:2]).max() > 1)
        self.place = np.clip(self.place, -1, 1)
        return self.observe(), float(self.place[0]), is_outside, self.time >= 20, {}


class SampledEnv(MoveEnv):
    def observe(self):
        super().observe()
        return self.observation_space.sample()


IMAGE = spaces.Box(0, 255, (3, 40, 40), np.uint8)
DICT = spaces.Dict({"image": IMAGE, "place": BOX})


def make(agent, env=None, policy="MlpPolicy", **kwargs):
    policy_kwargs = {**NETWORK, **kwargs.pop("policy_kwargs", {})}
    return agent(policy, MoveEnv() if env is None else env, **{**SMALL, **kwargs}, policy_kwargs=policy_kwargs)


@PAIRS
@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"n_steps": 3, "train_freq": 4, "gradient_steps": 3, "target_update_interval": 2},
        {"train_freq": (1, "episode"), "gradient_steps": -1, "ent_coef": 0.1},
        {"use_sde": True, "learning_rate": lambda remaining: 1e-3 * remaining},
    ],
    ids=["default", "n steps", "episodes", "sde"],
)
def test_without_latent_model_all_parameters_are_those_of_the_stock_agent(agent, stock, kwargs):
    ours = agent("MlpPolicy", MoveEnv(), **SMALL, **kwargs, **OFF).learn(60)
    theirs = stock("MlpPolicy", MoveEnv(), **SMALL, **kwargs, policy_kwargs={"net_arch": [16]}).learn(60)
    assert ours._n_updates == theirs._n_updates > 0
    assert same(ours, theirs)


@PAIRS
def test_without_latent_model_images_and_normalised_environments_too(agent, stock):
    for policy, make_env in [
        ("CnnPolicy", lambda: MoveEnv(IMAGE)),
        ("MultiInputPolicy", lambda: MoveEnv(DICT)),
        ("MlpPolicy", lambda: VecNormalize(make_vec_env(MoveEnv, 2, seed=0))),
    ]:
        ours = agent(policy, make_env(), **SMALL, **OFF).learn(34)
        assert same(ours, stock(policy, make_env(), **SMALL, policy_kwargs={"net_arch": [16]}).learn(34)), policy


@EACH
def test_the_default_latent_state_has_as_many_numbers_as_twelve_blocks_of_se2(agent):
    sizes = [
        agent("MlpPolicy", "Pendulum-v1", **SMALL, policy_kwargs=kwargs).policy.latent_model.state_dim
        for kwargs in ({}, {"group": "SE(2)"})
    ]
    assert sizes == [72, 12 * 2 * 3]


@EACH
def test_by_default_the_element_of_the_action_is_added(agent):
    latent = agent("MlpPolicy", "Pendulum-v1", **SMALL).policy.latent_model
    state, action = th.rand(4, 72), th.rand(4, 1)
    element = latent.transition(th.cat([state, action], dim=1))
    assert th.equal(latent.act(latent.action_element(state, action), state), state + element)


@EACH
def test_actor_and_critics_read_the_numbers_of_a_dict_as_they_are(agent):
    """In place of the image they read h(s); a number of Discrete(3) is one-hot."""
    space = spaces.Dict({"goal": spaces.Discrete(3), "image": IMAGE, "place": spaces.Box(-1, 1, (2, 2))})
    policy = make(agent, SampledEnv(space), "MultiInputPolicy").policy
    policy.set_training_mode(False)
    found = {"goal": th.tensor([2, 0]), "image": th.zeros(2, 3, 40, 40, dtype=th.uint8), "place": th.rand(2, 2, 2)}
    read = policy.actor.extract_features(found, policy.actor.features_extractor)
    assert th.equal(read[:, :3], th.eye(3)[[2, 0]]) and th.equal(read[:, 3:7], found["place"].flatten(1))
    one_hot = {"goal": th.eye(3)[[2, 0]], "image": found["image"].float(), "place": found["place"]}
    assert th.allclose(read[:, 7:-18], policy.latent_encoder(one_hot)) and policy.latent_target.state_dim == 18
    vectors = spaces.Dict({"goal": spaces.Discrete(3), "place": BOX})
    assert make(agent, SampledEnv(vectors), "MultiInputPolicy").policy.actor.features_dim == 3 + 3 + 18


@EACH
@pytest.mark.parametrize("reads_features", [None, False, True])
def test_actor_and_critics_read_the_moving_average(agent, reads_features):
    model = make(agent, policy_kwargs={"reads_features": reads_features}).learn(60)
    policy, observation = model.policy, th.rand(5, 3)
    policy.set_training_mode(False)
    features = policy.latent_encoder(observation)
    state = policy.latent_target.embedding(features)  # (5, 18)
    read = policy.actor.extract_features(observation, policy.actor.features_extractor)
    parts = [observation, features, state] if reads_features else [observation, state]
    assert th.equal(read, th.cat(parts, dim=1)) and not read.requires_grad
    action = th.rand(5, 2)
    element = policy.latent_target.group.element(
        policy.latent_target.transition(th.cat([state, action], dim=1)).view(5, 3, 3)
    )  # SE(2): rotation beside translation, (5, 3, 2, 3)
    state = state.view(5, 3, 2, 3)
    moved = element[..., :2] @ state
    moved[..., 2] += element[..., 2]
    moved = moved.flatten(1)
    inputs = th.cat([read, action, moved], dim=1)
    expected = [network(inputs) for network in policy.critic.q_networks]
    found = policy.critic(observation, action)
    found = found if agent is EqRSAC else found.unbind(1)
    assert all(th.allclose(*pair, atol=1e-6) for pair in zip(found, expected, strict=True))


@EACH
def test_features_are_read_where_the_observation_is_not(agent):
    for env, kind in ((BOX, "MlpPolicy"), (IMAGE, "CnnPolicy"), (IMAGE, "MlpPolicy"), (DICT, "MultiInputPolicy")):
        policy = make(agent, MoveEnv(env), kind).policy
        n_read = (0 if env is BOX else policy.encoder.features_dim) + (0 if env is IMAGE else 3)
        assert policy.actor.features_extractor.features_dim == n_read + 3 * 6, (env, kind)


@EACH
def test_the_gradient_for_the_action_passes_the_latent_model(agent):
    """Against central differences in float64."""
    model = make(agent).learn(60)
    policy = model.policy.double()
    critic, observation, action = policy.critic, th.rand(4, 3, dtype=th.float64), th.rand(4, 2, dtype=th.float64)
    features = policy.latent_encoder(observation)
    read = th.cat([observation, policy.latent_target.embedding(features)], dim=1)
    critic.features_extractor.forward = lambda obs: read  # as SB3 converts observations to float32
    action.requires_grad_()

    def value(action):
        found = critic(observation, action)
        return (found[0] if agent is EqRSAC else found).sum()

    (found,) = th.autograd.grad(value(action), action)
    expected = th.zeros_like(found)
    for index in np.ndindex(4, 2):
        step = th.zeros_like(found)
        step[index] = 1e-5
        expected[index] = (value(action + step) - value(action - step)) / 2e-5
    assert th.allclose(found, expected, atol=1e-8)
    with_constant = th.cat([read, action, critic.features_extractor.moved(observation, action).detach()], dim=1)
    direct = sum(network(with_constant).sum() for network in (critic.q_networks[:1] if agent is EqRSAC else critic.q_networks))
    assert (th.autograd.grad(direct, action)[0] - found).abs().max() > 1e-6


@EACH
def test_the_pass_for_the_actor_computes_no_gradient_of_the_critics(agent):
    """SAC discards it. The gradient for the actions is the same."""
    policy, action = make(agent).learn(60).policy, th.rand(4, 2, requires_grad=True)
    observation = th.rand(4, 3)
    policy.critic.zero_grad()

    def values(action):
        found = policy.critic(observation, action)
        return th.cat(found, dim=1) if agent is EqRSAC else found

    values(action).sum().backward()
    assert all(parameter.grad is None or not parameter.grad.any() for parameter in policy.critic.parameters())
    values(action.detach()).sum().backward()
    assert all(parameter.grad.any() for parameter in policy.critic.parameters())


@EACH
def test_only_the_auxiliary_losses_train_the_latent_model(agent, monkeypatch):
    monkeypatch.setattr(agent, "_update_latent_model", lambda self, samples: self.policy.reader.forget())
    model, untrained = make(agent).learn(60), make(agent)
    for part in ("encoder", "latent_encoder", "latent_model", "latent_target"):
        assert same(getattr(model.policy, part), getattr(untrained.policy, part)), part
        assert all(parameter.grad is None for parameter in getattr(model.policy, part).parameters()), part
    assert model._n_updates == 30 and not same(model.policy.actor, untrained.policy.actor)


@EACH
def test_actor_and_critics_see_one_augmentation_of_each_batch(agent):
    model = make(agent, MoveEnv(IMAGE), "CnnPolicy", train_freq=3, gradient_steps=3).learn(33)
    policy, encoded = model.policy, []
    policy.latent_encoder.register_forward_hook(lambda module, inputs, output: encoded.append(inputs[0]))
    model.train(3, 8)
    assert len(encoded) == 3 * 3  # the rollout, s and s' of each update
    assert policy.reader._known == []
    for kwargs in ({}, {"prediction_depth": 0}):
        assert make(agent, **kwargs).learn(60).policy.reader._known == []


@EACH
def test_nothing_is_remembered_outside_of_updates(agent):
    critic = make(agent).learn(60).critic.train()
    observation, action = th.rand(5, 3), th.rand(5, 2)
    before = th.cat(list(critic(observation, action)))
    observation.neg_()
    assert not th.equal(th.cat(list(critic(observation, action))), before)


@EACH
def test_the_algorithm_draws_as_without_a_latent_model(agent):
    """The second draw of an update has no rollout, and equals that of a buffer with M = 0 in the same random state."""
    model = make(agent).learn(60)
    buffer, latent = model.replay_buffer, []
    random_state = np.random.get_state()
    second = BeforeSamples(buffer, latent.append, 6).sample(8)
    assert latent[0].rollout_observations.shape == (6, 2, 3) and second.rollout_observations is None
    np.random.set_state(random_state)
    buffer.sample(6)
    buffer.prediction_depth = 0
    assert all(th.equal(a, b) for a, b in zip(second[:5], buffer.sample(8)[:5], strict=True))


@EACH
def test_no_learning_rate_is_negative_in_the_last_rollout(agent):
    env = make_vec_env(MoveEnv, 8)
    model = make(agent, env, learning_rate=lambda remaining: 1e-3 * remaining).learn(100)  # 104 steps
    assert model.policy.latent_optimizer in model._optimizers()
    assert {group["lr"] for optimizer in model._optimizers() for group in optimizer.param_groups} == {0.0}


@EACH
def test_rewards_are_standardised(agent):
    model = make(agent, learning_starts=100, n_steps=2).learn(130)
    rewards = model.replay_buffer.rewards[:130]
    assert model.reward_scale == pytest.approx(rewards.std(), rel=0.1)
    assert model.reward_mean == pytest.approx(rewards.mean(), abs=0.2 * model.reward_scale)

    def after(env, n):
        return make(agent, env, learning_starts=0, train_freq=10).learn(n).reward_scale

    assert after(MoveEnv(), 90) == 1.0  # too few
    normalize = VecNormalize(make_vec_env(MoveEnv, 1))
    normalized = make(agent, normalize, learning_starts=0, train_freq=10).learn(130)
    expected = normalized.replay_buffer.rewards[:130].std() / float(normalize.ret_rms.var) ** 0.5
    assert normalized.reward_scale == pytest.approx(expected, rel=0.1)
    assert after(VecNormalize(make_vec_env(MoveEnv, 1), norm_reward=False), 130) not in (0.0, 1.0)
    rewards = itertools.cycle([-0.1, -0.1 + 2e-8])
    constant = gym.wrappers.TransformReward(MoveEnv(), lambda reward: next(rewards))
    assert after(constant, 130) == 1.0  # rounding in float32


@EACH
@pytest.mark.parametrize(
    "loss, expected", [("mse", [[2.0, 10.0], [-10.0, -6.0]]), ("categorical", [[101.0, 1e4], [-1e4, 97.0]])]
)
def test_a_reward_far_beyond_the_last_estimate_counts_as_ten_spreads(agent, loss, expected, monkeypatch):
    """But the categorical loss needs signs."""
    model = make(agent, learning_starts=100, policy_kwargs={"reward_loss": loss}).learn(130)
    seen, losses = [], model.objective.latent_losses
    monkeypatch.setattr(
        model.objective, "latent_losses", lambda *args: [seen.append(args[1].rollout_rewards), losses(*args)][1]
    )
    model.reward_mean, model.reward_scale = 100.0, 0.5
    samples = model.replay_buffer.sample(2)
    rewards = th.tensor([[101.0, 1e4], [-1e4, 97.0]])
    model._update_latent_model(samples._replace(rollout_rewards=rewards))
    assert seen[0].tolist() == expected


@EACH
def test_a_round_of_updates_that_passes_an_interval_estimates_the_spread(agent):
    model = make(agent, buffer_size=2_000, learning_starts=1_100).learn(1_100)
    model._n_updates, model.reward_scale, model._scaled_at = 995, 5.0, 1_100
    model.train(3, 8)
    assert model.reward_scale == 5.0
    model.train(5, 8)  # update 1,000 is the third of these
    assert model.reward_scale == pytest.approx(model.replay_buffer.rewards[:1_100].std(), rel=1e-5)


@EACH
def test_the_spread_is_estimated_when_updates_are_rare(agent):
    """The rewards are 0, 1, 2, ...; the updates of steps 500 and 1,500 are a thousand steps apart."""

    def counting():
        rewards = itertools.count()
        return gym.wrappers.TransformReward(MoveEnv(), lambda _: next(rewards))

    model = make(agent, counting(), buffer_size=4_000, train_freq=500).learn(2_000)
    assert model._n_updates == 4 and model.reward_mean == 749.5
    late = make(agent, counting(), buffer_size=4_000, train_freq=60).learn(60)  # an update with too few rewards
    late.train_freq = 1_040
    late.learn(1_040, reset_num_timesteps=False)
    assert late._n_updates == 2 and late.reward_mean == 549.5


@EACH
def test_parameters_from_a_file_bring_the_scale_of_their_rewards(agent, tmp_path):
    model, other = make(agent, learning_starts=100).learn(130), make(agent)
    model.save(tmp_path / "model")
    other.set_parameters(tmp_path / "model")
    assert (other.reward_mean, other.reward_scale) == (model.reward_mean, model.reward_scale) != (0.0, 1.0)


@PAIRS
def test_attributes_that_change_between_calls_of_learn_hold_for_replay(agent, stock):
    def twice(kind, **kwargs):
        model = kind("MlpPolicy", MoveEnv(), **SMALL, **kwargs).learn(60)
        model.gamma = 0.5
        return model.learn(60)

    assert same(twice(agent, **OFF), twice(stock, policy_kwargs=NET))
    model = make(agent).learn(60)
    model.prediction_depth, model.n_steps, model.gamma = 4, 3, 0.5
    buffer = model.learn(60).replay_buffer
    assert (buffer.prediction_depth, buffer.n_steps, buffer.gamma) == (4, 3, 0.5)


@EACH
@pytest.mark.parametrize("n_windows", [None, 5])
def test_one_update_by_hand(agent, n_windows):
    """Losses by their definitions, Adam's first step, and the moving average, for windows that do not reach an end."""
    model = make(agent, learning_starts=100, learning_rate=1e-3, latent_batch_size=n_windows).learn(100)
    policy, before = model.policy, tensors(model)
    np.random.seed(5)
    samples = model.replay_buffer.sample(n_windows or 8)
    rewards = (samples.rollout_rewards - model.replay_buffer.rewards[:100].mean()) / model.replay_buffer.rewards[:100].std()
    policy.set_training_mode(True)
    latent, target = policy.latent_model, policy.latent_target
    states = [latent.embedding(policy.encoder(samples.observations))]
    aet, reward = 0.0, 0.0
    for m in range(2):
        element = latent.action_element(states[-1], samples.rollout_actions[:, m] * samples.mask[:, m, None])
        states.append(latent.act(element, states[-1]))
        wanted = target.projection(target.embedding(policy.latent_encoder(samples.rollout_observations[:, m])))
        found = latent.predictor(latent.projection(states[-1]))
        distance = (found / found.norm(dim=1, keepdim=True) - wanted / wanted.norm(dim=1, keepdim=True)).square().sum(dim=1)
        error = (latent.reward_net(states[-1])[:, 0] - rewards[:, m]).square()
        aet, reward = aet + samples.mask[:, m] * distance, reward + samples.mask[:, m] * error
    loss = ((aet + reward) / samples.mask.sum(dim=1)).mean()
    parameters = {f"encoder.{name}": p for name, p in policy.encoder.named_parameters()}
    parameters |= {f"latent_model.{name}": p for name, p in latent.named_parameters()}
    gradients = th.autograd.grad(loss, list(parameters.values()), allow_unused=True)
    np.random.seed(5)
    model.train(1, 8)
    after, averages = tensors(model), {"encoder": "latent_encoder", "latent_model": "latent_target"}
    for name, gradient in zip(parameters, gradients, strict=True):
        if gradient is None:
            assert th.equal(after[name], before[name])
            continue
        expected = before[name] - 1e-3 * gradient / (gradient.abs() + 1e-8)
        large = gradient.abs() > 1e-5
        assert th.allclose(after[name][large], expected[large], atol=1e-6), name
        part, _, rest = name.partition(".")
        average = f"{averages[part]}.{rest}"
        assert th.allclose(after[average], 0.995 * before[average] + 0.005 * after[name], atol=1e-7), name


@pytest.mark.parametrize(
    "agent, policy, make_env, kwargs",
    [
        (EqRSAC, "MlpPolicy", lambda: VecNormalize(make_vec_env(MoveEnv, 2, seed=0)), {"n_steps": 3}),
        (
            EqRTQC,
            "MlpPolicy",
            MoveEnv,
            {"action_noise": NormalActionNoise(np.zeros(2), 0.1 * np.ones(2)), "ent_coef": "auto_0.1"},
        ),
        (EqRTQC, "MlpPolicy", MoveEnv, {"use_sde": True, "train_freq": (1, "episode"), "gradient_steps": -1}),
        (EqRSAC, "MlpPolicy", MoveEnv, {"symmetry_coef": 1.0, "policy_kwargs": {"group": "SE(3)"}}),
        (EqRSAC, "MlpPolicy", MoveEnv, {"policy_kwargs": {"group": "none", "n_blocks": None}}),
        (EqRTQC, "MlpPolicy", MoveEnv, {"policy_kwargs": {"group": "T(72)^1", "n_blocks": None}}),
        (EqRSAC, "CnnPolicy", lambda: VecFrameStack(make_vec_env(lambda: MoveEnv(IMAGE), 2), 4), {}),
        (EqRTQC, "MultiInputPolicy", lambda: MoveEnv(DICT), {}),
    ],
    ids=["normalised", "noise", "sde", "GET", "no group", "default group", "images", "dicts"],
)
def test_a_run_is_repeatable_and_can_be_saved(agent, policy, make_env, kwargs, tmp_path):
    first, second = (make(agent, make_env(), policy, **kwargs).learn(52) for _ in range(2))
    assert first._n_updates > 10 and same(first, second)
    assert all(th.isfinite(value).all() for value in tensors(first).values())
    first.save(tmp_path / "model")
    loaded = agent.load(tmp_path / "model")
    observation = first.observation_space.sample()
    assert same(first, loaded) and loaded.prediction_depth == 2
    answers = [one.predict(observation, deterministic=True)[0] for one in (first, loaded)]
    assert np.array_equal(*answers)


@pytest.mark.parametrize("agent, env", [(EqRSAC, "Pendulum-v1"), (EqRTQC, "MountainCarContinuous-v0")])
def test_a_resumed_run_equals_an_uninterrupted_one(agent, env, tmp_path):
    whole = make(agent, env).learn(90)
    make(agent, env).learn(70, callback=ExactCheckpointCallback(60, tmp_path))
    resumed = agent.resume(tmp_path, make(agent, env).get_env())
    assert resumed.num_timesteps == 60
    resumed.learn(30, callback=ExactCheckpointCallback(20, tmp_path), reset_num_timesteps=False)
    assert same(whole, resumed)


@EACH
@pytest.mark.parametrize("n_envs", [1, 2])
def test_the_noise_begins_anew_when_a_callback_stops_the_training_at_an_episodes_end(agent, n_envs):
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(2), np.ones(2))
    model = make(agent, make_vec_env(MoveEnv, n_envs, seed=0), action_noise=noise, learning_starts=1_000)
    model.learn(1_000, callback=lambda found, _: not found["dones"][-1])
    left = model.action_noise.noises[-1] if n_envs > 1 else model.action_noise
    assert not left.noise_prev.any()


@EACH
@pytest.mark.parametrize("part", ["encoder", "latent_target", "actor"])
def test_networks_that_are_not_finite_raise(agent, part):
    """In a round of two updates, before SB3's own error about a distribution."""
    model = make(agent, gradient_steps=2).learn(32)
    with th.no_grad():
        for parameter in getattr(model.policy, part).parameters():
            parameter.fill_(th.nan)
    with pytest.raises(FloatingPointError, match=r"step 3[23], update \d+: (losses|parameters) must be finite, got "):
        model.learn(1, reset_num_timesteps=False)


@EACH
@pytest.mark.parametrize("off", [{}, OFF], ids=["latent", "off"])
def test_losses_of_the_critics_that_are_not_finite_raise(agent, off, tmp_path):
    model = make(agent, ent_coef=0.1, **off).learn(32)
    with th.no_grad():
        next(model.critic.qf0.parameters() if hasattr(model.critic, "qf0") else model.critic.parameters()).fill_(th.nan)
    with pytest.raises(FloatingPointError, match=r"step 33, update \d+: losses must be finite, got .*critic_loss = nan"):
        model.learn(1, reset_num_timesteps=False)
    with pytest.raises(FloatingPointError):
        model.save(tmp_path / "model")


@EACH
def test_a_run_continues_in_an_environment_that_is_also_rendered(agent, tmp_path):
    """SB3 gives a render mode to environments that it makes; gymnasium does not."""
    make(agent, "Pendulum-v1").learn(40, callback=ExactCheckpointCallback(30, tmp_path))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        agent.resume(tmp_path, gym.make("Pendulum-v1"))
    with pytest.warns(UserWarning, match="other arguments than before: kwargs = {} there, {'g': 9.0} here"):
        model = agent.resume(tmp_path, gym.make("Pendulum-v1", g=9.0))
    model.learn(20, callback=ExactCheckpointCallback(10, tmp_path), reset_num_timesteps=False)
    assert max(found.name for found in tmp_path.iterdir()) == "checkpoint-000000000040"


@EACH
def test_checkpoints_of_another_run_are_refused(agent, tmp_path):
    make(agent, ent_coef=0.1).learn(30, callback=ExactCheckpointCallback(20, tmp_path))
    for other, why in (
        ({"ent_coef": 0.2}, "ent_coef = 0.1 there, 0.2"),
        ({"latent_batch_size": 4}, "latent_batch_size = 64 there, 4"),
    ):
        with pytest.raises(ValueError, match=f"must be empty or hold checkpoints of this run, .*{why} here"):
            make(agent, **{"ent_coef": 0.1, **other}).learn(30, callback=ExactCheckpointCallback(20, tmp_path))


@EACH
@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"policy_kwargs": {"head_input": "observation"}}, "prediction_depth must be 0 with head_input='observation'"),
        ({"policy_kwargs": {"head_input": "trunk"}}, "head_input must be one of .*'latent', 'observation'.*, got 'trunk'"),
        ({"policy_kwargs": {"group": None}}, "group must be"),
        ({"policy_kwargs": {"latent_tau": 0}}, r"latent_tau must be a finite number in \(0, 1\], got 0"),
        (
            {"policy_kwargs": {"group": "none(8) x SE(2)", "n_blocks": None, "state_dependent_actions": False}},
            "state_dependent_actions must be True without a group",
        ),
        ({"policy_kwargs": {"group": "T(72)^1", "n_blocks": 3}}, "n_blocks must be None or 1 with group='T"),
        ({"policy_kwargs": {"group": "none(72)", "n_blocks": 3}}, "n_blocks must be None or 1 with group=.none.72.., .*got 3"),
        (
            {"policy_kwargs": {"group": "none", "n_blocks": None, "state_dependent_actions": False}},
            "state_dependent_actions must be True without a group",
        ),
        ({"policy_kwargs": {"group": "none", "n_blocks": None}, "symmetry_coef": 1.0}, "must have inverses for the GET loss"),
        ({"replay_buffer_class": PrioritizedSequenceReplayBuffer}, "must sample uniformly"),
        ({"replay_buffer_kwargs": {"n_steps": 3}}, "Pass n_steps=3 to EqR"),
        ({"latent_batch_size": 1}, "latent_batch_size must be an integer >= 2 or None, got 1"),
        ({"ent_coef": "aut"}, 'ent_coef must be a number >= 0, "auto", or "auto_" with a number > 0, got .aut.'),
        ({"ent_coef": True}, "ent_coef must be .*, got True"),
        ({"ent_coef": "auto_1_2"}, "ent_coef must be .*, got .auto_1_2"),
        ({"ent_coef": "auto_0"}, "ent_coef must be .*, got .auto_0"),
        ({"action_noise": 3}, "action_noise must be an action noise of SB3 or None, got 3"),
        ({"use_sde": "yes"}, "use_sde must be True or False, got .yes"),
        ({"sde_sample_freq": "a"}, "sde_sample_freq must be an integer >= -1, got .a"),
        ({"policy_kwargs": {"use_sde": True}}, "Pass use_sde=... beside policy_kwargs"),
        ({"target_entropy": "aut"}, "target_entropy must be a finite number or one of .'auto'., got 'aut'"),
        ({"aet_coef": -1.0}, "aet_coef must be a finite number >= 0, got -1.0"),
        ({"aet_coeff": 1.0}, "Did you mean 'aet_coef'"),
        ({"aux_gradient_share": 1.0}, "Only EqRQRDQN and EqRRainbow take it"),
        ({"learning_starts": None}, "learning_starts must be an integer >= 0, got None"),
        ({"policy_kwargs": {"latent_tau": None}}, "latent_tau must be"),
        ({"policy_kwargs": {"n_block": 3}}, "unexpected argument 'n_block'. Did you mean 'n_blocks'"),
        ({"policy_kwargs": {"optimizer_class": "Adem"}}, "a name in torch.optim"),
        ({"policy_kwargs": {"projection": "head"}}, "projection must be one of"),
        ({"batch_size": 1, "latent_batch_size": None}, "batch_size must be an integer >= 2"),
        ({"policy_kwargs": {"optimizer_kwargs": 3}}, "optimizer_kwargs must be a dictionary"),
        ({"policy_kwargs": {"activation_fn": "relu"}}, "activation_fn must be a class of torch.nn"),
        ({"policy_kwargs": {"net_arch": [0]}}, "net_arch must be a list of integers"),
        ({"policy_kwargs": {"net_arch": {"pi": [8], "qf": ["a"]}}}, "net_arch must be a list of integers"),
        ({"policy_kwargs": {"transition": "convolutional"}}, "transition must be one of"),
        ({"replay_buffer_kwargs": {"handle_timeouts": True}}, "unexpected argument 'handle_timeouts'"),
        ({"n_blocks": 3}, "Pass policy_kwargs=dict\\(n_blocks=...\\)"),
    ],
    ids=lambda value: None if isinstance(value, dict) else value[:20],
)
def test_wrong_arguments_fail_before_the_first_step(agent, kwargs, message):
    with pytest.raises((ValueError, TypeError), match=message):
        make(agent, **kwargs)


@pytest.mark.parametrize(
    "changes, message",
    [
        (
            {"action_noise": NormalActionNoise(np.zeros(3), np.ones(3))},
            r"must have the shape of an action, \(2,\), .*got Norm",
        ),
        ({"action_noise": NormalActionNoise(np.zeros(2), np.full(2, np.nan))}, "action_noise must .* be finite, got Normal"),
        ({"ent_coef": 0.1}, "ent_coef must be of the same kind as when the agent was made, got 0.1"),
        ({"use_sde": True}, "use_sde must be of the same kind as when the agent was made, got True"),
    ],
)
@EACH
def test_attributes_that_do_not_fit_the_agent_fail_before_the_first_step(agent, changes, message):
    model = make(agent)
    for name, value in changes.items():
        setattr(model, name, value)
    with pytest.raises(ValueError, match=message):
        model.learn(1)
    assert model.num_timesteps == 0


@EACH
def test_a_component_of_actions_that_cannot_change_is_refused(agent):
    """SB3 scales actions by the range of each component."""
    env = MoveEnv()
    env.action_space = spaces.Box(np.array([-1, 1], np.float32), np.array([1, 1], np.float32))
    with pytest.raises(ValueError, match="action_space must have components with low < high only, got Box"):
        make(agent, env)


@EACH
def test_discrete_actions_are_refused(agent):
    with pytest.raises(AssertionError, match="Use EqRQRDQN or EqRRainbow for a Discrete one"):
        make(agent, "CartPole-v1")


def test_quantiles_to_drop():
    for n in (-1, 25, 1.5):
        with pytest.raises(ValueError, match="top_quantiles_to_drop_per_net must be"):
            make(EqRTQC, top_quantiles_to_drop_per_net=n)
    model = make(EqRTQC)
    model.top_quantiles_to_drop_per_net = 25
    with pytest.raises(ValueError, match="must be below n_quantiles=25, got 25"):
        model.learn(1)


@EACH
def test_actions_that_are_integers_are_stored_as_sb3_scales_them(agent):
    """0, 1, 2, 3 as -1, -1/3, 1/3, 1. SB3's own buffer cuts them to -1, 0, 0, 1."""
    model = make(agent, gym.wrappers.TransformAction(MoveEnv(), np.sign, spaces.Box(0, 3, (2,), np.int64)))
    stored = model.learn(20).replay_buffer.actions[:20]
    assert len(np.unique(stored)) > 3 and np.abs(stored).max() <= 1


@EACH
def test_an_encoder_that_no_loss_trains_is_reported(agent):
    for kwargs in ({"prediction_depth": 0}, {"aet_coef": 0.0, "reward_coef": 0.0}):
        with pytest.warns(UserWarning, match="actor and critics read an encoder that no loss trains"):
            make(agent, **kwargs)


@EACH
def test_the_optimiser_is_found_by_its_name(agent):
    policy = make(agent, policy_kwargs={"optimizer_class": "AdamW"}).policy
    found = [policy.actor.optimizer, policy.critic.optimizer, policy.latent_optimizer]
    assert all(type(one) is th.optim.AdamW for one in found)


@EACH
def test_float_images_and_other_optimisers(agent):
    floats = spaces.Box(0, 1, (3, 40, 40), np.float32)
    env = gym.wrappers.TransformObservation(MoveEnv(IMAGE), lambda image: (image / 255).astype(np.float32), floats)
    model = make(agent, env, "CnnPolicy", policy_kwargs={"normalize_images": False, "optimizer_kwargs": {"foreach": True}})
    assert model.learn(34)._n_updates == 4
    plain = {"head_input": "observation", "normalize_images": False, "features_extractor_class": "nature"}
    assert make(agent, env, "CnnPolicy", prediction_depth=0, policy_kwargs=plain).learn(34)._n_updates == 4


class Centred(BaseFeaturesExtractor):
    """An encoder with a statistic of its own, a mask of minus infinity, and a weight that two layers share."""

    def __init__(self, space, features_dim=3):
        super().__init__(space, features_dim)
        self.register_buffer("mean", th.zeros(space.shape[0]))
        self.register_buffer("mask", th.nn.Transformer.generate_square_subsequent_mask(3))
        self.first, self.second = th.nn.Linear(3, 3), th.nn.Linear(3, 3)
        self.second.weight = self.first.weight

    def forward(self, observations):
        if self.training:
            self.mean = 0.9 * self.mean + 0.1 * observations.mean(dim=0).detach()
        return self.second(self.first(observations - self.mean))


@EACH
def test_the_average_of_a_custom_encoder(agent, tmp_path):
    model = make(agent, policy_kwargs={"features_extractor_class": Centred}).learn(60)
    model.save(tmp_path / "model")
    encoder, average = model.policy.encoder.trunk, model.policy.latent_encoder.trunk
    assert encoder.mean.abs().max() > 0 and th.equal(encoder.mean, average.mean)
    own, before = encoder.first.weight.clone(), average.first.weight.clone()
    model.policy.target_copy.update(0.5)
    assert average.second.weight is average.first.weight
    assert th.allclose(average.first.weight, (own + before) / 2)


@EACH
def test_outside_of_updates_images_are_not_shifted(agent):
    critic = make(agent, MoveEnv(IMAGE), "CnnPolicy").learn(33).critic.train()
    images, actions = th.randint(0, 256, (5, 3, 40, 40), dtype=th.uint8), th.rand(5, 2)
    assert th.equal(critic(images, actions)[0], critic(images, actions)[0])


@EACH
def test_the_average_stays_in_eval_mode(agent):
    policy = make(agent).learn(60).policy.train()
    assert policy.latent_model.training and not (policy.latent_encoder.training or policy.latent_target.training)
    policy.set_training_mode(False)
    policy.set_training_mode(True)
    assert policy.latent_model.training and not (policy.latent_encoder.training or policy.latent_target.training)


@EACH
def test_pixels_are_not_shifted_for_an_encoder_that_flattens_them(agent):
    assert make(agent, MoveEnv(IMAGE)).policy.augment.shifts == {"": 0}
    assert make(agent, MoveEnv(IMAGE), "CnnPolicy").policy.augment.shifts == {"": 2}


@EACH
def test_averages_move_after_the_policy_was_moved(agent):
    """Whitening has statistics, which PyTorch replaces by new tensors."""
    model = make(agent, policy_kwargs={"whiten": True}).learn(60)
    model.policy.double().float()
    before = tensors(model.policy.latent_target)
    model.train(1, 8)
    after, online = tensors(model.policy.latent_target), tensors(model.policy.latent_model)
    names = [name for name in after if "running" in name]
    assert names and all(not th.equal(after[name], before[name]) for name in names)
    assert all(after[name].shape == online[name].shape for name in names)


@EACH
def test_noise_that_a_checkpoint_does_not_keep_is_reported(agent, tmp_path):
    for i, kwargs in enumerate(({"use_sde": True}, {"action_noise": OrnsteinUhlenbeckActionNoise(np.zeros(2), np.ones(2))})):
        with pytest.warns(UserWarning, match="does not continue bit for bit"):
            make(agent, **kwargs).learn(40, callback=ExactCheckpointCallback(20, tmp_path / str(i)))


@EACH
def test_a_short_run_and_an_idle_option_are_reported(agent):
    with pytest.warns(UserWarning, match="no updates will be made"):
        make(agent).learn(20)
    with pytest.warns(UserWarning, match="optimize_memory_usage=True has no effect"):
        make(agent, optimize_memory_usage=True)


class Wider(EqRSAC):
    """An agent of a user, who passes arguments on."""

    def __init__(self, *args, own=1, **kwargs):
        super().__init__(*args, **kwargs)
        self.own = own


def test_an_agent_derived_by_a_user_loads_with_arguments(tmp_path):
    make(Wider).save(tmp_path / "own")
    loaded = Wider.load(tmp_path / "own", learning_rate=1e-4, own=2)
    assert loaded.learning_rate == 1e-4 and loaded.own == 2
    with pytest.raises(TypeError, match=r"got an unexpected argument 'learning_rat'\. Did you mean 'learning_rate'"):
        Wider.load(tmp_path / "own", learning_rat=1e-4)


def test_a_buffer_moves_between_agents_and_another_agents_file_is_named(tmp_path):
    model = make(EqRSAC).learn(60)
    model.save_replay_buffer(tmp_path / "buffer")
    other = make(EqRTQC)
    with pytest.warns(UserWarning, match="was saved at step 60"):
        other.load_replay_buffer(tmp_path / "buffer")
    assert np.array_equal(other.replay_buffer.rewards, model.replay_buffer.rewards)
    EqRQRDQN("MlpPolicy", "CartPole-v1", buffer_size=100, device="cpu").save(tmp_path / "discrete")
    with pytest.raises(ValueError, match=r"EqRSAC: policy must be derived from EqRSACPolicy, got .*EqRQRDQNPolicy"):
        EqRSAC.load(tmp_path / "discrete")


class Backbone(BaseFeaturesExtractor):
    """Keeps a large module outside of its parameters."""

    def __init__(self, observation_space, n_bytes):
        super().__init__(observation_space, 3)
        self.frozen = [th.empty(n_bytes, dtype=th.uint8)]

    def forward(self, observations):
        return observations


def test_an_agent_much_larger_than_its_file_needs_trust(tmp_path, monkeypatch):
    kwargs = {"features_extractor_class": Backbone, "features_extractor_kwargs": {"n_bytes": 200_000_000}}
    make(EqRSAC, policy_kwargs=kwargs).save(tmp_path / "large")
    monkeypatch.setattr(models, "_decoded", lambda path, data, trust, decoded=models._decoded: decoded(path, data, True))
    with pytest.raises(ValueError, match="much larger than the file"):
        EqRSAC.load(tmp_path / "large")
    assert EqRSAC.load(tmp_path / "large", trust=True).policy.encoder is not None


def test_unscaled_observations_need_no_statistics():
    model = make(EqRSAC, VecNormalize(make_vec_env(MoveEnv), norm_obs=False)).learn(40)
    model.set_env(MoveEnv())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(40)
