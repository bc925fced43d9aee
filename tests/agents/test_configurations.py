"""The named configurations match the tables in the docs."""

import pathlib
import re
import warnings

import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecFrameStack

from sb3_eqr import EqRQRDQN, EqRRainbow, PrioritizedSequenceReplayBuffer, load_configuration
from sb3_eqr.benchmark.agents import find_agent, hyperparameters
from sb3_eqr.benchmark.suites import load_suite
from sb3_eqr.common.networks.encoders import ImpalaTrunk, NormalizedExtractor
from sb3_eqr.common.networks.layers import NoisyLinear
from sb3_eqr.common.resets import ResetSchedule
from sb3_eqr.configurations import configuration_files, merged, with_schedule
from tests.models import all_finite
from tests.toys import ImageEnv

ROOT = pathlib.Path(__file__).parents[2]
SMALL = {"learning_starts": 140, "buffer_size": 400, "batch_size": 8, "device": "cpu", "seed": 0}

# name: encoder, auxiliary losses
EXPECTED = {
    "mlp+aet+r": ("none(512)^1", {"aet", "reward"}),
    "t2+aet+r": ("T(2)^32", {"aet", "reward"}),
    "se2+aet+r": ("SE(2)^12", {"aet", "reward"}),
    "gl2+aet+r": ("GL(2)^12", {"aet", "reward"}),
    "se2+aet": ("SE(2)^12", {"aet"}),
    "se2+aet+get": ("SE(2)^12", {"aet", "symmetry"}),
    "spr": (None, {"aet"}),
    "deepmdp": ("none(512)^1", {"aet", "reward"}),
}
FULL = ("eqr_rainbow", "paper", "released", "se2+aet+r+get", "eqr_bbf")
EXPECTED |= dict.fromkeys(FULL, ("SE(2)^12", {"aet", "symmetry", "reward"}))
EXPECTED |= dict.fromkeys(("rainbow", "qrdqn", "der", "drq"), (None, set()))


# The agents of the paper's Tables 3 and 4, and of its released commands: what differs from "paper"
OF_TABLES = {
    "mlp+aet+r": {"symmetry_coef": 0.0, "policy_kwargs": {"group": "none", "n_blocks": 1}},
    "t2+aet+r": {"symmetry_coef": 0.0, "policy_kwargs": {"group": "T(2)", "n_blocks": 32}},
    "se2+aet+r": {"symmetry_coef": 0.0},
    "gl2+aet+r": {"symmetry_coef": 0.0, "policy_kwargs": {"group": "GL(2)"}},
    "se2+aet": {"symmetry_coef": 0.0, "reward_coef": 0.0},
    "se2+aet+get": {"reward_coef": 0.0},
    "se2+aet+r+get": {},
    "released": {"aet_coef": 1.0, "reward_coef": 0.8333, "policy_kwargs": {"reward_loss": "categorical"}},
}


def test_the_table_and_the_files_agree():
    """The table links each agent's file, which names the same papers; a sentence names the agents of the paper's tables."""
    text = (ROOT / "docs" / "choosing.md").read_text(encoding="utf-8")
    agents = re.findall(r"^\| `([^`]+)` \| (.+) \| \[(.+)\]\((.+)\) \|$", text, re.M)
    for name, description, file, target in agents:
        path = (ROOT / "docs" / target).resolve()
        assert path == configuration_files()[name].resolve() and file == path.name, name
        header = path.read_text(encoding="utf-8").split("\n\n")[0]
        assert all(paper in header for paper in re.findall(r"\((https:[^)]+)\)", description)), name
    assert all(f"`{name}`" in text for name in OF_TABLES)
    named = [name for name, *_ in agents] + list(OF_TABLES)
    files = {name for name, path in configuration_files().items() if path.parent.name == "ablations"}
    assert len(named) == len(set(named)) and set(named) == files == EXPECTED.keys() - {"eqr_rainbow"}


