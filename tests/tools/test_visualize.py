"""The diagnosis of an agent's latent model, and the command line that writes it to files."""

import functools
import pickle
import re
import sys
from collections import OrderedDict

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch as th
import yaml
from gymnasium import spaces
from matplotlib.colors import to_rgba
from PIL import Image
from sb3_contrib import QRDQN
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecCheckNan, VecFrameStack, VecNormalize, unwrap_vec_normalize

from sb3_eqr import EqRQRDQN, EqRRainbow, MatrixLieGroup, visualize
from sb3_eqr.common.saving.plain_data import encode as encode_plain
from sb3_eqr.common.saving.random_state import get_rng_state
from sb3_eqr.trust import check_zoo_folder
from sb3_eqr.visualize import loading
from sb3_eqr.visualize.diagnostics import diagnose
from sb3_eqr.visualize.latents import encode, play
from sb3_eqr.visualize.pictures import all_pictures, generators_figure, latent_figure
from sb3_eqr.visualize.tables import all_tables
from tests.models import PAPER_FLAT
from tests.toys import FORK

STEP = 0.4
FILES = ("transition", "motion", "generators", "disentanglement", "action_symmetry", "collapse", "rewards", "summary")
PICTURES = ("transition", "motion", "generators", "disentanglement", "collapse", "rewards", "latents")


class Ring(gym.Env):
    """
    A point on a circle that moves by ±0.4 radians. The observation is (cos, sin, 1), or with ``unwound`` (angle, 0), where the
    angle may exceed π; with ``keys`` it is in a dictionary.
    """

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, unwound=False, keys=False, render_mode=None):
        box = spaces.Box(-np.inf, np.inf, (2 if unwound else 3,), np.float32)
        self.observation_space = spaces.Dict({"seen": box}) if keys else box
        self.action_space = spaces.Discrete(2)
        self.unwound, self.keys, self.render_mode = unwound, keys, render_mode

    def get_action_meanings(self):
        return ["BACK", "ON"]

    def tell(self):
        a = self.angle
        seen = np.array([a, 0] if self.unwound else [np.cos(a), np.sin(a), 1], dtype=np.float32)
        return {"seen": seen} if self.keys else seen, {"angle": (a + np.pi) % (2 * np.pi) - np.pi}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.angle, self.time = self.np_random.uniform(-np.pi, np.pi), 0
        return self.tell()

    def step(self, action):
        self.angle += STEP * (2 * int(action) - 1)
        self.time += 1
        obs, info = self.tell()
        return obs, float(np.cos(self.angle)), False, self.time >= 40, info


gym.register("Ring-v0", entry_point=Ring)
gym.register("Dark-v0", entry_point=lambda unwound=False: Ring(unwound))


def make_model(algorithm=EqRQRDQN, policy="MlpPolicy", env=None, group="SO(2)", n_blocks=2, network=None, **kwargs):
    heads = {EqRQRDQN: "n_quantiles", EqRRainbow: "n_atoms"}
    sizes = {"net_arch": [32], "latent_hidden_dim": 32, heads[algorithm]: 9, **(network or {})}
    settings = {"buffer_size": 2000, "learning_starts": 100, "learning_rate": 2e-3, "n_steps": 3, "prediction_depth": 3}
    settings |= {"train_freq": 4, "gradient_steps": 4, "tau": 0.05, "device": "cpu", "seed": 0, **kwargs}
    return algorithm(policy, env or Ring(), **settings, policy_kwargs={"group": group, "n_blocks": n_blocks, **sizes})


def look(model, n_steps=300, **kwargs):
    return diagnose(model, play(model, make_vec_env(functools.partial(Ring, **kwargs)), n_steps, depth=3))


@pytest.fixture(scope="module")
def trained():
    """With the latent model's losses only, a large learning rate and a fast target, the model predicts after 80 updates."""
    return make_model(td_coef=0, aet_coef=3.0, reward_coef=3.0, learning_rate=1e-2, learning_starts=40, tau=0.2).learn(120)


