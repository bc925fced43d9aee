"""Whole Atari games side by side, for evaluation: ALE plays them in its own threads."""

import os
from importlib.metadata import PackageNotFoundError, version

import gymnasium as gym
import numpy as np
from stable_baselines3.common.atari_wrappers import WarpFrame

from sb3_eqr.envs import atari

NO_LIMIT = 2**31 - 1  # frames


class AtariBatch:
    """
    What ``make_atari100k_env(game, n_envs, training=False)`` plays, from ALE's vector environment: the same observations
    bit by bit, raw rewards, whole games, no sticky actions, no FIRE press. ``send`` returns at once and ``receive``
    waits, so that the agent can act in another batch meanwhile.

    ALE's own preprocessing is left off: it maximises grey screens of its palette where SB3's wrappers maximise colours
    and convert them afterwards, and 0.2 % of Pong's pixels differ by up to 16 (docs/results/evaluation_speed.md). Its
    unscaled screens in colour are those of SB3's ``MaxAndSkipEnv``.

    As in SB3's ``NoopResetEnv``, each number of no-ops from 1 to 30 is as likely; the generator is ALE's, so a seed stands
    for other games than in ``make_atari100k_env``.

    :param game: see :func:`~sb3_eqr.envs.atari.make_atari100k_env`
    :param n_envs: number of games
    :param seed: of the first game; the others count up
    :param max_steps: agent steps after which a game is over; those of the protocol at most
    """

    def __init__(self, game: str, n_envs: int, seed: int, max_steps: int | None = None):
        from ale_py.vector_env import AtariVectorEnv  # Atari is an extra
        from gymnasium.vector import AutoresetMode

        env_id = atari.atari_env_id(game)
        single = gym.make(env_id, frameskip=1)
        self.action_space = single.action_space
        self._warp = WarpFrame(single, width=atari.SCREEN_SIZE, height=atari.SCREEN_SIZE).observation
        self._start_frame = single.reset()[1]["episode_frame_number"]  # some games press buttons before they start
        height, width, _ = single.observation_space.shape  # type: ignore[misc]
        single.close()
        self._env = AtariVectorEnv(
            gym.spec(env_id).kwargs["game"],
            n_envs,
            num_threads=max((os.cpu_count() or 2) - 1, 1),  # one core is the agent's
            max_num_frames_per_episode=NO_LIMIT,  # ALE would count no-ops; steps are counted here
            autoreset_mode=AutoresetMode.SAME_STEP,
            img_height=height,
            img_width=width,
            grayscale=False,
            stack_num=1,
            frameskip=atari.FRAME_SKIP,
            noop_max=atari.NOOP_MAX + 1,  # ALE draws 0 … noop_max - 1, and 0 is drawn again
            reward_clipping=False,
            use_fire_reset=False,
        )
        self.n_envs = n_envs
        self.n_noops = np.zeros(n_envs, dtype=int)  # before each game's first step
        self._seed = seed
        self._max_steps = min(atari.MAX_STEPS, max_steps or atari.MAX_STEPS)
        self._steps = np.zeros(n_envs, dtype=int)
        self._stacks = np.zeros((n_envs, atari.FRAME_STACK, atari.SCREEN_SIZE, atari.SCREEN_SIZE), dtype=np.uint8)

    def reset(self) -> np.ndarray:
        """
        :return: observations, (n_envs, 84, 84, 4)
        """
        screens, info = self._env.reset(seed=self._seed)
        self._begin(np.ones(self.n_envs, dtype=bool), screens, self._noops_of(info))
        return self._stacked(screens)

    def send(self, actions: np.ndarray) -> None:
        """
        :param actions: (n_envs,)
        """
        self._env.send(actions)

    def receive(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        :return: observations, (n_envs, 84, 84, 4), of the next game where one is over; rewards, (n_envs,); whether it is
            over, (n_envs,)
        """
        screens, rewards, game_over, _, info = self._env.recv()
        self._steps += 1
        done = game_over | (self._steps >= self._max_steps)
        # ALE has begun the next game where one was over, not where the steps were.
        self._begin(done, screens, np.where(game_over, self._noops_of(info), 0))
        return self._stacked(screens), rewards.astype(np.float64), done

    def _begin(self, new: np.ndarray, screens: np.ndarray, n_noops: np.ndarray) -> None:
        """
        :param new: which games begin, (n_envs,)
        :param screens: (n_envs, 1, height, width, 3), written to where a game had to begin once more
        :param n_noops: that it has begun with, (n_envs,); with none, it begins once more
        """
        self._steps[new] = 0
        self._stacks[new] = 0
        self.n_noops[new] = n_noops[new]
        while (again := new & (self.n_noops == 0)).any():
            fresh, info = self._env.reset(options={"reset_mask": again})
            screens[again] = fresh[again]
            self.n_noops[again] = self._noops_of(info)[again]

    def _noops_of(self, info: dict[str, np.ndarray]) -> np.ndarray:
        return info["episode_frame_number"] - self._start_frame

    def _stacked(self, screens: np.ndarray) -> np.ndarray:
        """
        :param screens: (n_envs, 1, height, width, 3)
        :return: (n_envs, 84, 84, 4), the newest frame last
        """
        self._stacks[:, :-1] = self._stacks[:, 1:]
        for stack, screen in zip(self._stacks, screens[:, 0], strict=True):
            stack[-1] = self._warp(screen)[:, :, 0]
        return self._stacks.transpose(0, 2, 3, 1)


def has_atari_batch() -> bool:
    """
    :return: whether ale-py can restart some games of a batch
    """
    try:
        found = version("ale-py")
    except PackageNotFoundError:
        return False
    return tuple(int(part) for part in found.split(".")[:2]) >= (0, 12)