@pytest.mark.parametrize("name", OF_TABLES)
def test_the_agents_of_the_papers_tables(name):
    assert load_configuration("paper", **OF_TABLES[name]) == load_configuration(name)


@pytest.mark.parametrize("kind, name", [(EqRQRDQN, None), (EqRRainbow, None), (EqRRainbow, "paper")])
def test_table_5(kind, name):
    """Its numbers and those of appendix B.4, on the built agent; the defaults differ as docs/gradients.md says."""
    env = VecFrameStack(make_vec_env(lambda: ImageEnv((84, 84, 1))), 4)
    model = kind("CnnPolicy", env, **(load_configuration(name) if name else {}), device="cpu")
    assert (model.batch_size, model.gamma, model.learning_rate, model.max_grad_norm) == (32, 0.99, 1e-4, 10)
    assert (model.gradient_steps, model.n_steps, model.prediction_depth, model.tau) == (2, 10, 5, 1.0)
    assert (model.train_freq.frequency, model.train_freq.unit.value, model.frame_stack) == (1, "step", 4)
    buffer = model.replay_buffer
    assert (buffer.alpha, buffer.beta, buffer.final_beta) == (0.5, 0.4, 1.0)
    assert (model.shift_pixels, model.intensity_scale) == (4, 0.05)
    assert (model.exploration_fraction * 100_000, model.exploration_final_eps) == (2_000, 0)
    adam = model.policy.optimizer.defaults
    assert (adam["betas"], adam["eps"]) == ((0.9, 0.999), 1.5e-4)
    policy, latent, layer = model.policy, model.policy.latent_model, model.policy.group_layer
    coefs = (model.aet_coef, model.symmetry_coef, model.reward_coef)
    if name == "paper":
        assert coefs == (5, 1, 5) and model.learning_starts == 2_000  # the paper has sums over five steps
        assert latent.projection is policy.online.head.first and policy.latent_encoder is None
        n_features, sigma_init = 72, 0.5
    else:
        assert coefs == (1, 1, 5) and model.aux_gradient_share == 1.0 and model.learning_starts is None
        assert (policy.layer_norm, policy.head_input) == (True, "trunk")
        assert (policy.options.projection, policy.options.latent_tau) == ("own", 1.0)
        assert isinstance(policy.online.features_extractor, NormalizedExtractor)
        assert latent.projection.weight.shape == (256, 72) and latent.predictor.weight.shape == (256, 256)
        assert model.buffer_size == 100_000
        if kind is EqRRainbow:
            assert (policy.v_min, policy.v_max, policy.spread_init) == (-10, 10, 0.05)
        n_features, sigma_init = 3136, 0.1
    head = policy.online.head
    assert (head.n_atoms, policy.net_arch, policy.sigma_init) == (51, [256], sigma_init) and head.value is not None
    # σ₀ divided by the square root of the number of inputs
    assert head.first[0].weight_sigma[0, 0].item() == pytest.approx(sigma_init / n_features**0.5)
    assert (str(layer.group), layer.n_blocks, latent.state_dim) == ("SE(2)", 12, 72)
    assert policy.online.features_extractor.features_dim == n_features and latent.transition[0].out_features == 256
    assert sum(p.numel() for p in layer.to_algebra.parameters()) == (3136 + 1) * 36
    convolutions = [part for part in policy.online.features_extractor.trunk.trunk if hasattr(part, "stride")]
    assert [part.kernel_size[0] for part in convolutions] == [8, 4, 3]


def nonzero_gradients(module):
    return any(p.grad is not None and bool(p.grad.any()) for p in module.parameters())