def collapse(model):
    """Make all states equal and κ the identity."""
    with th.no_grad():
        model.policy.group_layer.to_algebra.weight.zero_()
        for parameter in model.policy.latent_model.transition[-1].parameters():
            parameter.zero_()
    return model


def test_three_agents_three_verdicts(trained):
    found = [look(model, n_steps=120) for model in (trained, make_model(), collapse(make_model()))]
    assert [diagnostics.verdict for diagnostics in found] == ["predicts", "does not predict", "collapsed"]
    assert found[2].collapse.effective_rank == 0 and found[2].collapse.spread < 1e-6
    assert np.isnan(found[2].loss.skill).all() and found[2].summary.startswith("The latent states have collapsed")


def by_hand(**network):
    """x = R(angle), κ(x, a) = R(±0.4), ρ = 1, r = 0, which is exact for unwound angles."""
    model = make_model(env=Ring(unwound=True), n_blocks=1, network={**PAPER_FLAT, **network})
    latent = model.policy.latent_model
    with th.no_grad():
        to_algebra = model.policy.group_layer.to_algebra
        to_algebra.weight.copy_(th.tensor([[1.0, 0.0]]))
        to_algebra.bias.zero_()
        for net in (latent.transition, latent.action_symmetry, latent.reward_net):
            for parameter in (*net[0].parameters(), *net[-1].parameters()):
                parameter.zero_()
        latent.transition[0].weight[:2, -2:] = th.eye(2)
        latent.transition[-1].weight[0, :2] = STEP * th.tensor([-1.0, 1.0]) * (1 + latent.transition[1].eps) ** 0.5
    return model


def test_an_exact_model_has_exact_metrics():
    found = look(by_hand(), n_steps=600, unwound=True)
    chord = 2 * np.sqrt(2) * np.sin(STEP / 2)  # ‖R(0.4) x − x‖, four entries
    assert found.verdict == "predicts" and found.blocks == ["SO(2) 0"]
    assert (found.transition.error < 1e-9).all() and (found.transition.skill > 1 - 1e-6).all()
    assert found.transition.still[0] == pytest.approx(chord**2, rel=1e-4)
    assert np.allclose(found.motion.predicted, chord, rtol=1e-4) and np.allclose(found.motion.observed, chord, rtol=1e-4)
    (generators,) = found.generators
    assert generators.names == ["angle 0-1"] and np.allclose(generators.mean[:, 0, 0], [-STEP, STEP], rtol=1e-4)
    assert (generators.std < 2e-3).all()
    assert found.disentanglement.opposites == [1, 0] and np.isnan(found.disentanglement.specificity).all()
    assert found.disentanglement.information[0, 0] > 0.8 and found.disentanglement.redundancy.tolist() == [[1]]
    symmetry = found.action_symmetry  # rotations of the plane commute, so ρ = 1 is correct
    assert symmetry.distance == symmetry.identity < 1e-9 and symmetry.from_identity == 0 and symmetry.shuffled > 0.1
    assert found.collapse.size == pytest.approx(np.sqrt(2)) and found.collapse.dimensions == 4
    assert found.collapse.effective_rank == pytest.approx(2, abs=0.1)  # a circle
    assert found.collapse.dead_units == found.collapse.dormant_units == 0.5  # the observation that is always 0
    assert np.allclose(found.rewards.explained, 0, atol=1e-6)


def test_only_predictions_pass_the_predictor():
    """A predictor of −1 turns the exact predictions around, ‖−u − u‖² = 4; true projections stay where they are."""
    model = by_hand(projection="none")
    model.policy.latent_model.predictor = th.nn.Linear(4, 4, bias=False)
    model.policy.latent_model.predictor.weight.data.copy_(-th.eye(4))
    found = look(model, n_steps=100, unwound=True)
    assert np.allclose(found.loss.error, 4, rtol=1e-5) and (found.transition.error < 1e-9).all()
    assert np.allclose(found.loss.still, found.transition.still / 2, rtol=1e-4)  # ‖x‖ = √2


