"""Relations between agents that hold bit for bit."""

import pytest
import torch as th
from sb3_contrib import QRDQN
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import NatureCNN

from sb3_eqr import EqRQRDQN, GroupFeaturesExtractor
from sb3_eqr.common.networks.encoders import ConvExtractor, ConvTrunk
from tests.models import BOTH, PAPER, PAPER_FLAT, same
from tests.toys import ChainEnv, ImageEnv

OFF = {"aet_coef": 0.0, "symmetry_coef": 0.0, "reward_coef": 0.0, "aux_gradient_share": None}
OFF |= {"double_q": False, "prioritized_replay": False, "shift_pixels": 0, "intensity_scale": 0.0}
SHARED = {"learning_rate": 1e-3, "buffer_size": 300, "learning_starts": 40, "batch_size": 32, "gamma": 0.98, "train_freq": 4}
SHARED |= {"gradient_steps": 2, "target_update_interval": 50, "exploration_fraction": 0.5, "exploration_final_eps": 0.1}
SHARED |= {"n_steps": 1, "max_grad_norm": None, "seed": 3, "device": "cpu"}
# The optimiser has the same kernel, because Adam's three kernels round differently.
NETWORK = {"n_quantiles": 20, "net_arch": [32], "optimizer_class": th.optim.Adam}
NETWORK |= {"optimizer_kwargs": {"eps": 1e-4, "fused": True}}


def assert_same_networks(ours, theirs):
    assert ours._n_updates == theirs._n_updates > 0
    for name in ("quantile_net", "quantile_net_target"):
        mine, other = (list(getattr(model, name).parameters()) for model in (ours, theirs))
        assert mine and same(mine, other)


@pytest.mark.parametrize("n_envs, n_steps, max_grad_norm, tau", [(1, 1, None, 1.0), (1, 3, 10.0, 1.0), (3, 5, 0.5, 0.3)])
def test_with_every_switch_off_it_equals_qrdqn(n_envs, n_steps, max_grad_norm, tau):
    extra = {"n_steps": n_steps, "max_grad_norm": max_grad_norm, "tau": tau}
    env = [make_vec_env(ChainEnv, n_envs) for _ in range(2)]
    theirs = QRDQN("MlpPolicy", env[0], policy_kwargs=dict(NETWORK), **{**SHARED, **extra}).learn(300)
    off = {**PAPER_FLAT, "group": None, "dueling": False, "noisy": False}
    ours = EqRQRDQN("MlpPolicy", env[1], policy_kwargs={**NETWORK, **off}, **{**SHARED, **OFF, **extra}).learn(300)
    assert_same_networks(ours, theirs)


@pytest.mark.parametrize("extractor", [NatureCNN, ConvExtractor])
def test_with_every_switch_off_it_equals_qrdqn_on_images(extractor):
    shared = {**SHARED, "train_freq": 8, "gradient_steps": 1}
    trunk = {"features_extractor_class": extractor}
    theirs = QRDQN("CnnPolicy", ImageEnv(), policy_kwargs={**NETWORK, **trunk}, **shared)
    for module in theirs.policy.modules():
        if isinstance(module, ConvTrunk):
            module.to_channels_last()  # as ours: convolutions round differently in another layout
    theirs.learn(120)
    off = {**PAPER, "group": None, "dueling": False, "noisy": False}
    ours = EqRQRDQN("CnnPolicy", ImageEnv(), policy_kwargs={**NETWORK, **trunk, **off}, **shared, **OFF).learn(120)
    assert_same_networks(ours, theirs)


def test_the_group_encoder_is_a_plain_features_extractor():
    """The same encoder in stock QRDQN and in EqRQRDQN."""
    encoder = {"group": "SE(2)", "n_blocks": 3}
    theirs_kwargs = {**NETWORK, "features_extractor_class": GroupFeaturesExtractor, "features_extractor_kwargs": encoder}
    theirs = QRDQN("MlpPolicy", ChainEnv(), policy_kwargs=theirs_kwargs, **SHARED).learn(200)
    ours_kwargs = {**NETWORK, **encoder, **PAPER_FLAT, "dueling": False, "noisy": False}
    ours = EqRQRDQN("MlpPolicy", ChainEnv(), policy_kwargs=ours_kwargs, **SHARED, **OFF).learn(200)
    assert_same_networks(ours, theirs)


@pytest.mark.parametrize("switched_off", ["aet_coef", "symmetry_coef", "reward_coef", "prediction_depth"])
def test_each_switch_has_an_effect(switched_off):
    """The relation above would prove nothing if the switches had no effect."""
    settings = {**SHARED, "n_steps": 3, "prediction_depth": 2, "target_update_interval": None}
    full = EqRQRDQN("MlpPolicy", ChainEnv(), **settings).learn(70)
    less = EqRQRDQN("MlpPolicy", ChainEnv(), **{**settings, switched_off: 0}).learn(70)
    assert not same(full.quantile_net, less.quantile_net)


def test_same_seed_same_run_and_different_seed_different_run():
    settings = {**SHARED, "n_steps": 3, "target_update_interval": None}
    a, b, c = (EqRQRDQN("MlpPolicy", ChainEnv(), **{**settings, "seed": s}).learn(80) for s in (1, 1, 2))
    assert same(a, b) and not same(a, c)


@BOTH
def test_sharing_the_target_pass_changes_no_number(network):
    """If the target is a copy of the online networks, one pass computes both, with the same results."""
    models = []
    for shortcut in (True, False):
        settings = {**SHARED, "target_update_interval": None, "n_steps": 3, "prediction_depth": 2}
        model = EqRQRDQN("MlpPolicy", ChainEnv(), **settings, policy_kwargs={**network, "noisy": False})
        objective = model.objective
        assert objective.target_encoder is objective.latent_encoder is objective.encoder
        if not shortcut:
            objective.target_encoder = objective.latent_encoder = model.policy.target.features_extractor
        models.append(model.learn(70))
    assert same(*models)
