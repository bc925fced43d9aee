"""Full Atari games in parallel, for evaluation: ALE runs them in its own threads."""

import os
from importlib.metadata import PackageNotFoundError, version

import gymnasium as gym
import numpy as np
from stable_baselines3.common.atari_wrappers import WarpFrame

from sb3_eqr.envs import atari

NO_LIMIT = 2**31 - 1  # frames


class AtariBatch:
    """
    The same games as ``make_atari100k_env(game, n_envs, training=False)``, from ALE's vector environment: bitwise identical
    observations, raw rewards, full games, no sticky actions, no FIRE press. ``send`` returns at once and ``receive``
    waits, so that the agent can act in another batch meanwhile.

    ALE's own preprocessing is turned off: it takes the maximum over greyscale screens, whereas SB3's wrappers take it over
    colours and convert them afterwards, so 0.2 % of Pong's pixels differ by up to 16 (docs/results/evaluation_speed.md).
    ALE's unscaled colour screens are identical to those of SB3's ``MaxAndSkipEnv``.

    As in SB3's ``NoopResetEnv``, each number of no-ops from 1 to 30 is equally likely. ALE's generator draws them, so the same
    seed gives other games than in ``make_atari100k_env``.

    :param game: see :func:`~sb3_eqr.envs.atari.make_atari100k_env`
    :param n_envs: number of games
    :param seed: seed of the first game; each further game adds 1
    :param max_steps: maximum number of agent steps per game; capped at the protocol's limit
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
            num_threads=max((os.cpu_count() or 2) - 1, 1),  # leaves one core to the agent
            max_num_frames_per_episode=NO_LIMIT,  # ALE would count no-ops, so steps are counted here
            autoreset_mode=AutoresetMode.SAME_STEP,
            img_height=height,
            img_width=width,
            grayscale=False,
            stack_num=1,
            frameskip=atari.FRAME_SKIP,
            noop_max=atari.NOOP_MAX + 1,  # ALE draws from 0 … noop_max - 1; 0 is redrawn
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
        :return: observations, (n_envs, 84, 84, 4), of the next game where one has ended; rewards, (n_envs,); whether each
            game has ended, (n_envs,)
        """
        screens, rewards, game_over, _, info = self._env.recv()
        self._steps += 1
        done = game_over | (self._steps >= self._max_steps)
        # ALE has started the next game where one was over, but not where the step limit was reached.
        self._begin(done, screens, np.where(game_over, self._noops_of(info), 0))
        return self._stacked(screens), rewards.astype(np.float64), done

    def _begin(self, new: np.ndarray, screens: np.ndarray, n_noops: np.ndarray) -> None:
        """
        :param new: which games have started, (n_envs,)
        :param screens: (n_envs, 1, height, width, 3), overwritten for games that are started again
        :param n_noops: number of no-ops at the start of each game, (n_envs,); a game with 0 is started again
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
    :return: whether the installed ale-py can restart individual games of a batch
    """
    try:
        found = version("ale-py")
    except PackageNotFoundError:
        return False
    return tuple(int(part) for part in found.split(".")[:2]) >= (0, 12)