def test_predicted_rewards_have_the_unit_of_rewards():
    """r_ψ = 1 with rewards of mean 2 and spread 3 predicts 5."""
    model = by_hand()
    model.policy.latent_model.reward_net[-1].bias.data.fill_(1)
    model.reward_mean, model.reward_scale = 2.0, 3.0
    windows = play(model, make_vec_env(functools.partial(Ring, unwound=True)), 100)
    assert windows.samples.mask.shape[1] == 3  # the agent's depth
    rewards = windows.samples.rollout_rewards[windows.samples.mask[:, 0] > 0, 0]
    assert diagnose(model, windows).rewards.error[0] == pytest.approx(float((rewards - 5).square().mean()), rel=1e-5)


def test_constant_rewards_and_signs():
    model = make_model(network={"reward_loss": "categorical"})
    window = play(model, make_vec_env(Ring), 100, depth=2)
    found = diagnose(model, window).rewards
    signs = window.samples.rollout_rewards.sign().numpy()
    valid = window.samples.mask[:, 0].numpy() > 0
    assert found.constant[0] == pytest.approx(signs[valid, 0].var(), rel=1e-4)
    same = window._replace(samples=window.samples._replace(rollout_rewards=th.ones_like(window.samples.rollout_rewards)))
    assert np.isnan(diagnose(model, same).rewards.explained).all()


def test_the_same_seed_gives_the_same_numbers_without_side_effects(trained):
    windows = play(trained, make_vec_env(Ring), 60, depth=3)
    state = encode_plain(get_rng_state(trained.action_space))
    mode = [module.training for module in trained.policy.modules()]
    first, second = diagnose(trained, windows, seed=3), diagnose(trained, windows, seed=3)
    assert pickle.dumps(first) == pickle.dumps(second)
    assert encode_plain(get_rng_state(trained.action_space)) == state
    assert [module.training for module in trained.policy.modules()] == mode
    assert diagnose(trained, windows, seed=4).action_symmetry != first.action_symmetry


HEISENBERG = MatrixLieGroup([[[0, 1, 0], [0, 0, 0], [0, 0, 0]], [[0, 0, 0], [0, 0, 1], [0, 0, 0]]])
PRODUCT = "SE(2)^2 x SO(3) x T(2)"
GROUPS = ["GL(1)", "GL(2)", "SE(2)", "SE(3)", "SO(2)", "SO(3)", "T(1)", "T(2)", "T(3)", HEISENBERG, PRODUCT, "none(5)", None]
DRAWN = ["SE(2)", "SO(3)", HEISENBERG, PRODUCT, None]  # figures take most of the time


@pytest.mark.parametrize("group", GROUPS, ids=str)
def test_every_group(group):
    n_blocks = {None: 1, "none(5)": 1, PRODUCT: 4}.get(group, 2)
    counts_its_own = group in (None, "none(5)", PRODUCT)
    inverse = group not in (None, "none(5)")
    algorithm = EqRRainbow if counts_its_own else EqRQRDQN
    model = make_model(algorithm, group=group, n_blocks=None if counts_its_own else n_blocks, symmetry_coef=float(inverse))
    windows = play(model, make_vec_env(Ring), 60, depth=3)
    found = diagnose(model, windows)
    assert len(found.blocks) == n_blocks and found.motion.predicted.shape == (2, n_blocks)
    assert np.isfinite(found.motion.predicted).all() and np.isfinite(found.transition.error).all()
    assert sum(part.mean.shape[1] for part in found.generators) == n_blocks
    assert found.disentanglement.information.shape == (n_blocks, 1) and (found.action_symmetry is not None) == inverse
    of_groups = set() if inverse else {"motion", "generators", "action_symmetry"}
    assert set(all_tables(found, ["0", "1"])) == set(FILES) - of_groups
    figure = latent_figure(model, encode(model, windows.samples.observations), windows.factors[:, 0], "angle")
    assert len(figure.axes) == n_blocks + 1  # including the colour bar
    if group in DRAWN:
        assert {*all_pictures(found, ["0", "1"]), "latents"} == set(PICTURES) - of_groups
        unknown = found._replace(disentanglement=found.disentanglement._replace(information=None))
        for found_files in (all_pictures(unknown, ["0", "1"]), all_tables(unknown, ["0", "1"])):
            assert ("disentanglement" in found_files) == (n_blocks > 1)


