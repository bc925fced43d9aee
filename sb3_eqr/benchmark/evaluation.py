"""The evaluation protocol: whole episodes of a batch of environments, a fixed number of each, raw scores."""

import copy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from rl_zoo3.utils import get_wrapper_class
from stable_baselines3.common.atari_wrappers import ClipRewardEnv, EpisodicLifeEnv, WarpFrame
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import is_wrapped, make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize

from sb3_eqr.common.safe_files import get_rng_state, set_rng_state

FIRST_SEED, SEEDS = 1_000_000, 1_000  # evaluation plays other games than training, and than that of another seed


class EpsilonGreedy:
    """
    What SB3's ``evaluate_policy`` asks for its actions: the agent without its noise, and now and then a random action.

    :param model: the agent
    :param epsilon: probability of a random action
    :param action_space: random actions are drawn from it
    :param seed: of these draws
    """

    def __init__(self, model: BaseAlgorithm, epsilon: float, action_space: spaces.Space, seed: int):
        self._model = model
        self._epsilon = epsilon
        self._action_space = copy.deepcopy(action_space)
        self._action_space.seed(seed)
        self._rng = np.random.default_rng(seed)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        :param observation: (n_envs, *obs_shape)
        :param state: of a recurrent agent
        :param episode_start: (n_envs,)
        :param deterministic: has no effect
        :return: actions, (n_envs, ...), and state
        """
        actions, state = self._model.predict(observation, state, episode_start, deterministic=True)
        for index in np.flatnonzero(self._rng.random(len(actions)) < self._epsilon):
            actions[index] = self._action_space.sample()
        return actions, state


def preprocessing_of(protocol: dict[str, Any]) -> dict[str, Any]:
    """
    :param protocol: of :meth:`~sb3_eqr.benchmark.suites.Suite.protocol`
    :return: that of evaluation
    """
    return {**protocol["preprocessing"], **protocol["evaluation"]["preprocessing"]}


def make_game(protocol: dict[str, Any]) -> gym.Env:
    """
    :param protocol: of :meth:`~sb3_eqr.benchmark.suites.Suite.protocol`
    :return: one environment for evaluation
    """
    settings = preprocessing_of(protocol)
    env = gym.make(protocol["env_id"], **(settings.get("env_kwargs") or {}))
    wrap = get_wrapper_class(settings)
    env = env if wrap is None else wrap(env)
    max_steps = protocol["evaluation"]["max_steps"]
    return env if max_steps is None else TimeLimit(env, max_steps)


def check_game(protocol: dict[str, Any]) -> spaces.Space:
    """
    :param protocol: of :meth:`~sb3_eqr.benchmark.suites.Suite.protocol`
    :return: the action space
    :raises ValueError: if evaluation would not see whole games and raw scores
    """
    env = make_game(protocol)
    found = [kind.__name__ for kind in (ClipRewardEnv, EpisodicLifeEnv) if is_wrapped(env, kind)]
    if "AtariEnv" in str(gym.spec(protocol["env_id"]).entry_point) and not is_wrapped(env, WarpFrame):
        found.append("no preprocessing")
    env.close()
    if found:
        raise ValueError(
            f"{protocol['env_id']}: expected evaluation on whole games with raw scores, found {', '.join(found)}. "
            "Set preprocessing under evaluation in the suite, as atari100k in sb3_eqr/benchmark/suites.yml does."
        )
    return env.action_space


def make_evaluation_env(protocol: dict[str, Any], model: BaseAlgorithm, seed: int) -> VecEnv:
    """
    :param protocol: of :meth:`~sb3_eqr.benchmark.suites.Suite.protocol`
    :param model: whose statistics normalise the observations, where it was trained so
    :param seed: of the first environment; the others count up
    """
    # Monitor outside the wrappers: an episode is what the protocol says it is.
    env = make_vec_env(make_game, n_envs=protocol["evaluation"]["n_envs"], seed=seed, env_kwargs={"protocol": protocol})
    trained = model.get_vec_normalize_env()
    if trained is not None:
        env = VecNormalize(
            env,
            training=False,
            norm_obs=trained.norm_obs,
            norm_reward=False,
            clip_obs=trained.clip_obs,
            epsilon=trained.epsilon,
        )
        env.obs_rms = copy.deepcopy(trained.obs_rms)
    n_stack = preprocessing_of(protocol).get("frame_stack")
    return VecFrameStack(env, n_stack) if n_stack else env


def evaluate(model: BaseAlgorithm, protocol: dict[str, Any], n_episodes: int, seed: int) -> tuple[list[float], list[int]]:
    """
    Scores and lengths of whole episodes. Every environment plays its share of them and no more, so that short episodes are
    not counted too often. Nothing of the agent changes, nor of the random generators.

    :param model: the agent
    :param protocol: see :func:`make_evaluation_env`
    :param n_episodes: number of episodes
    :param seed: of the run
    """
    before = get_rng_state(model.action_space)
    env = make_evaluation_env(protocol, model, FIRST_SEED + SEEDS * seed)
    try:
        player = EpsilonGreedy(model, protocol["evaluation"]["epsilon"], env.action_space, FIRST_SEED + SEEDS * seed)
        scores, lengths = evaluate_policy(player, env, n_episodes, return_episode_rewards=True, warn=False)  # type: ignore[arg-type]
    finally:
        env.close()
        set_rng_state(before, model.action_space)
    assert isinstance(scores, list) and isinstance(lengths, list)
    return [float(score) for score in scores], [int(length) for length in lengths]
