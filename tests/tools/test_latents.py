"""Windows of play: the agent's observations with the true states, without side effects."""

import re

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DQN
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize, VecTransposeImage

from sb3_eqr import EqRQRDQN
from sb3_eqr.common.saving.plain_data import encode as encode_plain
from sb3_eqr.common.saving.random_state import get_rng_state
from sb3_eqr.envs import SlidingBall, make_atari100k_env
from sb3_eqr.visualize.callback import LatentCallback
from sb3_eqr.visualize.diagnostics import diagnose
from sb3_eqr.visualize.film import record
from sb3_eqr.visualize.latents import coordinate_names, coordinates, encode, frame, play
from sb3_eqr.visualize.pictures import latent_figure
from tests.tools.test_package import ROOT
from tests.toys import ChainEnv

BALL = {"group": "SO(2)", "n_blocks": 1, "parameterization": "gram-schmidt", "whiten": True}


@pytest.mark.parametrize("wrapped", [False, True])
def test_images_have_their_true_positions(wrapped):
    """With any wrapper, and across the ends of episodes."""
    env = make_vec_env("SlidingBall-v0", 2, env_kwargs={"max_episode_steps": 7})
    env = VecTransposeImage(env) if wrapped else env
    model = EqRQRDQN("CnnPolicy", env, buffer_size=100, policy_kwargs=BALL, device="cpu")
    found = play(model, make_vec_env("SlidingBall-v0", 2, env_kwargs={"max_episode_steps": 7}), n_steps=60, depth=3)
    assert found.factors.shape == (2 * 28, 1)
    for picture, position in zip(found.samples.observations.numpy(), found.factors, strict=True):
        assert np.array_equal(picture[0], SlidingBall().draw(position)[:, :, 0])
    assert found.samples.mask.min() == 0  # windows that end with their episode


def stepped(model, env, n_steps):
    """The observations of the first steps, (n_steps, ...), without ``play``."""
    env.seed(3)
    found = [env.reset()]
    for _ in range(n_steps - 1):
        found.append(env.step(model.predict(found[-1], deterministic=True)[0])[0])
    return found


def test_observations_are_normalised_once():
    env = VecNormalize(make_vec_env(ChainEnv, 1), norm_reward=False)
    model = EqRQRDQN("MlpPolicy", env, buffer_size=200, learning_starts=500, device="cpu", seed=0).learn(100)
    env.training = False
    found = play(model, env, n_steps=40, depth=2, deterministic=True, seed=3).samples.observations.numpy()
    np.testing.assert_allclose(found[:5], np.concatenate(stepped(model, env, 5)), rtol=1e-6)


def test_the_same_seed_plays_the_same_without_side_effects():
    model = EqRQRDQN("MlpPolicy", ChainEnv(), buffer_size=200, device="cpu", seed=0)
    env = make_vec_env(ChainEnv, 1, seed=0)
    model.exploration_rate = 0.5  # random actions use the generator of the action space
    before = encode_plain(get_rng_state(model.action_space))
    one, two = (play(model, env, n_steps=60, depth=2, seed=1).samples for _ in range(2))
    assert th.equal(one.actions, two.actions) and th.equal(one.observations, two.observations)
    assert encode_plain(get_rng_state(model.action_space)) == before


def test_atari_can_be_rendered_in_colour():
    env = make_atari100k_env("Pong", seed=0, render_mode="rgb_array")
    env.reset()
    assert env.render().shape == (210, 160, 3)


@pytest.mark.parametrize("n_blocks", [2, 8])
def test_elements_that_are_not_matrices_are_vectors(n_blocks):
    """The group of docs/groups.md; also with as many blocks as numbers in each block."""
    page = (ROOT / "docs" / "groups.md").read_text(encoding="utf-8")
    exec(re.search(r"^from sb3_eqr.common.groups import Group\n.*?(?=^model = )", page, re.M | re.S)[0], names := {"th": th})
    group = names["Scalings"](2)
    found = th.rand(5, n_blocks, 2, generator=th.Generator().manual_seed(0))
    assert coordinate_names(group) == ["x 0", "x 1"] and th.equal(coordinates(group, found), found - 1)
    matrix, vector = frame(group, found)
    assert matrix is None and th.equal(vector, found)
    model = EqRQRDQN("MlpPolicy", ChainEnv(), policy_kwargs={"group": group, "n_blocks": n_blocks}, device="cpu", seed=0)
    windows = play(model, make_vec_env(ChainEnv), 60, depth=2)
    diagnosed = diagnose(model, windows)
    assert diagnosed.generators[0].mean.shape == (3, n_blocks, 2) and len(diagnosed.blocks) == n_blocks
    states = encode(model, windows.samples.observations)
    offsets = latent_figure(model, states).axes[0].collections[0].get_offsets()
    np.testing.assert_allclose(offsets, states[:, :2].numpy())


def test_other_agents_raise(tmp_path):
    model = DQN("MlpPolicy", "CartPole-v1", device="cpu")
    windows = play(EqRQRDQN("MlpPolicy", "CartPole-v1", device="cpu"), "CartPole-v1", 40, depth=2)  # an id suffices
    message = "needs an EqR agent with a latent model, got DQN, which has none"
    for look in (
        lambda: play(model, "CartPole-v1"),
        lambda: diagnose(model, windows),
        lambda: encode(model, windows.samples.observations),
        lambda: record(model, "CartPole-v1", tmp_path / "v"),
        lambda: model.learn(1, callback=LatentCallback()),
    ):
        with pytest.raises(ValueError, match=message):
            look()


@pytest.mark.parametrize("position", ["north", None, [1.0], [[1.0, 2.0]]])
def test_only_numbers_of_a_constant_shape_are_true_factors(position):
    class Reporting(ChainEnv):
        def reset(self, **kwargs):
            return super().reset(**kwargs)[0], {"position": position}

        def step(self, action):
            return *super().step(action)[:4], {"position": position if position in ("north", None) else [1.0]}

    env = make_vec_env(Reporting, 1)
    model = EqRQRDQN("MlpPolicy", env, buffer_size=200, device="cpu", seed=0)
    found = play(model, env, n_steps=40, depth=2).factors
    assert (found is None) == (position != [1.0])
