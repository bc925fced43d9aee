"""Representation learning alone, without Q-learning and reward, on random actions; and its options."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

from sb3_eqr.common.groups import make_group
from sb3_eqr.common.latent.latent_model import LatentModel
from sb3_eqr.common.latent.options import LatentOptions
from sb3_eqr.representation import train_representation
from sb3_eqr.visualize.latents import coordinates, encode, split
from tests.models import same, tensors
from tests.toys import ChainEnv

STEPS = 12  # around the ring


class Ring(gym.Env):
    """A point on a ring, seen as a fixed random mixture of harmonics, so no coordinate is the sine or cosine of its angle."""

    def __init__(self):
        self.observation_space = spaces.Box(-np.inf, np.inf, (12,), np.float32)
        self.action_space = spaces.Discrete(2)
        mixing = np.random.default_rng(0).normal(size=(6, 12))
        self.mixing = mixing / np.linalg.norm(mixing, axis=1, keepdims=True)
        self.angle, self.time = 0.0, 0

    def see(self, angle):
        harmonics = np.concatenate([[np.cos(k * angle), np.sin(k * angle)] for k in (1, 2, 3)])
        return (5 + harmonics @ self.mixing).astype(np.float32)  # a constant much larger than the variation

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.angle, self.time = self.np_random.uniform(0, 2 * np.pi), 0
        return self.see(self.angle), {}

    def step(self, action):
        self.angle += 2 * np.pi / STEPS * (1 if action == 0 else -1)
        self.time += 1
        return self.see(self.angle), 1.0, False, self.time == 20, {}


def train(seed, total_timesteps=1_200, **kwargs):
    env = make_vec_env(Ring, 8, seed)
    kwargs = {"learning_starts": 200, "still_timesteps": 200, "batch_size": 32, "prediction_depth": 3, **kwargs}
    kwargs |= {"policy": "MlpPolicy", "device": "cpu"}
    return train_representation(env, "SO(2)", total_timesteps=total_timesteps, seed=seed, **kwargs)


def angles(model):
    places = np.arange(60) / 60 * 2 * np.pi
    blocks = split(model, encode(model, th.as_tensor(np.stack([Ring().see(place) for place in places]))))[0]
    return coordinates(blocks.group, blocks.elements)[:, 0, 0].numpy(), places


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_the_ring_is_found(seed):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        model = train(seed)
    found, places = angles(model)
    steps = np.angle(np.exp(1j * np.diff(found, append=found[0])))
    turns = steps.sum() / (2 * np.pi)
    assert abs(round(turns)) == 1  # one full turn, in one of the two directions
    rest = np.angle(np.exp(1j * (found - turns * places)))
    rest = np.angle(np.exp(1j * (rest - np.angle(np.exp(1j * rest).mean()))))
    assert 1 - rest.var() / (np.pi**2 / 3) > 0.99
    with th.no_grad():
        table = model.policy.latent_model.transition(th.eye(2))[:, 0] / (2 * np.pi / STEPS)  # the actions' angles in steps
    assert abs(table[0] + table[1]) < 0.02 and abs(abs(table[0]) - 1) < 0.05


@pytest.mark.slow
def test_the_papers_example_collapses_with_a_warning():
    with pytest.warns(UserWarning, match="states and actions are nearly constant.*collapsed"):
        train(0, 1500, parameterization="euler", whiten=False, aet_loss="distance", still_timesteps=0, learning_rate=1e-2)


def test_the_same_seed_gives_the_same_representation():
    one, two = (train(3, 320, still_timesteps=60) for _ in range(2))
    assert same(one, two)


def test_without_q_learning_the_head_is_neither_trained_nor_logged(make):
    model = make(ChainEnv(), td_coef=0.0, policy_kwargs={"projection": "own"})
    online = model.policy.online
    head, encoder = tensors(online.head), [p.clone() for p in online.features_extractor.parameters()]
    model.learn(46, log_interval=None)
    assert same(head, online.head)
    assert not any(map(th.equal, online.features_extractor.parameters(), encoder))
    logged = model.logger.name_to_value
    assert "train/aet_loss" in logged and "train/td_loss" not in logged and "train/mean_q_value" not in logged
    assert model.replay_buffer._max_priority == 1.0  # without TD errors the priorities do not change


def test_actions_that_do_not_depend_on_the_state():
    options = LatentOptions(state_dependent_actions=False)
    model = LatentModel(th.nn.Identity(), make_group("SE(2)", "gram-schmidt"), 3, 4, options)
    states, actions = th.randn(5, 18), th.eye(4)[[0, 1, 2, 3, 0]]
    elements = model.action_element(states, actions)
    assert th.equal(elements[0], elements[4]) and not th.equal(elements[0], elements[1])
    assert th.equal(elements, model.action_element(th.randn(5, 18), actions))


def test_too_few_steps_raise():
    with pytest.raises(ValueError, match=r"total_timesteps must be > .* = 3500, got 3000"):
        train_representation(Ring(), "SO(2)", policy="MlpPolicy", total_timesteps=3_000)


@pytest.mark.parametrize("group", ["GL(2)", "SE(2)", "GL(2) x SO(2)"])
def test_actions_are_the_identity_until_still_timesteps(group):
    found = []

    def look(local, _):
        latent_model = local["self"].policy.latent_model
        elements = latent_model.action_element(th.zeros(2, latent_model.group.identity(1).numel()), th.eye(2))
        is_identity = th.equal(elements, latent_model.group.identity(2, 1))
        found.append((local["self"].num_timesteps, is_identity))
        return True

    env = make_vec_env(Ring, 8, 0)
    settings = {"policy": "MlpPolicy", "learning_starts": 80, "still_timesteps": 80, "total_timesteps": 240, "device": "cpu"}
    model = train_representation(env, group, callback=look, seed=0, **settings)
    assert [steps for steps, still in found if still] == list(range(8, 169, 8)) and not found[-1][1]
    assert all(parameter.requires_grad for parameter in model.policy.latent_model.transition.parameters())