def test_dict_observations_and_an_agent_without_latent_losses():
    model = make_model(EqRRainbow, "MultiInputPolicy", Ring(keys=True), prediction_depth=0)
    found = look(model, n_steps=60, keys=True)
    assert found.verdict == "not trained" and "prediction_depth is 0" in found.summary
    assert not found.rewards_trained and not found.symmetry_trained


@pytest.mark.parametrize("off", ["reward", "symmetry"])
def test_untrained_networks_are_reported_and_not_drawn(off):
    found = look(make_model(**{f"{off}_coef": 0}), n_steps=60)
    tables, figures = all_tables(found, ["0", "1"]), all_pictures(found, ["0", "1"])
    assert tables["rewards"]["trained"].tolist() == [off != "reward"] * 3
    assert tables["action_symmetry"]["trained"].tolist() == [off != "symmetry"]
    assert ("rewards" not in figures) == (off == "reward")


def test_plots_share_a_scale_and_have_margins():
    found = look(make_model(n_blocks=7), n_steps=60)
    figures = all_pictures(found, ["0", "1"])
    images = [ax.images[0] for ax in figures["motion"].axes[:2]]
    assert images[0].get_clim() == images[1].get_clim() == (0, max(values.max() for values in found.motion))
    assert not figures["motion"].axes[0].texts  # no numbers with as many as seven columns
    (ax,) = figures["collapse"].axes
    x, y = ax.lines[0].get_data()
    assert ax.get_xlim()[0] < x.min() and x.max() < ax.get_xlim()[1]
    assert ax.get_ylim()[0] < y.min() and y.max() < ax.get_ylim()[1]
    assert all(tick == round(tick) for tick in ax.get_xticks())


@pytest.mark.parametrize("period, colours", [(10.0, "twilight"), (None, "viridis")])
def test_periodic_factors_have_cyclic_colours(period, colours):
    model = make_model(group="SE(2)")
    states = th.randn(9, 12, generator=th.Generator().manual_seed(0))
    figure = latent_figure(model, states, np.arange(9.0), "angle", period)
    assert {drawn.get_cmap().name for ax in figure.axes[:2] for drawn in ax.collections} == {colours}
    assert {drawn.get_clim() for ax in figure.axes[:2] for drawn in ax.collections} == {(0, 8) if period is None else (-1, 9)}


def test_many_blocks_and_points_in_one_figure():
    model = make_model(group="T(2)", n_blocks=32)
    figure = latent_figure(model, th.randn(1000, 64, generator=th.Generator().manual_seed(0)))
    assert len(figure.axes) == 12 + 1 and "12 of 32" in figure._suptitle.get_text()
    assert len(latent_figure(model, th.zeros(3, 64)).axes) == 13  # all points are equal


