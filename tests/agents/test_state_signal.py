"""The input of the latent model, and the two gradients at the state."""

from copy import deepcopy

import numpy as np
import pytest
import torch as th
from torch import nn

from experiments.state_signal import signal
from sb3_eqr import EqRQRDQN, EqRRainbow, GroupFeaturesExtractor, load_configuration
from sb3_eqr.common.networks.target_copy import TargetCopy
from sb3_eqr.envs import make_atari100k_env
from tests.toys import ChainEnv, ImageEnv

SETTINGS = {"learning_starts": 20, "buffer_size": 200, "batch_size": 8, "n_steps": 2, "prediction_depth": 3, "seed": 0}
SMALL_NETWORK = {"n_blocks": 4, "net_arch": [16]}


def trained(kind=EqRRainbow, env=None, **changes):
    return kind("MlpPolicy", env or ChainEnv(), **{**SETTINGS, **changes}).learn(60)


def test_layer_norm_gives_each_sample_mean_0_and_variance_1():
    for network in ({}, {"group": None}, {"head_input": "state"}):
        model = EqRQRDQN("CnnPolicy", ImageEnv(), **{**SETTINGS, "symmetry_coef": 0.0}, policy_kwargs=network)
        encoder = model.policy.online.features_extractor
        trunk = encoder.trunk if "head_input" in network else encoder
        features = trunk(th.rand(5, 1, 36, 36)).detach().numpy()
        np.testing.assert_allclose(features.mean(axis=1), 0, atol=1e-6)
        np.testing.assert_allclose(features.std(axis=1), 1, atol=2e-2)  # ε of the norm


@pytest.mark.parametrize("latent_tau", [None, 1.0])
def test_the_head_sees_the_trunk_and_the_latent_model_computes_the_state(latent_tau):
    model = trained(policy_kwargs={**SMALL_NETWORK, "latent_tau": latent_tau}, target_update_interval=1_000)
    policy, layer = model.policy, model.policy.latent_model.embedding
    inputs = th.rand(5, 3)
    features = policy.online.features_extractor(inputs)
    np.testing.assert_allclose(features.detach().std(dim=1, correction=0), 1, atol=2e-2)  # layer norm only
    assert policy.latent_model.state_dim == 4 * 6 and policy.online.head.first[0].weight.shape[1] == features.shape[1] == 256
    elements = layer.group.element(layer.to_algebra(features).view(5, 4, 3)).flatten(1)
    assert th.equal(layer(features), elements)
    is_up_to_date = th.equal(policy.latent_target.embedding(features), elements)
    assert is_up_to_date is (latent_tau == 1.0)


def test_a_head_on_the_trunk_needs_its_own_projection():
    with pytest.raises(ValueError, match=r'projection must be "own" or "none" if head_input="trunk".*got "head"'):
        EqRRainbow("MlpPolicy", ChainEnv(), policy_kwargs={"projection": "head"})


@pytest.mark.parametrize("share", [None, 0.02])
@pytest.mark.parametrize("kind, head_input, double_q", [(EqRRainbow, "state", True), (EqRQRDQN, "trunk", False)])
def test_the_encoder_gets_no_more_of_the_auxiliary_gradient_than_its_share(kind, share, head_input, double_q):
    """Computed loss by loss: each one gives its gradient at the state and at the encoder's weights."""
    settings = {"aux_gradient_share": share, "symmetry_coef": 0.0}  # the only loss that samples partners
    network = {"layer_norm": True, "projection": "own", "noisy": False, "head_input": head_input}
    model = trained(kind, **settings, double_q=double_q, policy_kwargs=network)
    policy, samples = model.policy, model.replay_buffer.sample(8)
    weight = next(policy.online.features_extractor.parameters())  # the trunk's first weight
    states = []
    policy.online.features_extractor.register_forward_hook(
        lambda module, args, out: states.append(out) if out.requires_grad else None
    )

    def gradients(td, aet, reward):
        states.clear()
        terms = model.objective(samples, {"td": td, "aet": aet, "symmetry": 0.0, "reward": reward})
        return (*th.autograd.grad(terms.loss, [states[0], weight], retain_graph=True), terms)

    of_td, td_weight, _ = gradients(1.0, 0.0, 0.0)
    of_auxiliary, auxiliary_weight, _ = gradients(0.0, 1.0, 1.0)
    ratio = (of_td.norm() / of_auxiliary.norm()).item()
    scale = 1.0 if share is None else min(1.0, share * ratio)
    assert share is None or scale < 1  # otherwise the test proves nothing
    _, found, terms = gradients(1.0, 1.0, 1.0)
    th.testing.assert_close(found, td_weight + scale * auxiliary_weight, rtol=1e-4, atol=1e-7)
    metrics = terms.metrics()
    assert metrics["td_state_gradient"].item() == pytest.approx(of_td.norm().item(), rel=1e-4)
    assert metrics["aux_state_gradient"].item() == pytest.approx(of_auxiliary.norm().item(), rel=1e-4)
    cosine = nn.functional.cosine_similarity(of_td.flatten(), of_auxiliary.flatten(), dim=0).item()
    assert metrics["state_gradient_cosine"].item() == pytest.approx(cosine, abs=1e-4)


