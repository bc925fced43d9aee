"""A single update in detail: targets, weights, priorities, gradients."""

import copy
import inspect

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

from sb3_eqr import GroupFeaturesExtractor
from sb3_eqr.common.networks import inputs
from sb3_eqr.common.networks.encoders import NormalizedExtractor
from sb3_eqr.common.policies import ignores_mode
from tests.models import EITHER, MAKERS, PAPER, loss_terms, tensors, train_on
from tests.toys import ChainEnv, ImageEnv, SampledEnv


def trained_model(make, **kwargs):
    policy_kwargs = {"noisy": False, **kwargs.pop("policy_kwargs", {})}
    settings = {"tau": 0.1, "exploration_final_eps": 0.1, **kwargs}
    return make(ChainEnv(), policy_kwargs=policy_kwargs, **settings).learn(60)


@pytest.mark.parametrize("dropout", [0.0, 0.5])
@pytest.mark.parametrize("make", [lambda p: th.nn.GRU(4, 4, 2, dropout=p), lambda p: th.nn.Sequential(th.nn.Dropout(p))])
def test_modules_with_dropout_depend_on_the_mode(make, dropout):
    """A target shares a trunk only if it computes the same in both modes. A GRU's dropout is a number, not a module."""
    th.manual_seed(0)
    module, inputs = make(dropout), th.ones(3, 4)
    outputs = [found[0] if isinstance(found := module.train(mode)(inputs), tuple) else found for mode in (True, False)]
    assert th.equal(*outputs) == (dropout == 0)
    assert ignores_mode(module) <= th.equal(*outputs)


@pytest.mark.parametrize("double_q", [True, False])
@pytest.mark.parametrize("dueling", [True, False])
def test_quantile_td_loss_by_loops(double_q, dueling):
    model = trained_model(MAKERS[0], double_q=double_q, policy_kwargs={"dueling": dueling}, prediction_depth=0, gamma=0.9)
    model.policy.set_training_mode(False)
    samples = model.replay_buffer.sample(16)
    with th.no_grad():
        td = loss_terms(model, samples)
        now = model.policy.online(samples.observations).double().numpy()  # (16, 9, 3)
        online = model.policy.online(samples.next_observations).double().numpy()
        target = model.policy.target(samples.next_observations).double().numpy()
    assert not np.allclose(online, target)  # otherwise the test could not detect double Q-learning
    chosen = set()
    for b in range(16):
        best = int(np.argmax((online if double_q else target)[b].mean(axis=0)))
        chosen.add(best == int(np.argmax(target[b].mean(axis=0))))
        alive = 1 - samples.dones[b, 0].item()
        goal = samples.rewards[b, 0].item() + alive * samples.discounts[b, 0].item() * target[b, :, best]
        current = now[b, :, samples.actions[b, 0].item()]
        expected = 0.0
        for i in range(9):
            for j in range(9):
                u = goal[j] - current[i]
                huber = 0.5 * u * u if abs(u) <= 1 else abs(u) - 0.5
                expected += abs((i + 0.5) / 9 - (u < 0)) * huber / 9
        assert td.losses["td"][b].item() == pytest.approx(expected, rel=1e-4)
        assert td.q_values[b].item() == pytest.approx(current.mean(), rel=1e-4, abs=1e-6)
    assert th.equal(td.priorities, td.losses["td"])


@pytest.mark.parametrize("double_q", [True, False])
@pytest.mark.parametrize("dueling", [True, False])
def test_categorical_td_loss_by_loops(double_q, dueling):
    """Each atom of the target distribution is moved, clipped and split by hand, in float64."""
    network = {"dueling": dueling, "v_min": -1.0, "v_max": 2.0}
    model = trained_model(MAKERS[1], double_q=double_q, policy_kwargs=network, prediction_depth=0, gamma=0.9)
    model.policy.set_training_mode(False)
    with th.no_grad():  # a target network that chooses other actions
        for parameter in model.q_net_target.head.advantage[-1].parameters():
            parameter.neg_()
    samples = model.replay_buffer.sample(16)
    with th.no_grad():
        td = loss_terms(model, samples)
        asked = [(model.q_net, samples.observations)]
        asked += [(net, samples.next_observations) for net in (model.q_net, model.q_net_target)]
        now, online, target = (net.head(net.features(obs)).log_softmax(dim=1).double().numpy() for net, obs in asked)
    support = [-1.0 + 3.0 * i / 8 for i in range(9)]
    q_values = [np.einsum("bna,n->ba", np.exp(logs), support) for logs in (online, target)]
    assert (q_values[0].argmax(axis=1) != q_values[1].argmax(axis=1)).any()
    for b in range(16):
        best = int(np.argmax(q_values[0 if double_q else 1][b]))
        alive = 1 - samples.dones[b, 0].item()
        goal = np.zeros(9)
        for j in range(9):
            value = samples.rewards[b, 0].item() + alive * samples.discounts[b, 0].item() * support[j]
            place = (min(max(value, -1.0), 2.0) + 1.0) / 0.375
            below = min(int(place), 7)
            goal[below] += np.exp(target[b, j, best]) * (below + 1 - place)
            goal[below + 1] += np.exp(target[b, j, best]) * (place - below)
        current = now[b, :, samples.actions[b, 0].item()]
        cross_entropy = -sum(goal * current)
        divergence = sum(g * (np.log(g) - c) for g, c in zip(goal, current, strict=True) if g > 0)
        assert td.losses["td"][b].item() == pytest.approx(cross_entropy, rel=1e-5)
        assert td.priorities[b].item() == pytest.approx(max(divergence, 0), rel=1e-4, abs=2e-6)
        assert td.q_values[b].item() == pytest.approx(np.exp(current) @ support, rel=1e-5, abs=1e-6)