def test_command_line(trained, sb3_eqr, tmp_path):
    pictures = [*PICTURES[:-1], "latents_angle"]  # coloured by the true state
    trained.save(tmp_path / "ring")
    shown = sb3_eqr(f"visualize {tmp_path}/ring.zip --env Ring-v0 --steps 200 --n-envs 2 --out {tmp_path}/out").out
    assert shown.startswith("The latent model predicts: over 3 steps") and str(tmp_path / "out") in shown
    assert {path.name for path in (tmp_path / "out").iterdir()} == {f"{n}.csv" for n in FILES} | {f"{n}.png" for n in pictures}
    tables = {name: pd.read_csv(tmp_path / "out" / f"{name}.csv") for name in FILES}
    assert tables["transition"]["steps_ahead"].tolist() == [1, 2, 3]
    assert tables["generators"]["action_name"].unique().tolist() == ["BACK", "ON"]
    information = tables["disentanglement"].query("measure == 'information'")
    assert information["with"].tolist() == ["angle", "angle"]
    assert tables["summary"].set_index("measure").at["verdict", "value"] == "predicts"
    for name in pictures:
        assert Image.open(tmp_path / "out" / f"{name}.png").size == (900, 600)


class Pickled(th.nn.ReLU):
    """Not plain data, so a file that names it needs trust."""


@pytest.mark.slow
def test_a_film_is_longer_than_its_predictions(trained, sb3_eqr, tmp_path, monkeypatch):
    lengths = []
    monkeypatch.setattr(visualize, "record", lambda model, env, path, n_steps, depth, **_: lengths.append((n_steps, depth)))
    trained.save(tmp_path / "ring")
    sb3_eqr(f"visualize {tmp_path}/ring.zip --env Ring-v0 --steps 240 --video --depth 110")
    assert lengths == [(220, 110)]


def test_actions_have_the_names_of_environments_in_other_processes():
    env = make_vec_env(Ring, vec_env_cls=SubprocVecEnv, vec_env_kwargs=FORK)
    try:
        assert loading.action_names(env, make_model(env=env)) == ["BACK", "ON"]
    finally:
        env.close()


def test_an_error_names_the_flag_of_the_command(sb3_eqr, tmp_path):
    make_model(network={"activation_fn": Pickled}).save(tmp_path / "ring")
    shown = sb3_eqr(f"visualize {tmp_path}/ring.zip --env Ring-v0", code=2).err
    assert "pass --trust, or pass custom_objects" in shown


@pytest.fixture
def folder(tmp_path):
    """The folder that RL Zoo writes beside a model."""
    folder = tmp_path / "Ring-v0_1" / "Ring-v0"
    folder.mkdir(parents=True)
    (folder / "args.yml").write_text(yaml.dump(OrderedDict(env="Ring-v0", env_kwargs=None, gym_packages=[])))
    (folder / "config.yml").write_text(yaml.dump(OrderedDict(policy="MlpPolicy", normalize=True)))
    return folder


def test_rl_zoos_files_next_to_the_model_are_used(folder, monkeypatch):
    monkeypatch.delitem(sys.modules, "rl_zoo3.import_envs", raising=False)
    env = VecNormalize(make_vec_env(functools.partial(Ring, keys=False)))
    model = make_model(env=env)
    model.save(folder.parent / "best_model")
    env.obs_rms.mean[:] = 7
    env.save(folder / "vecnormalize.pkl")
    path = folder.parent / "best_model.zip"
    loaded = loading.load_model(path, device="cpu")
    assert type(loaded) is EqRQRDQN
    found = loading.make_env(loaded, path)
    assert "rl_zoo3.import_envs" in sys.modules  # in a new process, nothing else registers Atari
    assert isinstance(found, VecNormalize) and found.obs_rms.mean[0] == 7 and not found.training and found.norm_reward
    seen = play(loaded, found, 60, depth=2).samples.observations.numpy()
    assert np.abs(seen[:, :2] + 7).max() < 1.001  # a cosine and a sine, normalised once
    assert found.get_attr("render_mode") == [None]
    loaded.trained_normalized = False
    (folder / "config.yml").write_text(yaml.dump(OrderedDict(policy="MlpPolicy", env_kwargs={"render_mode": "rgb_array"})))
    assert loading.make_env(loaded, path).get_attr("render_mode") == ["rgb_array"]  # of a file of entries, or after --resume
    (folder / "args.yml").write_text(yaml.dump(OrderedDict(env="Dark-v0", env_kwargs=None, gym_packages=[])))
    (folder / "config.yml").write_text(yaml.dump(OrderedDict(policy="MlpPolicy")))
    assert loading.make_env(loaded, path, render=True).render_mode is None  # its environment cannot be rendered
    other = loading.make_env(loaded, path, "Ring-v0", {"unwound": False}, n_envs=2)
    assert other.num_envs == 2 and other.render_mode is None
    assert loading.make_env(loaded, path, "Ring-v0", {"unwound": False}, render=True).render_mode == "rgb_array"


