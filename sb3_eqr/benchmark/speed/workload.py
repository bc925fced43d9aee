"""What is measured: agents on frames like Atari's, and replay buffers full of them."""

import math
from typing import Any

import numpy as np
from sb3_contrib import QRDQN
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack

from sb3_eqr import EqRQRDQN, EqRRainbow
from sb3_eqr.common.eqr_algorithm import EqRAlgorithm

SIZE = 84
N_STACK = 4
N_ACTIONS = 6  # Pong's
BATCH_SIZE = 32  # Table 5, and SB3's default
EPISODE = 250  # steps; an Atari game loses a life about as often
BUFFER_SIZE = 3_000
N_STORED = 2_500  # of these
STEPS_PER_CALL = 2  # gradient steps per environment step, Table 5

STOCK_DQN, STOCK_QRDQN, DEPTH_0 = "DQN (stock)", "QRDQN (stock)", "EqRQRDQN, depth 0"
AGENTS: dict[str, tuple[type[OffPolicyAlgorithm], dict[str, Any]]] = {
    STOCK_DQN: (DQN, {}),
    STOCK_QRDQN: (QRDQN, {}),
    "EqRQRDQN": (EqRQRDQN, {}),
    "EqRRainbow": (EqRRainbow, {}),
    DEPTH_0: (EqRQRDQN, {"prediction_depth": 0}),
}
EQR_AGENTS = ("EqRQRDQN", "EqRRainbow")  # at Table 5 settings


def make_env(n_envs: int = 1) -> VecEnv:
    """Random frames, stacked as Atari's are; no emulator."""

    def make_game() -> FakeImageEnv:
        game = FakeImageEnv(N_ACTIONS, SIZE, SIZE, n_channels=1, discrete=True)
        game.ep_length = EPISODE
        return game

    return VecFrameStack(DummyVecEnv([make_game] * n_envs), N_STACK)


def make_agent(name: str, env: VecEnv | None = None, device: str = "cpu", **kwargs: Any) -> Any:
    """
    An agent with its defaults, but for a small replay buffer, which is empty.

    :param name: in ``AGENTS``
    :param env: random frames where not given
    :param kwargs: of its constructor
    """
    algorithm, own = AGENTS[name]
    env = make_env() if env is None else env
    arguments = {"buffer_size": BUFFER_SIZE, "batch_size": BATCH_SIZE, "seed": 0, "device": device, **own, **kwargs}
    model = algorithm("CnnPolicy", env, **arguments)  # type: ignore[arg-type]
    model.set_logger(configure(None, []))
    return model


def make_trainable(name: str, device: str = "cpu", **kwargs: Any) -> Any:
    """As :func:`make_agent`, with frames to learn from, and past its first updates."""
    model = make_agent(name, device=device, **kwargs)
    fill(model.replay_buffer, N_STORED)
    model.train(gradient_steps=3, batch_size=model.batch_size)
    return model


def train(model: OffPolicyAlgorithm) -> None:
    """``STEPS_PER_CALL`` gradient steps."""
    model.train(gradient_steps=STEPS_PER_CALL, batch_size=model.batch_size)


def play(model: OffPolicyAlgorithm, n_steps: int) -> None:
    """
    Collection: act and store, without gradient steps; goes on where it was.

    :param n_steps: of the environments together
    """
    model.learning_starts, model.gradient_steps = 0, 0
    model.learn(n_steps, reset_num_timesteps=False)


def fill(buffer: Any, n_adds: int) -> None:
    """
    The same random frames into any buffer, as one stream of stacks per environment.

    :param buffer: a replay buffer for stacks of shape (4, 84, 84)
    :param n_adds: calls of ``add``
    """
    rng = np.random.default_rng(0)
    n_envs = buffer.n_envs
    pool = rng.integers(0, 256, (64, n_envs, 1, SIZE, SIZE), dtype=np.uint8)
    stack = np.zeros((n_envs, N_STACK, SIZE, SIZE), dtype=np.uint8)
    infos: list[dict[str, Any]] = [{} for _ in range(n_envs)]
    for step in range(n_adds):
        if step % EPISODE == 0:
            stack = np.zeros_like(stack)
            stack[:, -1:] = pool[step % 64]
        next_stack = np.concatenate([stack[:, 1:], pool[(step * 7 + 1) % 64]], axis=1)
        done = np.full(n_envs, step % EPISODE == EPISODE - 1)
        buffer.add(stack, next_stack, rng.integers(0, N_ACTIONS, n_envs), rng.integers(-1, 2, n_envs), done, infos)
        stack = next_stack


def bytes_per_transition(model: OffPolicyAlgorithm) -> float:
    """
    :return: all arrays of the replay buffer over its capacity
    """
    buffer: Any = model.replay_buffer
    if isinstance(model, EqRAlgorithm):
        return buffer.nbytes / (buffer.buffer_size * buffer.n_envs)
    names = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
    arrays = [getattr(buffer, name, None) for name in names]
    return sum(array.nbytes for array in arrays if array is not None) / (buffer.buffer_size * buffer.n_envs)


def state_entries(model: EqRAlgorithm) -> int:
    """
    :return: numbers in the K group elements of one state
    """
    group = model.policy.latent_model.group
    return model.policy.latent_model.n_blocks * math.prod(group.element_shape)


def close(model: BaseAlgorithm) -> None:
    """Close the environments of a model."""
    env = model.get_env()
    if env is not None:
        env.close()