def inputs_of_the_latent_model(model, samples, monkeypatch):
    """The arguments of the latent model in an update, by name, and the latent encoder's inputs."""
    seen, kind = {}, type(model.policy.latent_model)
    forward, names = kind.forward, list(inspect.signature(kind.forward).parameters)[1:]

    def watched(self, *args):
        seen.update(zip(names, args, strict=True))
        return forward(self, *args)

    monkeypatch.setattr(kind, "forward", watched)
    loss_terms(model, samples)
    return seen


@pytest.mark.parametrize("network", [PAPER, {}, {"latent_tau": 0.25}], ids=["paper", "default", "slow latent target"])
def test_target_states_reach_the_latent_model_in_order(make, monkeypatch, network):
    """The online features of s_t, and the target's states of s_t, s_{t+1} ... s_{t+M}, each in the right place."""
    model = trained_model(make, policy_kwargs=network)
    samples, policy = model.replay_buffer.sample(8), model.policy
    seen = inputs_of_the_latent_model(model, samples, monkeypatch)
    target = {"paper": policy.target.features_extractor, "default": policy.online.features_extractor}
    encoder = policy.latent_encoder or target["paper" if network else "default"]
    encoded = policy.online.features_extractor(samples.observations)
    th.testing.assert_close(seen["features"], encoded)
    # If the target is a different network, its features must differ, otherwise the test proves nothing.
    assert th.allclose(encoded, encoder(samples.observations)) == (network == {})
    hot = th.nn.functional.one_hot(samples.rollout_actions * samples.mask.long(), 3).float()
    assert th.equal(seen["actions"], hot) and seen["target"] is policy.latent_target
    assert seen["rewards"] is samples.rollout_rewards and seen["mask"] is samples.mask
    rollout, embedding = seen["target_states"].view(8, 2, -1), policy.latent_target.embedding
    assert not rollout.requires_grad and not seen["target_state"].requires_grad
    th.testing.assert_close(seen["target_state"], embedding(encoder(samples.observations)).detach())
    for m in range(2):
        th.testing.assert_close(rollout[:, m], embedding(encoder(samples.rollout_observations[:, m])).detach())


@EITHER
def test_the_target_encodes_the_same_augmented_image(make, monkeypatch):
    """A target that equals the online encoder gives the same states, although both are computed."""
    model = make(ImageEnv(), "CnnPolicy", policy_kwargs={"latent_tau": 0.25}).learn(44)
    model.policy.latent_target_copy.update(1.0)
    seen = inputs_of_the_latent_model(model, model.replay_buffer.sample(8), monkeypatch)
    assert model.policy.latent_encoder is not model.policy.online.features_extractor
    th.testing.assert_close(seen["target_state"], model.policy.latent_model.embedding(seen["features"]).detach())


def test_an_update_sees_normalised_observations_and_rewards(make, monkeypatch):
    env = VecNormalize(make_vec_env(ChainEnv))
    model = make(env).learn(60)
    env.obs_rms.mean, env.obs_rms.var = np.full(3, 1000.0), np.ones(3)
    env.ret_rms.var = np.array(1e-8)  # rewards are -1, 0 or 1
    seen, objective_ = [], model.objective
    monkeypatch.setattr(model, "objective", lambda *args: seen.append(args[0]) or objective_(*args))
    model.train(1, 32)
    assert (seen[0].observations == -env.clip_obs).all()
    assert set(seen[0].rollout_rewards.unique().tolist()) == {-env.clip_reward, 0.0, env.clip_reward}