def test_wrappers_of_rl_zoos_files_are_applied_in_its_order(folder):
    model = make_model(env=VecFrameStack(make_vec_env(functools.partial(Ring, keys=False)), 2))
    path = folder.parent / "best_model.zip"
    model.save(path)
    wrappers = {
        "env_wrapper": "gymnasium.wrappers.FlattenObservation",
        "vec_env_wrapper": "stable_baselines3.common.vec_env.VecCheckNan",
    }
    (folder / "config.yml").write_text(yaml.dump(OrderedDict(policy="MlpPolicy", frame_stack=2, **wrappers)))
    stack = loading.make_env(model, path)
    assert isinstance(stack, VecFrameStack) and isinstance(stack.venv, VecCheckNan)
    assert stack.env_is_wrapped(gym.wrappers.FlattenObservation) == [True]


def test_statistics_of_a_normalised_run_must_be_there(folder):
    model = make_model()
    model.save(folder.parent / "best_model")
    with pytest.raises(ValueError, match=r"vecnormalize\.pkl must exist, because the agent was trained with normalize: true"):
        loading.make_env(model, folder.parent / "best_model.zip")


def test_statistics_of_an_agent_saved_from_python_must_be_there(tmp_path):
    env = VecNormalize(make_vec_env("CartPole-v1", seed=0))
    model = make_model(env=env).learn(2)
    model.save(tmp_path / "model")
    model = loading.load_model(tmp_path / "model.zip")
    model.save(tmp_path / "model")  # without an environment
    model = loading.load_model(tmp_path / "model.zip")
    with pytest.raises(ValueError, match=r"vecnormalize\.pkl must exist, because the agent was trained with VecNormalize"):
        loading.make_env(model, tmp_path / "model.zip", "CartPole-v1")
    env.save(tmp_path / "vecnormalize.pkl")
    assert unwrap_vec_normalize(loading.make_env(model, tmp_path / "model.zip", "CartPole-v1")) is not None


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("args.yml", "env: Ring-v0\ngym_packages: [antigravity]", "got antigravity"),
        ("args.yml", "env: antigravity:Ring-v0", "got antigravity"),
        ("config.yml", "vec_env_wrapper: stable_baselines3.common.vec_env.vec_monitor.ResultsWriter", r"got .*ResultsWriter"),
        ("config.yml", "env_wrapper: gymnasium.wrappers.nothing.Wrapper", r"got gymnasium\.wrappers\.nothing\.Wrapper"),
    ],
)
def test_files_next_to_the_model_are_checked_before_they_are_used(folder, name, content, message):
    model = make_model()
    model.save(folder.parent / "best_model")
    (folder / name).write_text(content)
    with pytest.raises(ValueError, match=message):
        loading.make_env(model, folder.parent / "best_model.zip")


def test_packages_that_the_user_names_are_trusted_and_no_others(tmp_path):
    (tmp_path / "args.yml").write_text("env: antigravity:Ring-v0\ngym_packages: [antigravity]")
    wrappers = "env_wrapper: [antigravity.Wrapper]\nvec_env_wrapper: "
    (tmp_path / "config.yml").write_text(f"{wrappers}antigravity_more.Wrapper")
    with pytest.raises(ValueError, match=r"given with --gym-packages, and .* got antigravity_more\.Wrapper\. If"):
        check_zoo_folder(tmp_path, ["antigravity"])
    check_zoo_folder(tmp_path, ["antigravity", "antigravity_more"])  # reads only
    assert "antigravity" not in sys.modules


