"""The Atari-100K protocol of the paper (§7 and Table 5), built from SB3's and gymnasium's wrappers."""

import re
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.atari_wrappers import ClipRewardEnv, EpisodicLifeEnv, MaxAndSkipEnv, NoopResetEnv, WarpFrame
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack

from sb3_eqr.common.checks.arguments import nearest

NOOP_MAX = 30  # §7, as in SPR: at most 30 no-ops at the start of a game
FRAME_SKIP = 4  # Table 5, action repetitions
SCREEN_SIZE = 84  # Table 5
FRAME_STACK = 4  # Table 5
MAX_STEPS = 27_000  # Table 5: at most 108K frames per episode


def make_atari100k_env(
    game: str,
    n_envs: int = 1,
    seed: int | None = None,
    training: bool = True,
    vec_env_cls: Callable[..., VecEnv] = DummyVecEnv,
    vec_env_kwargs: dict[str, Any] | None = None,
    monitor_dir: str | None = None,
    render_mode: str | None = None,
) -> VecEnv:
    """
    Create Atari environments as in the paper: up to 30 no-ops, each action repeated for 4 frames with a pixel-wise maximum
    over the last two, greyscale 84×84 images, 4 stacked frames, at most 27,000 agent steps per game, no sticky actions, no
    FIRE press. In training, rewards are clipped to their sign and losing a life ends an episode; ``Monitor`` records the raw
    scores of full games.

    :param game: "Pong", "PongNoFrameskip-v4" or "ALE/Pong-v5": all the same environment
    :param n_envs: number of environments
    :param seed: seed of the first environment; each further environment adds 1
    :param training: ``False``: raw rewards, and an episode is a full game
    :param vec_env_cls: ``DummyVecEnv`` or ``SubprocVecEnv``
    :param vec_env_kwargs: its keyword arguments
    :param monitor_dir: folder for ``Monitor``'s files
    :param render_mode: ALE's render mode: "rgb_array" for colour images from ``render()``, "human" for a window
    :return: environments with observations of shape (84, 84, 4), uint8; SB3 transposes them
    :raises ImportError: if ale-py or OpenCV is not installed
    :raises ValueError: if the game is unknown (the message suggests the nearest names) or ``n_envs`` is below 1
    """
    env_id = atari_env_id(game)
    if n_envs < 1:
        raise ValueError(f"n_envs must be an integer >= 1, got {n_envs}.")

    def make_game() -> gym.Env:
        # Turn off ALE's own sticky actions, frame skip and frame limit: the wrappers implement the protocol.
        env = gym.make(
            env_id, render_mode=render_mode, frameskip=1, repeat_action_probability=0.0, max_num_frames_per_episode=None
        )
        return _in_agent_steps(env)

    env = make_vec_env(
        make_game,
        n_envs=n_envs,
        seed=seed,
        monitor_dir=monitor_dir,
        wrapper_class=partial(_preprocess, training=training),  # outside Monitor
        vec_env_cls=vec_env_cls,  # type: ignore[arg-type]
        vec_env_kwargs=vec_env_kwargs,
    )
    return VecFrameStack(env, n_stack=FRAME_STACK)


class Atari100kWrapper(gym.Wrapper):
    """
    The same preprocessing as a wrapper of one ALE environment, for RL Zoo's ``env_wrapper`` (with ``frame_stack: 4``). SB3's
    ``evaluate_policy`` still reports the raw scores of full games, from ``Monitor``.

    :param env: "PongNoFrameskip-v4", or "ALE/Pong-v5" made with ``frameskip=1, repeat_action_probability=0.0``
    :param training: ``False``: raw rewards, and an episode is a full game
    :raises ValueError: if the environment itself skips frames or repeats actions
    """

    def __init__(self, env: gym.Env, training: bool = True):
        made_with = {} if env.spec is None else env.spec.kwargs
        found = {key: made_with.get(key) for key in ("frameskip", "repeat_action_probability")}
        if found != {"frameskip": 1, "repeat_action_probability": 0.0}:
            raise ValueError(
                f"Atari100kWrapper: env must be made with frameskip=1 and repeat_action_probability=0.0, got {found}. "
                "Use the NoFrameskip-v4 name of the game, or RL Zoo's "
                "--env-kwargs frameskip:1 repeat_action_probability:0.0."
            )
        super().__init__(_preprocess(_in_agent_steps(env), training))


def _in_agent_steps(env: gym.Env) -> gym.Env:
    return TimeLimit(MaxAndSkipEnv(NoopResetEnv(env, noop_max=NOOP_MAX), skip=FRAME_SKIP), MAX_STEPS)


def _preprocess(env: gym.Env, training: bool) -> gym.Env:
    warped = WarpFrame(EpisodicLifeEnv(env) if training else env, width=SCREEN_SIZE, height=SCREEN_SIZE)
    return ClipRewardEnv(warped) if training else warped


def atari_env_id(game: str) -> str:
    """
    :param game: see :func:`make_atari100k_env`; case, "_" and spaces do not matter
    :return: "ALE/<Game>-v5"
    :raises ImportError: if ale-py is not installed
    :raises ValueError: if the game is unknown
    """
    try:
        import ale_py
    except ImportError as error:
        raise ImportError('Atari needs ale-py and OpenCV: pip install ".[atari]" in a clone of the repository') from error
    gym.register_envs(ale_py)
    games = {name[4:-3].lower(): name for name in gym.registry if re.fullmatch(r"ALE/[A-Za-z]+[A-Za-z0-9]*-v5", name)}
    bare = re.sub(r"^ALE/|-v5$|NoFrameskip-v4$|[_ ]", "", game)
    if bare.lower() not in games:
        hint = nearest(bare, [name[4:-3] for name in games.values()]) or " See gymnasium.registry."
        raise ValueError(f"game must be the name of an Atari game such as 'Pong', got {game!r}.{hint}")
    return games[bare.lower()]