def test_replay_weights_multiply_every_loss(make):
    model = trained_model(make, max_grad_norm=None, learning_rate=1e-3)
    samples = model.replay_buffer.sample(8)
    before = tensors(model)

    def gradients(weights):
        model.policy.load_state_dict(before)
        th.manual_seed(0)
        train_on(model, samples._replace(weights=weights))
        return [p.grad.clone() for p in model._trained]

    full = gradients(th.ones(8))
    half = gradients(th.full((8,), 0.5))
    none = gradients(th.zeros(8))
    assert all(th.isfinite(g).all() and g.abs().sum() > 0 for g in full)
    for f, h, n in zip(full, half, none, strict=True):
        th.testing.assert_close(h, f / 2)
        assert (n == 0).all()


def test_the_loss_is_the_weighted_mean_of_its_terms(make):
    model = trained_model(make, td_coef=2.0, aet_coef=0.5, symmetry_coef=0.25, reward_coef=3.0)
    samples = model.replay_buffer.sample(8)._replace(weights=th.rand(8))
    losses, loss, *_ = loss_terms(model, samples)
    expected = 2.0 * losses["td"] + 0.5 * losses["aet"] + 0.25 * losses["symmetry"] + 3.0 * losses["reward"]
    assert min(losses[name].abs().min() for name in ("td", "aet", "symmetry")) > 0
    th.testing.assert_close(loss, (samples.weights * expected).mean())


@EITHER
@pytest.mark.parametrize("name", ["td", "aet", "symmetry", "reward"])
def test_a_loss_with_weight_0_is_not_computed(make, name):
    model = trained_model(make)
    samples = model.replay_buffer.sample(8)
    found = []
    for weights in (model.loss_coefs, {**model.loss_coefs, name: 0.0}):
        th.manual_seed(0)
        found.append(model.objective(samples, weights).losses)
    assert found[1].keys() == model.loss_coefs.keys() - {name}
    assert all(th.equal(loss, found[0][other]) for other, loss in found[1].items())


def test_new_priorities_come_from_the_td_loss(make):
    model = trained_model(make, replay_buffer_kwargs={"alpha": 0.5})
    samples = model.replay_buffer.sample(8)
    with th.no_grad():
        td = loss_terms(model, samples)
    train_on(model, samples)
    last = {int(i): b for b, i in enumerate(samples.indices)}  # the last of several samples of a transition counts
    expected = (td.priorities[list(last.values())] + 1e-6) ** 0.5
    np.testing.assert_allclose(model.replay_buffer._tree.get(np.array(list(last))), expected, rtol=1e-5)


def test_gradients_of_network_and_latent_model_are_clipped_apart(make):
    model = trained_model(make, max_grad_norm=0.01)
    train_on(model, model.replay_buffer.sample(8))
    parts = [model.policy.online, model.policy.latent_model]
    for part in parts:
        norm = th.stack([p.grad.norm() for p in part.parameters() if p.grad is not None]).norm().item()
        assert norm == pytest.approx(0.01, rel=1e-3)
    assert {*model._trained} == {p for part in parts for p in part.parameters()}


@pytest.mark.slow
def test_large_rewards_are_learned():
    """Action 1 has the reward c, the others none; one state, without end. With γ = ½, Q of action 1 is 2c."""
    c = 1e3

    class Bandit(ChainEnv):
        def step(self, action):
            return self.observe(), c * float(action == 1), False, False, {}

        def observe(self):
            return np.ones(3, np.float32)

    settings = {"gamma": 0.5, "n_steps": 1, "learning_rate": 1e-3, "gradient_steps": 1, "exploration_final_eps": 0.2}
    network = {"net_arch": [256], "latent_hidden_dim": 64}
    model = MAKERS[0](Bandit(), **settings, batch_size=16, policy_kwargs=network).learn(400)
    with th.no_grad():
        quality = model.quantile_net(th.ones(1, 3)).mean(dim=1)[0, 1].item()
    assert 1.8 * c < quality < 2.2 * c


def calls_of(kind, monkeypatch):
    """A list that the next calls of a kind of network are added to: the network and the size of the batch."""
    forward, calls = kind.forward, []
    monkeypatch.setattr(kind, "forward", lambda self, obs: calls.append((self, len(obs))) or forward(self, obs))
    return calls