def test_the_gradients_are_logged():
    model = trained().learn(10, reset_num_timesteps=False, log_interval=None)
    assert {"train/td_state_gradient", "train/aux_state_gradient", "train/state_gradient_cosine"} <= set(
        model.logger.name_to_value
    )


@pytest.mark.parametrize("latent_tau, whiten", [(1.0, False), (1.0, True), (0.25, False)])
def test_the_latent_target_is_updated_separately(latent_tau, whiten):
    model = trained(policy_kwargs={"latent_tau": latent_tau, "whiten": whiten}, target_update_interval=1_000)
    policy = model.policy
    assert (policy.latent_encoder is None) == (latent_tau == 1.0)  # otherwise it is a copy
    q_target = [p.clone() for p in policy.target.parameters()]
    pairs = policy.latent_target_copy.pairs
    parameters = [pair for online, target in pairs for pair in zip(online.parameters(), target.parameters(), strict=True)]
    before = [target.clone() for _, target in parameters]
    with th.no_grad():
        for part in (policy.online, policy.latent_model):
            for p in part.parameters():
                p.add_(1.0)
    policy.after_gradient_step()
    assert all(th.equal(a, b) for a, b in zip(q_target, policy.target.parameters(), strict=True))
    for (online, after), old in zip(parameters, before, strict=True):
        th.testing.assert_close(after, old + latent_tau * (online - old))


@pytest.mark.parametrize("head_input", ["trunk", "state"])
def test_a_copied_latent_target_equals_the_online_encoder(head_input):
    """With latent_tau=1 the online encoder computes x̄₀ ... x̄_M, and x̄₀ together with x₀, with the same results."""
    states = []
    network = {"latent_tau": 1.0, "noisy": False, "head_input": head_input}
    for shortcut in (True, False):
        model = EqRRainbow("MlpPolicy", ChainEnv(), **SETTINGS, target_update_interval=20, policy_kwargs=network)
        policy, objective = model.policy, model.objective
        assert objective.latent_encoder is objective.encoder is not objective.target_encoder
        if not shortcut:
            objective.latent_encoder = deepcopy(objective.encoder).requires_grad_(False).eval()
            policy.latent_target_copy = TargetCopy(
                [*policy.latent_target_copy.pairs, (objective.encoder, objective.latent_encoder)]
            )
        states.append(model.learn(60).policy.state_dict())
    assert all(th.equal(states[0][key], states[1][key]) for key in states[0])


@pytest.mark.parametrize("projection", ["head", "own", "none"])
def test_the_predictor_is_on_the_online_side_only(projection):
    head_input = "state" if projection == "head" else "trunk"
    model = trained(policy_kwargs={"projection": projection, "predictor": True, "head_input": head_input})
    policy = model.policy
    rows = th.randn(5, policy.latent_model.state_dim)
    projected = rows
    if projection != "none":
        layer = policy.online.head.first[0] if projection == "head" else policy.latent_model.projection
        projected = rows @ layer.weight.T + layer.bias
    predictor = policy.latent_model.predictor
    th.testing.assert_close(policy.latent_model.project(rows), projected @ predictor.weight.T + predictor.bias)
    th.testing.assert_close(policy.latent_target.projection(rows), projected)  # a copy of the projection alone


