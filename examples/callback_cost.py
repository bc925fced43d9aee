"""
The cost of LatentCallback at its default interval: the time of one call, compared with that of the training steps in between.

    python examples/callback_cost.py     # a sentence of docs/latent_states.md, some minutes
"""

import argparse
import tempfile
import time
from collections.abc import Callable

import gymnasium as gym
import torch as th
from gymnasium.wrappers import FlattenObservation
from stable_baselines3.common.logger import configure

from sb3_eqr import EqRQRDQN, EqRRainbow, load_configuration
from sb3_eqr.common.eqr_algorithm import EqRAlgorithm
from sb3_eqr.envs import make_atari100k_env
from sb3_eqr.visualize import LatentCallback


def pong() -> EqRAlgorithm:
    """Atari, the defaults."""
    return EqRQRDQN("CnnPolicy", make_atari100k_env("Pong", seed=0), seed=0, learning_starts=100, buffer_size=2_000)


def cartpole() -> EqRAlgorithm:
    """The settings for CartPole in zoo_hyperparams."""
    settings = load_configuration("eqr_qrdqn", "CartPole-v1", learning_starts=512)
    return EqRQRDQN("MlpPolicy", "CartPole-v1", seed=0, **settings)


def breakout() -> EqRAlgorithm:
    """MinAtar, its planes as a vector, the defaults."""
    env = FlattenObservation(gym.make("MinAtar/Breakout-v1"))
    return EqRRainbow("MlpPolicy", env, seed=0, learning_starts=500, buffer_size=5_000)


# name -> (agent, warm-up steps, timed steps)
AGENTS: dict[str, tuple[Callable[[], EqRAlgorithm], int, int]] = {
    "EqRQRDQN, Pong": (pong, 300, 60),
    "EqRQRDQN, CartPole": (cartpole, 768, 1_024),
    "EqRRainbow, MinAtar's Breakout": (breakout, 700, 500),
}


def measure(make: Callable[[], EqRAlgorithm], before: int, timed: int, pictures: bool) -> tuple[float, float, float]:
    """
    :return: seconds per step, seconds per call, share of the training time
    """
    model = make()
    with tempfile.TemporaryDirectory() as folder:
        model.set_logger(configure(folder, ["tensorboard", "csv"]))
        model.learn(before, callback=LatentCallback(log_freq=before // 2, pictures=pictures))  # warm up
        start = time.perf_counter()
        model.learn(timed, reset_num_timesteps=False)
        step = (time.perf_counter() - start) / timed
        every = LatentCallback(log_freq=timed // 4, pictures=pictures)
        start = time.perf_counter()
        model.learn(timed, reset_num_timesteps=False, callback=every)
        look = max((time.perf_counter() - start - step * timed) / 4, 0.0)
        model.logger.close()
    return step, look, look / (look + step * LatentCallback().log_freq)


def main() -> None:
    """Measure every agent, with and without figures."""
    parser = argparse.ArgumentParser(description=__doc__.strip().split("\n")[0])
    parser.add_argument("--threads", type=int, default=1, help="PyTorch threads (default: 1)")
    args = parser.parse_args()
    th.set_num_threads(args.threads)
    print("| agent | pictures | ms per step | ms per call | share of training |\n|---|---|---|---|---|")
    for name, (make, before, timed) in AGENTS.items():
        for pictures in (True, False):
            step, look, share = measure(make, before, timed, pictures)
            print(
                f"| {name} | {'yes' if pictures else 'no'} | {1e3 * step:.1f} | {1e3 * look:.0f} | {share:.2%} |", flush=True
            )


if __name__ == "__main__":
    main()