def test_the_algorithm_is_read_from_the_file(tmp_path):
    make_model(EqRRainbow).save(tmp_path / "rainbow")
    assert loading.find_algorithm(tmp_path / "rainbow.zip") == "eqr_rainbow"
    QRDQN("MlpPolicy", Ring(), device="cpu").save(tmp_path / "stock")
    with pytest.raises(ValueError, match=r"must be a saved EqRQRDQN or .* EqRTQC, got .*sb3_contrib\.qrdqn\.policies"):
        loading.load_model(tmp_path / "stock.zip")


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A folder with a model and a truncated file."""
    folder = tmp_path_factory.mktemp("saved")
    make_model().save(folder / "model")
    (folder / "cut.zip").write_bytes(b"PK")
    return folder


@pytest.mark.parametrize(
    "line, message",
    [
        ("", "the following arguments are required: MODEL"),
        ("nothing.zip", "MODEL must be the path of a .zip file, such as .*, got 'nothing.zip'"),
        ("{cut}", "must be a complete file written by an agent's save, got a truncated"),
        ("{model}", r"--env must be the agent's environment, got none, and RL Zoo's args\.yml is not"),
        ("{model} --env Ring-v1", "'Ring-v1' is not registered with gymnasium. Did you mean 'Ring-v0'?"),
        ("{model} --env Nope-v0", "'Nope-v0' is not registered with gymnasium. Environments of another package need"),
        ("{model} --env Ring-v0 --gym-packages no_package", "'no_package' cannot be imported"),
        ("{model} --env CartPole-v1", "--env must have the agent's spaces. Observation spaces do not match"),
        ("{model} --env Ring-v0 --env-kwargs unwound", "--env-kwargs must be key:value, got 'unwound'"),
        ("{model} --env Ring-v0 --env-kwargs speed:2", r"--env-kwargs: Ring-v0 does not accept {'speed': 2}"),
        ("{model} --env Ring-v0 --steps 5", "visualize: --steps must be an integer >= 8, got 5"),
        ("{model} --env Ring-v0 --depth 0", "visualize: --depth must be an integer >= 1, got 0"),
        ("{model} --env Ring-v0 --n-envs 0", "--n-envs must be >= 1, got 0"),
        ("{model} --env ALE/Pong-v5 --env-kwargs mode:1", "--env-kwargs must be empty for Atari"),
        ("{model} --algo dqn", "invalid choice: 'dqn'"),
    ],
)
def test_wrong_use_prints_an_error(line, message, sb3_eqr, saved):
    shown = sb3_eqr("visualize " + line.format(model=saved / "model.zip", cut=saved / "cut.zip"), code=2).err
    assert re.search(message, shown.replace("\n", " ")), shown


def test_kwargs_are_python_or_text():
    found = loading.parse_kwargs(["a:1", "b:[2, 3]", "c:None", "d:text", "e:a:b"])
    assert found == {"a": 1, "b": [2, 3], "c": None, "d": "text", "e": "a:b"}


def test_unknown_names():
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        visualize.nothing  # noqa: B018


def test_a_coordinate_has_one_colour_in_all_panels_of_a_product():
    model = make_model(group="SE(2) x T(2)", n_blocks=1, symmetry_coef=0.0)
    figure = generators_figure(look(model, 60), ["BACK", "ON"])
    (legend,) = figure.legends
    drawn = zip(legend.texts, legend.legend_handles, strict=True)
    colours = {text.get_text(): tuple(handle.get_color()[0]) for text, handle in drawn}
    names = [["angle 0-1", "t 0", "t 1"], ["t 0", "t 1"]]
    for ax, expected in zip(figure.axes, names, strict=True):
        assert [to_rgba(bars.lines[0].get_color()) for bars in ax.containers] == [colours[name] for name in expected]