def test_a_new_predictor_changes_nothing():
    """As the identity, except with SPR's own transition, which has PyTorch's weights."""
    policy, rows = EqRRainbow("MlpPolicy", ChainEnv(), seed=0).policy, th.randn(5, 72)
    th.testing.assert_close(policy.latent_model.project(rows), policy.latent_target.projection(rows))
    spr = {"group": None, "transition": "convolutional", "projection": "none", "predictor": True, "layer_norm": False}
    spr |= {"features_extractor_kwargs": {"layers": [[4, 8, 4], [8, 3, 1]], "rescale": True}}
    policy = EqRRainbow("CnnPolicy", ImageEnv(), symmetry_coef=0.0, seed=0, policy_kwargs=spr).policy
    assert policy.latent_model.predictor.weight.diagonal().abs().max() < 0.5


def test_spr_trains_saves_and_loads(tmp_path):
    settings = {**SETTINGS, "aet_coef": 5.0, "symmetry_coef": 0.0, "reward_coef": 0.0}
    policy_kwargs = {"group": None, "transition": "convolutional", "predictor": True, "latent_tau": 1.0, "layer_norm": False}
    policy_kwargs |= {"features_extractor_kwargs": {"layers": [[4, 8, 4], [8, 3, 1]], "rescale": True}}
    model = EqRRainbow("CnnPolicy", ImageEnv(), **settings, policy_kwargs=policy_kwargs)
    before = [p.clone() for p in model.policy.latent_model.transition.parameters()]
    model.learn(60)
    assert not any(th.equal(a, b) for a, b in zip(before, model.policy.latent_model.transition.parameters(), strict=True))
    model.save(tmp_path / "spr")
    loaded = EqRRainbow.load(tmp_path / "spr")
    observation = model.env.reset()
    assert (loaded.predict(observation, deterministic=True)[0] == model.predict(observation, deterministic=True)[0]).all()
    other = EqRRainbow("CnnPolicy", ImageEnv(), **settings, policy_kwargs=policy_kwargs)
    other.load_representation(tmp_path / "spr", freeze=True)
    parts = [dict(one.policy.latent_model.transition.state_dict()) for one in (model, other)]
    assert all(th.equal(parts[0][key], parts[1][key]) for key in parts[0])


def test_a_convolutional_transition_needs_a_feature_map():
    spr = {"transition": "convolutional", "group": None, "layer_norm": False}
    with pytest.raises(ValueError, match=r"must have rescale=True if transition"):
        EqRRainbow("CnnPolicy", ImageEnv(), symmetry_coef=0.0, policy_kwargs=spr)
    with pytest.raises(ValueError, match=r"group must be None if transition"):
        EqRRainbow("CnnPolicy", ImageEnv(), policy_kwargs={"transition": "convolutional"})
    with pytest.raises(ValueError, match=r"must be an image trunk.*got MlpExtractor"):
        EqRRainbow("MlpPolicy", ChainEnv(), symmetry_coef=0.0, policy_kwargs=spr)
    with pytest.raises(ValueError, match=r"group must have inverses for the GET loss, got None. Pass symmetry_coef=0\.$"):
        EqRRainbow("CnnPolicy", ImageEnv(), policy_kwargs={**spr, "features_extractor_kwargs": {"rescale": True}})
    with pytest.raises(ValueError, match=r"layer_norm must be False if transition"):
        EqRRainbow("CnnPolicy", ImageEnv(), symmetry_coef=0.0, policy_kwargs={**spr, "layer_norm": True})


def test_a_group_encoder_cannot_be_a_trunk():
    policy_kwargs = {"features_extractor_class": GroupFeaturesExtractor}
    with pytest.raises(ValueError, match=r'must be a trunk .*got a group encoder. Pass head_input="state"'):
        EqRRainbow("MlpPolicy", ChainEnv(), policy_kwargs=policy_kwargs)
    model = EqRRainbow("MlpPolicy", ChainEnv(), policy_kwargs={**policy_kwargs, "head_input": "state", "projection": "head"})
    assert isinstance(model.policy.online.features_extractor, GroupFeaturesExtractor)


def test_the_trunk_for_vectors():
    model = trained()
    trunk = model.policy.online.features_extractor.trunk
    inputs = th.rand(5, 3)
    weight, bias = trunk.layers[1].weight, trunk.layers[1].bias
    assert weight.shape == (256, 3)
    th.testing.assert_close(trunk(inputs), (inputs @ weight.T + bias).clamp(min=0))
    with pytest.raises(ValueError, match=r"features_dim must be an integer >= 1"):
        trained(policy_kwargs={"features_extractor_kwargs": {"features_dim": 0}})