@pytest.mark.parametrize("name", EXPECTED)
def test_each_configuration_trains_as_in_the_table(name):
    arguments = load_configuration(name)
    encoder_name, losses = EXPECTED[name]
    network = {"latent_hidden_dim": 16, **arguments.pop("policy_kwargs", {})}
    network["net_arch"] = [32]
    if name == "eqr_bbf":
        network["features_extractor_kwargs"]["width_scale"] = 0.25
    if "resets" in arguments:
        arguments["resets"].update(interval=8, annealing_steps=4)
    kept = {key: value for key, value in arguments.items() if key not in SMALL}
    env = VecFrameStack(make_vec_env(lambda: ImageEnv((36, 36, 1))), 4)
    model = EqRRainbow("CnnPolicy", env, **kept, **SMALL, policy_kwargs=network)
    model.set_logger(configure(None, []))
    recorded = {}
    model.logger.dump = lambda step=0: recorded.update(model.logger.name_to_value)
    before = {key: p.clone() for key, p in model.policy.online.named_parameters()}
    model.learn(150, log_interval=1)

    # arguments arrived
    for key, value in kept.items():
        found = model.train_freq.frequency if key == "train_freq" else getattr(model, key)
        assert found == (ResetSchedule.of(value) if key == "resets" else value)
    assert abs(model._n_updates - 10 * model.gradient_steps / model.train_freq.frequency) < 1
    assert isinstance(model.replay_buffer, PrioritizedSequenceReplayBuffer) == (name != "drq")
    encoder, layer = model.policy.online.features_extractor, model.policy.group_layer
    assert (layer and f"{layer.group}^{layer.n_blocks}") == encoder_name
    noisy = any(isinstance(module, NoisyLinear) for module in model.policy.modules())
    assert noisy == (name not in ("drq", "eqr_bbf", "eqr_rainbow"))
    assert model.policy.latent_model.action_dim == 3

    # losses: exactly those of the table are logged, and they are finite
    logged = {key[len("train/") : -len("_loss")] for key in recorded if key.endswith("_loss")}
    assert logged == losses | {"td"}
    assert all(th.isfinite(th.tensor(value)) for key, value in recorded.items() if key.startswith("train/"))

    # gradients: each network is trained by its losses
    latent = model.policy.latent_model
    assert nonzero_gradients(encoder) and nonzero_gradients(model.policy.online.head)
    assert nonzero_gradients(latent.transition) == bool(losses)
    assert nonzero_gradients(latent.reward_net) == ("reward" in losses)
    of_symmetry = [latent.action_symmetry, latent.symmetry_projection] if latent.has_symmetry_loss else []
    assert all(nonzero_gradients(part) == ("symmetry" in losses) for part in of_symmetry)
    assert all(p.grad is None for p in [*model.policy.target.parameters(), *model.policy.latent_target.parameters()])
    assert all(not th.equal(before[key], p) for key, p in model.policy.online.named_parameters())
    assert all_finite(model)


def test_eqr_bbf_follows_the_papers_recipe():
    """The numbers of the paper, checked one by one on the agent at full width."""
    env = VecFrameStack(make_vec_env(lambda: ImageEnv((84, 84, 1))), 4)
    model = EqRRainbow("CnnPolicy", env, **load_configuration("eqr_bbf"), device="cpu")
    trunk = model.policy.online.features_extractor
    assert isinstance(trunk.trunk, ImpalaTrunk) and trunk.rescale and trunk.features_dim == 11 * 11 * 32 * 4
    head = model.policy.online.head
    assert head.value is not None and head.first[0].out_features == 2 * 2048 and head.n_atoms == 51
    assert (model.policy.v_min, model.policy.v_max) == (-10, 10)
    # 1 where the random steps end, 0 after 2,001 more
    model._setup_learn(100_000, None)
    rates = [model.exploration_schedule(1 - step / 100_000) for step in (2_000, 3_000, 4_001, 50_000)]
    assert rates == pytest.approx([1, 1001 / 2001, 0, 0], abs=1e-4) and model.learning_starts == 2_000
    assert all(model.exploration_schedule(1 - step / 100_000) >= 1 for step in range(2_000))
    optimizer = model.policy.optimizer
    assert isinstance(optimizer, th.optim.AdamW) and optimizer.defaults["eps"] == 1.5e-4 and model.learning_rate == 1e-4
    decays = {p.ndim: group["weight_decay"] for group in optimizer.param_groups for p in group["params"]}
    assert decays == {4: 0.1, 2: 0.1, 1: 0.0}
    assert (model.tau, model.target_update_interval, model.max_grad_norm) == (0.005, None, None)
    buffer, resets = model.replay_buffer, model.resets
    assert (buffer.alpha, buffer.beta, buffer.final_beta) == (0.5, 0.5, 0.5)
    assert (resets.initial_n_steps, model.n_steps, resets.initial_gamma, model.gamma) == (10, 3, 0.97, 0.997)
    assert (resets.annealing_steps, resets.interval, resets.shrink_factor) == (10_000, 40_000, 0.5)
    assert (model.prediction_depth, model.aet_coef, model.symmetry_coef) == (5, 5, 5)
    assert (model.gradient_steps, model.train_freq.frequency, model.batch_size) == (2, 1, 32)
    assert model.policy.act_with_target and model.double_q


