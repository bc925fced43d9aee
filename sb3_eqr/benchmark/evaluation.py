"""
The evaluation protocol: full episodes in a batch of environments, a fixed number per environment, raw scores. For the keys
of a ``protocol`` see :meth:`~sb3_eqr.benchmark.suites.Suite.protocol`.
"""

import copy
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import NormalizeReward, TimeLimit
from rl_zoo3.utils import get_wrapper_class
from stable_baselines3.common.atari_wrappers import EpisodicLifeEnv, WarpFrame
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import is_wrapped, make_vec_env, unwrap_wrapper
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize

from sb3_eqr.common.saving.random_state import preserved_rng_state

FIRST_SEED, SEEDS = 1_000_000, 1_000  # evaluation shares no episodes with training, nor with another run's evaluation


def epsilon_greedy(model: BaseAlgorithm, epsilon: float, action_space: spaces.Space, seed: int) -> Any:
    """A policy for SB3's ``evaluate_policy``: the agent's deterministic action or, with probability ``epsilon``, any."""
    action_space, rng = copy.deepcopy(action_space), np.random.default_rng(seed)
    action_space.seed(seed)

    def predict(observation: Any, state: Any, episode_start: np.ndarray, deterministic: bool) -> tuple[np.ndarray, Any]:
        actions, state = model.predict(observation, state, episode_start, deterministic=True)
        for index in np.flatnonzero(rng.random(len(actions)) < epsilon):
            actions[index] = action_space.sample()
        return actions, state

    return SimpleNamespace(predict=predict)


def preprocessing_of(protocol: dict[str, Any]) -> dict[str, Any]:
    """:return: the preprocessing for evaluation"""
    return {**protocol["preprocessing"], **protocol["evaluation"]["preprocessing"]}


def make_game(protocol: dict[str, Any]) -> gym.Env:
    """:return: one environment for evaluation"""
    settings = preprocessing_of(protocol)
    env = gym.make(protocol["env_id"], **(settings.get("env_kwargs") or {}))
    wrap = get_wrapper_class(settings)
    env = env if wrap is None else wrap(env)
    max_steps = protocol["evaluation"]["max_steps"]
    return env if max_steps is None else TimeLimit(env, max_steps)


def check_game(protocol: dict[str, Any]) -> spaces.Space:
    """
    :return: the action space
    :raises ValueError: if evaluation would not see full episodes and raw scores
    """
    try:
        env = make_game(protocol)
    except (TypeError, AttributeError) as error:
        raise ValueError(f"{protocol['env_id']}: {error}") from error
    changing = (gym.RewardWrapper, NormalizeReward, EpisodicLifeEnv)  # SB3's ClipRewardEnv is a RewardWrapper
    found = [type(layer).__name__ for kind in changing if (layer := unwrap_wrapper(env, kind))]
    if "AtariEnv" in str(gym.spec(protocol["env_id"]).entry_point) and not is_wrapped(env, WarpFrame):
        found.append("no preprocessing")
    env.close()
    if found:
        raise ValueError(
            f"{protocol['env_id']}: evaluation must be on full episodes with raw scores, got {', '.join(found)}. "
            "Set preprocessing under evaluation in the suite, as atari100k in sb3_eqr/benchmark/suites.yml does."
        )
    return env.action_space


def make_evaluation_env(protocol: dict[str, Any], model: BaseAlgorithm, seed: int) -> VecEnv:
    """
    :param model: the agent; if it was trained with normalised observations, its statistics are used
    :param seed: of the first environment; the others' seeds count up from it
    """
    # Monitor is outside the wrappers, so that it sees the protocol's episodes.
    env = make_vec_env(make_game, n_envs=protocol["evaluation"]["n_envs"], seed=seed, env_kwargs={"protocol": protocol})
    settings = preprocessing_of(protocol)
    wrap: Any = get_wrapper_class(settings, "vec_env_wrapper")
    env = env if wrap is None else wrap(env)
    old = model.get_vec_normalize_env()
    if old is not None and old.norm_obs:
        ranges: dict[str, Any] = {"clip_obs": old.clip_obs, "epsilon": old.epsilon, "norm_obs_keys": old.norm_obs_keys}
        env = VecNormalize(env, training=False, norm_reward=False, **ranges)
        env.obs_rms = copy.deepcopy(old.obs_rms)
    n_stack = settings.get("frame_stack")
    return VecFrameStack(env, n_stack) if n_stack else env


def evaluate(model: BaseAlgorithm, protocol: dict[str, Any], n_episodes: int, seed: int) -> tuple[list[float], list[int]]:
    """
    Scores and lengths of full episodes. Every environment plays a fixed share of them, so that short episodes are not
    overrepresented. Neither the agent nor the random generators change.

    :param seed: of the run
    """
    seed = FIRST_SEED + SEEDS * seed
    with preserved_rng_state(model.action_space):
        env = make_evaluation_env(protocol, model, seed)
        try:
            player = epsilon_greedy(model, protocol["evaluation"]["epsilon"], env.action_space, seed)
            scores, lengths = evaluate_policy(player, env, n_episodes, return_episode_rewards=True, warn=False)
        finally:
            env.close()
    return np.asarray(scores, dtype=float).tolist(), np.asarray(lengths, dtype=int).tolist()