@pytest.mark.parametrize("configuration, low, high", [("default", 0.2, np.inf), ("paper", 0.0, 0.01)])
def test_the_logits_of_a_new_agent_depend_on_the_frames(configuration, low, high):
    """Their spread over frames of Krull, compared with that over noise samples (experiments/notes/gradients.md)."""
    arguments = {} if configuration == "default" else load_configuration(configuration)
    small = {"buffer_size": 400, "learning_starts": 300, "seed": 0}
    model = EqRRainbow("CnnPolicy", make_atari100k_env("Krull", seed=0), **{**arguments, **small}).learn(200)
    found = signal(model, model.replay_buffer.sample(64).observations.numpy())
    assert low <= found["logits_over_states"] / found["logits_over_noise"] <= high


@pytest.mark.slow
def test_the_trunk_does_not_grow_in_the_first_updates():
    """If the gradient of a constant reached the trunk, its features would grow by a factor of 60 to 107 on Boxing."""
    settings = {"buffer_size": 300, "learning_starts": 200, "seed": 0}
    model = EqRRainbow("CnnPolicy", make_atari100k_env("Boxing", seed=0), **settings).learn(200)
    trunk, frames = model.policy.online.features_extractor.trunk, model.replay_buffer.sample(64).observations / 255
    before = trunk(frames).max().item()
    model.train(100, 32)
    assert trunk(frames).max().item() < 5 * before


@pytest.mark.slow
def test_frames_stay_different_in_the_first_updates():
    """Without centring, the TD loss makes the features of all frames of Pong alike within 60 updates."""
    spreads = {}
    for center in (True, False):
        settings = {"buffer_size": 300, "learning_starts": 200, "seed": 0, "prediction_depth": 0}
        policy_kwargs = {"center": center, "group": None}
        model = EqRRainbow("CnnPolicy", make_atari100k_env("Pong", seed=0), **settings, policy_kwargs=policy_kwargs)
        model.learn(200).train(60, 16)
        model.policy.set_training_mode(False)
        with th.no_grad():
            features = model.policy.online.features(model.replay_buffer.sample(64).observations)
        spreads[center] = (features.var(dim=0, correction=0).sum().sqrt() / features.norm(dim=1).mean()).item()
    assert spreads[True] > 0.2 > 2 * spreads[False]


@pytest.mark.parametrize("n_copies, n_averages", [pytest.param(150, 50, marks=pytest.mark.slow), (0, 50)])
def test_an_averaged_target_has_centred_features(n_copies, n_averages):
    """
    The mean of the target's features over frames, relative to their spread, is about that of the online network. If the
    running mean were copied and the weights averaged, it would be 4 to 6 times as large, and the actions would change.
    """
    settings = {"buffer_size": 300, "learning_starts": 200, "seed": 0, "prediction_depth": 0}
    env = make_atari100k_env("Boxing", seed=0)
    model = EqRRainbow("CnnPolicy", env, **settings, tau=0.005, policy_kwargs={"group": None}).learn(200)
    for _ in range(n_copies):
        model.train(1, 32)
        model.policy.update_target(1.0)
    model.train(n_averages, 32)
    model.policy.set_training_mode(False)
    frames, offsets = model.replay_buffer.sample(64).observations, []
    for network in (model.policy.online, model.policy.target):
        with th.no_grad():
            features = network.features(frames)
        offsets.append((features.mean(dim=0).norm() / features.var(dim=0).sum().sqrt()).item())
    assert offsets[1] < 1.5 * offsets[0], offsets


def test_a_reset_starts_the_statistics_of_features_again():
    """The first batch after it replaces the running mean, in the online network and in an averaged target."""
    model = EqRRainbow("MlpPolicy", ChainEnv(), **SETTINGS, tau=0.005).learn(60)
    model._reset()
    for network in (model.policy.online, model.policy.target):
        assert network.features_extractor.center.running_count == 0
    model.train(1, 32)
    means = [network.features_extractor.center.running_mean for network in (model.policy.online, model.policy.target)]
    assert th.equal(*means) and means[0].norm() > 0
