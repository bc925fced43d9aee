"""
The evaluation protocol: full episodes in a batch of environments, a fixed number per environment, raw scores. For the keys
of a ``protocol`` see :meth:`~sb3_eqr.benchmark.suites.Suite.protocol`.
"""

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from rl_zoo3.utils import get_wrapper_class
from stable_baselines3.common.atari_wrappers import ClipRewardEnv, EpisodicLifeEnv, WarpFrame
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import is_wrapped, make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize

from sb3_eqr.common.random_state import preserved_rng_state
from sb3_eqr.envs.atari_batch import AtariBatch, has_atari_batch

FIRST_SEED, SEEDS = 1_000_000, 1_000  # evaluation shares no episodes with training, nor with another run's evaluation
# The preprocessing that AtariBatch implements: the evaluation wrapper of the suite atari100k.
WHOLE_ATARI_GAMES = {"env_wrapper": [{"sb3_eqr.envs.atari.Atari100kWrapper": {"training": False}}], "frame_stack": 4}
N_TURNS = 2  # batches: while the emulator steps one, the agent chooses actions for the other


class EpsilonGreedy:
    """
    A policy for SB3's ``evaluate_policy``: the agent's deterministic action or, with probability ``epsilon``, a random one.

    :param model: the agent
    :param epsilon: probability of a random action
    :param action_space: space to sample random actions from
    :param seed: seed of the random actions
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
        :param state: hidden states of a recurrent agent
        :param episode_start: (n_envs,)
        :param deterministic: ignored
        :return: actions, (n_envs, ...), and hidden states
        """
        actions, state = self._model.predict(observation, state, episode_start, deterministic=True)
        for index in np.flatnonzero(self._rng.random(len(actions)) < self._epsilon):
            actions[index] = self._action_space.sample()
        return actions, state


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
    env = make_game(protocol)
    found = [kind.__name__ for kind in (ClipRewardEnv, EpisodicLifeEnv) if is_wrapped(env, kind)]
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
    :param seed: seed of the first environment; the others' seeds count up from it
    """
    # Monitor is outside the wrappers, so that it sees the protocol's episodes.
    env = make_vec_env(make_game, n_envs=protocol["evaluation"]["n_envs"], seed=seed, env_kwargs={"protocol": protocol})
    old = model.get_vec_normalize_env()
    if old is not None:
        ranges: dict[str, Any] = {"clip_obs": old.clip_obs, "epsilon": old.epsilon}
        env = VecNormalize(env, training=False, norm_obs=old.norm_obs, norm_reward=False, **ranges)
        env.obs_rms = copy.deepcopy(old.obs_rms)
    n_stack = preprocessing_of(protocol).get("frame_stack")
    return VecFrameStack(env, n_stack) if n_stack else env


class GamesInTurn:
    """
    A batch of Atari games and the agent that plays them, until every game has finished its share of episodes.

    :param batch: batch of games
    :param player: the agent
    :param shares: number of episodes per game, (n_envs,)
    """

    def __init__(self, batch: AtariBatch, player: EpsilonGreedy, shares: np.ndarray):
        self._batch = batch
        self._player = player
        self._left = shares.copy()
        self._scores = np.zeros(batch.n_envs)
        self._lengths = np.zeros(batch.n_envs, dtype=int)
        self._observations = batch.reset()
        self._starts = np.ones(batch.n_envs, dtype=bool)
        self._state: tuple[np.ndarray, ...] | None = None

    @property
    def playing(self) -> bool:
        """Whether any episodes are left."""
        return bool(self._left.any())

    def act(self) -> None:
        """Choose actions and send them to the emulator, which runs while Python does other work."""
        # No actions are computed for games that are done, except for a recurrent agent, whose states cover all games.
        chosen = np.flatnonzero(self._left) if self._state is None else np.arange(self._batch.n_envs)
        actions = np.zeros(self._batch.n_envs, dtype=int)
        actions[chosen], self._state = self._player.predict(self._observations[chosen], self._state, self._starts[chosen])
        self._batch.send(actions)

    def see(self) -> list[tuple[float, int]]:
        """
        Wait for the emulator.

        :return: score and length of each episode that has ended and counts
        """
        self._observations, rewards, self._starts = self._batch.receive()
        self._scores += rewards
        self._lengths += 1
        counted = np.flatnonzero(self._starts & (self._left > 0))
        ended = [(float(self._scores[i]), int(self._lengths[i])) for i in counted]
        self._left[counted] -= 1
        self._scores[self._starts], self._lengths[self._starts] = 0.0, 0
        return ended


def evaluate(model: BaseAlgorithm, protocol: dict[str, Any], n_episodes: int, seed: int) -> tuple[list[float], list[int]]:
    """
    Scores and lengths of full episodes. Every environment plays a fixed share of them, so that short episodes are not
    overrepresented. Neither the agent nor the random generators change.

    :param n_episodes: number of episodes
    :param seed: seed of the run
    """
    play, n_threads = play_environments, th.get_num_threads()
    if fits_atari_batch(protocol, model):
        play = play_atari
        th.set_num_threads(max(n_threads // 2, 1))  # the emulator has threads of its own
    try:
        with preserved_rng_state(model.action_space):
            scores, lengths = play(model, protocol, n_episodes, FIRST_SEED + SEEDS * seed)
    finally:
        th.set_num_threads(n_threads)
    return [float(score) for score in scores], [int(length) for length in lengths]


def play_environments(
    model: BaseAlgorithm, protocol: dict[str, Any], n_episodes: int, seed: int
) -> tuple[list[float], list[int]]:
    """:func:`evaluate` for any environments, stepped in turn in one process; ``seed`` is that of the first one."""
    env = make_evaluation_env(protocol, model, seed)
    try:
        player = EpsilonGreedy(model, protocol["evaluation"]["epsilon"], env.action_space, seed)
        scores, lengths = evaluate_policy(player, env, n_episodes, return_episode_rewards=True, warn=False)  # type: ignore[arg-type]
    finally:
        env.close()
    assert isinstance(scores, list) and isinstance(lengths, list)
    return scores, lengths


def fits_atari_batch(protocol: dict[str, Any], model: BaseAlgorithm) -> bool:
    """:return: whether ``AtariBatch`` implements the protocol for this agent"""
    trained = model.get_vec_normalize_env()
    return (
        protocol["env_id"].endswith("NoFrameskip-v4")
        and preprocessing_of(protocol) == WHOLE_ATARI_GAMES
        and not (trained is not None and trained.norm_obs)
        and has_atari_batch()
    )


def play_atari(model: BaseAlgorithm, protocol: dict[str, Any], n_episodes: int, seed: int) -> tuple[list[float], list[int]]:
    """
    :func:`evaluate` for Atari with the preprocessing :data:`WHOLE_ATARI_GAMES`, in two batches that take turns: while the
    emulator steps one, the agent chooses actions for the other.
    """
    settings = protocol["evaluation"]
    n_envs = min(settings["n_envs"], n_episodes)
    shares = (n_episodes + np.arange(n_envs)) // n_envs
    turns: list[GamesInTurn] = []
    for indices in np.array_split(np.arange(n_envs), min(N_TURNS, n_envs)):
        first = seed + int(indices[0])
        batch = AtariBatch(protocol["env_id"], len(indices), first, settings["max_steps"])
        turns.append(GamesInTurn(batch, EpsilonGreedy(model, settings["epsilon"], batch.action_space, first), shares[indices]))
        turns[-1].act()
    ended: list[tuple[float, int]] = []
    while turns:
        for games in turns:
            ended += games.see()
            if games.playing:
                games.act()
        turns = [games for games in turns if games.playing]
    return [score for score, _ in ended], [length for _, length in ended]