@pytest.mark.parametrize("network, encoder", [(PAPER, GroupFeaturesExtractor), ({}, NormalizedExtractor)])
def test_one_features_pass_is_used_for_all_losses(make, monkeypatch, network, encoder):
    model = make(ImageEnv(), "CnnPolicy", policy_kwargs=network).learn(44)
    calls = calls_of(encoder, monkeypatch)
    model.train(1, 8)
    online, target = model.policy.online.features_extractor, model.policy.target.features_extractor
    # s_t with gradient, then s_{t+n} and the rollout. The paper's target is the online network, too, but in eval mode.
    encoder = target if model.objective.target_encoder is target else online
    assert calls == [(online, 8), (encoder, 8), *([(online, 8)] if encoder is target else []), (encoder, 8 * 2)]


@pytest.mark.parametrize("policy, env", [("CnnPolicy", ImageEnv), ("MultiInputPolicy", SimpleMultiObsEnv)])
def test_bfloat16_only_where_no_gradient_flows(make, monkeypatch, policy, env):
    """The online pass and its gradients stay as they are; the other passes have bfloat16's precision of 2⁻⁸."""
    seen, conv2d = [], th.nn.Conv2d.forward

    def watched(self, images):
        seen.append((th.is_grad_enabled(), (found := conv2d(self, images)).dtype))
        return found

    model = make(env(), policy, double_q=True, tau=0.5).learn(44)
    samples = model.replay_buffer.sample(8)
    found = []
    for bfloat16_targets in (False, True):
        model.policy.bfloat16_targets = bfloat16_targets
        model._set_up_objective()
        monkeypatch.setattr(th.nn.Conv2d, "forward", watched)
        th.manual_seed(0)
        found.append(loss_terms(model, samples))
        monkeypatch.setattr(th.nn.Conv2d, "forward", conv2d)
    float32, bfloat16 = seen[: len(seen) // 2], seen[len(seen) // 2 :]
    assert {dtype for _, dtype in float32} == {th.float32}
    assert set(bfloat16) == {(True, th.float32), (False, th.bfloat16)}
    for name, loss in found[0].losses.items():
        th.testing.assert_close(found[1].losses[name], loss, rtol=0.05, atol=0.02)
    assert th.equal(found[0].losses["reward"], found[1].losses["reward"])  # it has no target


def test_bfloat16_without_instructions_for_it_warns(make, monkeypatch):
    monkeypatch.setattr(th.cpu, "get_capabilities", lambda: {"avx2": True, "avx512_bf16": False}, raising=False)
    with pytest.warns(UserWarning, match="no instructions for bfloat16 on cpu"):
        model = make(ChainEnv(), policy_kwargs={"bfloat16_targets": True})
    monkeypatch.setattr(th.cpu, "get_capabilities", lambda: {"amx_bf16": True}, raising=False)
    assert model.learn(60)._n_updates > 0


@pytest.mark.parametrize("symmetry_coef, n_encoded", [(0.0, 8 * 2), (1.0, 8 + 8 * 2)])
def test_the_target_encodes_the_first_state_for_the_get_loss_only(make, monkeypatch, symmetry_coef, n_encoded):
    model = make(ImageEnv(), "CnnPolicy", policy_kwargs={"latent_tau": 0.25}, symmetry_coef=symmetry_coef).learn(44)
    encoder = model.policy.latent_encoder
    calls = calls_of(type(encoder), monkeypatch)
    model.train(1, 8)
    assert sum(n for network, n in calls if network is encoder) == n_encoded


@EITHER
@pytest.mark.parametrize("images", ["one channel", "stacked", "in a dictionary"])
def test_a_fused_optimizer_trains_as_a_plain_one(make, images):
    """Fused, PyTorch's Adam ignores strides: it needs gradients in the memory layout of their parameters."""
    env = SimpleMultiObsEnv(channel_last=True) if images == "in a dictionary" else ImageEnv()
    env.reset(seed=0)
    trained = []
    for fused in (False, True):
        vec_env = make_vec_env(lambda: copy.deepcopy(env))
        vec_env = VecFrameStack(vec_env, 4) if images == "stacked" else vec_env
        policy = "MultiInputPolicy" if images == "in a dictionary" else "CnnPolicy"
        trained.append(make(vec_env, policy, policy_kwargs={"optimizer_kwargs": {"fused": fused}}).learn(50))
    assert trained[0]._n_updates > 0
    for a, b in zip(trained[0].policy.parameters(), trained[1].policy.parameters(), strict=True):
        th.testing.assert_close(a, b, rtol=1e-3, atol=2e-5)  # a step of the default learning rate is 1e-4


def test_online_and_target_observations_are_augmented(make, monkeypatch):
    model = make(ImageEnv(), "CnnPolicy").learn(44)
    seen = []
    shift = inputs.random_shift
    monkeypatch.setattr(inputs, "random_shift", lambda x, pad: seen.append(len(x)) or shift(x, pad))
    model.train(1, 8)
    assert seen == [8, 8, 16]


@pytest.mark.parametrize("off", [{"shift_pixels": 0}, {"intensity_scale": 0.0}, {}])
def test_augmentations_can_be_switched_off(make, off):
    model = make(ImageEnv(), "CnnPolicy", **off)
    images = th.randint(1, 256, (16, 1, 36, 36), dtype=th.uint8)
    found = model.objective.augment(images) * 255  # the networks' inputs are in [0, 1]
    moved = not all(th.equal((f > 0), (i > 0)) for f, i in zip(found, images, strict=True))
    assert not moved  # every pixel is above 0 before and after
    integral = th.allclose(found, found.round(), atol=1e-4, rtol=0)
    assert integral == ("intensity_scale" in off)
    if "shift_pixels" in off:
        ratios = (found / images).flatten(1)
        th.testing.assert_close(ratios, ratios[:, :1].expand_as(ratios))
    else:
        assert not th.allclose(found, images.float(), atol=0.5)


@pytest.mark.parametrize("normalize_images, low, high", [(False, 0.9, 1.1), (True, 0.9 / 255, 1.1 / 255)])
def test_float_images_keep_their_scale(normalize_images, low, high):
    """Intensities are drawn from 1 ± 0.05 clipped at two standard deviations; only bytes are divided by 255."""
    space = spaces.Box(0, 255, (1, 36, 36), np.uint8) if normalize_images else spaces.Box(0, 1, (1, 36, 36), np.float32)
    ones = th.ones((64, *space.shape), dtype=th.uint8 if normalize_images else th.float)
    found = inputs.Augmentation(space, normalize_images, 0, 0.05)(ones)
    assert low - 1e-6 <= found.min() < found.max() <= high + 1e-6


def test_logged_losses_are_means_over_updates(make):
    """Rounds of one and three updates: each update counts the same."""
    model = make(ChainEnv()).learn(50)
    add, seen = model._monitor.add, []
    model._monitor.add = lambda metrics: (seen.append(metrics["loss"].item()), add(metrics))
    for rounds in ([1, 3], [5, 2]):
        model.set_logger(Logger(None, []))
        seen.clear()
        for n in rounds:
            model.train(n, 8)
        model._log_last_round()
        assert model.logger.name_to_value["train/loss"] == pytest.approx(np.mean(seen)) and len(seen) == sum(rounds)


def test_the_learning_rate_is_never_negative(make):
    """The last round ends after total_timesteps, where a linear schedule such as RL Zoo's lin_1e-3 is negative."""
    seen = []
    model = make(ChainEnv(), learning_rate=lambda progress: seen.append(progress) or 1e-2 * progress, train_freq=64)
    model.learn(150)  # ends at 192
    assert model.num_timesteps == 192 and min(seen) == 0
    assert {group["lr"] for group in model.policy.optimizer.param_groups} == {0.0}


class Board(SampledEnv):
    """A 7×7 board of bytes, whose one piece is at the edge."""

    def __init__(self):
        super().__init__(spaces.Box(0, 255, (7, 7, 3), np.uint8))

    def observe(self):
        found = np.zeros((7, 7, 3), np.uint8)
        found[0, self.np_random.integers(7)] = 255
        return found


@pytest.mark.parametrize("policy", ["MlpPolicy", "CnnPolicy"])
def test_no_piece_is_shifted_out_of_a_small_board(make, policy):
    """A shift by 4 pixels would lose most of them; flattened bytes keep their brightness, too."""
    network = {"features_extractor_kwargs": {"layers": [[8, 3, 1]]}} if policy == "CnnPolicy" else {}
    model = make(Board(), policy, policy_kwargs=network).learn(46)
    found = model.objective.augment(model.replay_buffer.sample(32).observations)  # (32, 3, 7, 7)
    assert ((found > 0.5).flatten(1).sum(dim=1) == 3).all()
    assert (policy == "CnnPolicy") == bool(((found > 0) & (found != 1)).any())


@pytest.mark.parametrize("side, shift", [(84, 4), (64, 4), (40, 2), (15, 0)])
def test_the_shift_is_small_for_the_image(side, shift):
    space = spaces.Dict({"picture": spaces.Box(0, 255, (1, side, 96), np.uint8), "speed": spaces.Box(-1, 1, (2,))})
    assert inputs.Augmentation(space, True, 4, 0.0).shifts == {"picture": shift}