def test_atari_has_the_recipe_of_our_runs():
    """The plan of those runs has its own file, older than they are, which repeats three defaults."""
    protocol = load_suite("atari100k").protocol("Boxing")
    agents = find_agent("eqr_rainbow"), find_agent(f"eqr_rainbow:{ROOT}/experiments/settings/atari/slow_target_eqr.yml")
    recipe, planned = (hyperparameters(agent, protocol, spaces.Discrete(6)) for agent in agents)
    repeated = {"prediction_depth": 5, "symmetry_coef": 1.0, "policy_kwargs": {"group": "SE(2)"}}
    assert merged(repeated, recipe) == planned
    assert load_configuration("eqr_qrdqn") == load_configuration("eqr_rainbow")


@pytest.mark.parametrize("path", configuration_files().values(), ids=lambda path: path.stem)
def test_files_are_plain_ascii(path):
    """RL Zoo opens them with the default encoding of the machine."""
    assert path.read_bytes().isascii()


def test_changes_are_merged():
    plain = load_configuration("eqr_bbf")
    changed = load_configuration("eqr_bbf", learning_starts=5, policy_kwargs={"features_extractor_kwargs": {"width_scale": 1}})
    assert changed.pop("learning_starts") == 5
    assert changed["policy_kwargs"]["features_extractor_kwargs"] == {"width_scale": 1, "rescale": True}
    changed["policy_kwargs"]["features_extractor_kwargs"]["width_scale"] = 4
    assert changed == plain


def test_an_entry_with_normalised_observations_warns():
    with pytest.warns(UserWarning, match=r"'MountainCar-v0': its agent is trained with normalize: .*VecNormalize"):
        assert "normalize" not in load_configuration("eqr_rainbow", "MountainCar-v0")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_configuration("eqr_rainbow", "CartPole-v1")


def test_rl_zoos_schedules_are_schedules():
    """lin_1.5e-3 in the file decreases from 1.5e-3 to 0."""
    learning_rate = load_configuration("stock/qrdqn", "LunarLander-v3")["learning_rate"]
    assert [learning_rate(remaining) for remaining in (1, 0.5, 0)] == pytest.approx([1.5e-3, 0.75e-3, 0])
    with pytest.raises(ValueError, match=r"learning_rate must be .*\"lin_\" and a number, got the text '1e-4'.* write 1.0e-4"):
        with_schedule({"learning_rate": "1e-4"})  # YAML reads 1e-4 as text


def test_unknown_names_raise():
    with pytest.raises(ValueError, match=r"name must be one of .*'eqr_bbf'.*got 'bbf'"):
        load_configuration("bbf")
    with pytest.raises(ValueError, match=r"env_id must be one of .*'atari'.*got 'CartPole-v1'"):
        load_configuration("eqr_bbf", "CartPole-v1")
    with pytest.raises(ValueError, match=r"got .MyEnv-v0.\..* has a default section, by its observations\.$"):
        load_configuration("eqr_sac", "MyEnv-v0")
