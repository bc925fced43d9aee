"""
What a step costs: stock QRDQN, EqRQRDQN and EqRRainbow in turns, in one process, on the same 84×84×4 frames.

    python -m sb3_eqr.benchmark.speed [--threads 1] [--rounds 30] [--large] [--json FILE]

Milliseconds are medians over the rounds, ratios are medians of the ratios within a round, so that a drift of the
machine falls on both sides. ``--large`` adds the cost of sampling at 10,000 and 1,000,000 stored transitions (8 GB).
"""

import argparse
import json
import time
from collections.abc import Callable

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib import QRDQN
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack

from sb3_eqr import EqRQRDQN, EqRRainbow, PrioritizedSequenceReplayBuffer, SequenceReplayBuffer

SIZE = 84
N_STACK = 4
N_ACTIONS = 6  # Pong's
BATCH_SIZE = 32  # Table 5
EPISODE = 250  # steps; an Atari game loses a life about as often


def make_env() -> VecEnv:
    """Random frames, stacked as Atari's are; the emulator's own time is left out."""
    frames = lambda: FakeImageEnv(N_ACTIONS, SIZE, SIZE, n_channels=1, discrete=True)  # noqa: E731
    return VecFrameStack(DummyVecEnv([frames]), N_STACK)


def make_models() -> dict[str, OffPolicyAlgorithm]:
    """Stock QRDQN with its defaults, and the EqR agents at Table 5 settings, one of them without auxiliary losses, too."""
    size = 3_000
    return {
        "QRDQN (stock)": QRDQN("CnnPolicy", make_env(), buffer_size=size, batch_size=BATCH_SIZE, seed=0),
        "EqRQRDQN": EqRQRDQN("CnnPolicy", make_env(), buffer_size=size, batch_size=BATCH_SIZE, seed=0),
        "EqRRainbow": EqRRainbow("CnnPolicy", make_env(), buffer_size=size, batch_size=BATCH_SIZE, seed=0),
        "EqRQRDQN, depth 0": EqRQRDQN(
            "CnnPolicy", make_env(), buffer_size=size, batch_size=BATCH_SIZE, seed=0, prediction_depth=0
        ),
    }


def fill(buffer, n_adds: int, n_envs: int = 1) -> None:
    """
    The same random frames into any buffer, as one stream of stacks per environment.

    :param buffer: a replay buffer for stacks of shape (4, 84, 84)
    :param n_adds: calls of ``add``
    """
    rng = np.random.default_rng(0)
    pool = rng.integers(0, 256, (64, n_envs, 1, SIZE, SIZE), dtype=np.uint8)
    stack = np.zeros((n_envs, N_STACK, SIZE, SIZE), dtype=np.uint8)
    infos: list[dict] = [{} for _ in range(n_envs)]
    for step in range(n_adds):
        if step % EPISODE == 0:
            stack = np.zeros_like(stack)
            stack[:, -1:] = pool[step % 64]
        next_stack = np.concatenate([stack[:, 1:], pool[(step * 7 + 1) % 64]], axis=1)
        done = np.full(n_envs, step % EPISODE == EPISODE - 1)
        buffer.add(stack, next_stack, rng.integers(0, N_ACTIONS, n_envs), rng.integers(-1, 2, n_envs), done, infos)
        stack = next_stack


def milliseconds(function: Callable[[], object], repeat: int = 1) -> float:
    """
    :return: wall-clock milliseconds of one call, the mean of ``repeat``
    """
    start = time.perf_counter()
    for _ in range(repeat):
        function()
    return (time.perf_counter() - start) / repeat * 1e3


def measure_steps(models: dict[str, OffPolicyAlgorithm], rounds: int) -> dict[str, list[float]]:
    """
    :return: milliseconds per gradient step of each model, one per round; models take turns within a round
    """
    for model in models.values():
        model.set_logger(configure(None, []))
        fill(model.replay_buffer, 2_500)
        model.train(gradient_steps=3, batch_size=BATCH_SIZE)  # warm up
    timings: dict[str, list[float]] = {name: [] for name in models}
    for _ in range(rounds):
        for name, model in models.items():
            timings[name].append(milliseconds(lambda: model.train(gradient_steps=2, batch_size=BATCH_SIZE)) / 2)  # noqa: B023
    return timings


def measure_collection(models: dict[str, OffPolicyAlgorithm], steps: int) -> dict[str, float]:
    """
    :return: environment steps per second of each model, acting and storing, without gradient steps
    """
    rates = {}
    for name, model in models.items():
        model.learning_starts, model.gradient_steps = 0, 0
        rates[name] = steps / milliseconds(lambda: model.learn(steps)) * 1e3  # noqa: B023
    return rates


def bytes_per_transition(models: dict[str, OffPolicyAlgorithm]) -> dict[str, float]:
    """
    :return: all arrays of the replay buffer over its capacity, per model
    """
    found = {}
    for name, model in models.items():
        buffer = model.replay_buffer
        assert buffer is not None
        arrays = (buffer.__dict__.get(n) for n in ("observations", "next_observations", "actions", "rewards", "dones"))
        stock = sum(array.nbytes for array in arrays if array is not None) + buffer.timeouts.nbytes
        found[name] = getattr(buffer, "nbytes", stock) / buffer.buffer_size
    return found


def measure_sampling(sizes: tuple[int, ...], rounds: int) -> dict[str, dict[int, float]]:
    """
    :return: median milliseconds of a sample, per way of drawing and number of stored transitions
    """
    n_envs = 20
    space = spaces.Box(0, 255, (N_STACK, SIZE, SIZE), np.uint8)
    buffers = {}
    for size in sizes:
        buffers[size] = PrioritizedSequenceReplayBuffer(
            size, space, spaces.Discrete(N_ACTIONS), "cpu", n_envs, n_steps=10, prediction_depth=5, frame_stack=N_STACK
        )
        fill(buffers[size], size // n_envs, n_envs)
    priorities = th.rand(BATCH_SIZE)
    ways: dict[str, Callable[[PrioritizedSequenceReplayBuffer], object]] = {
        "prioritised, priorities updated": lambda b: b.update_priorities(b.sample(BATCH_SIZE).indices, priorities),
        "uniform, from the same storage": lambda b: SequenceReplayBuffer.sample(b, BATCH_SIZE),
    }
    timings: dict[str, dict[int, list[float]]] = {way: {size: [] for size in sizes} for way in ways}
    for _ in range(rounds):
        for way, call in ways.items():
            for size, buffer in buffers.items():
                timings[way][size].append(milliseconds(lambda: call(buffer), 30))  # noqa: B023
    return {way: {size: float(np.median(t)) for size, t in row.items()} for way, row in timings.items()}


def main() -> None:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(prog="python -m sb3_eqr.benchmark.speed", description=__doc__.split("\n\n")[0])
    parser.add_argument("--threads", type=int, default=th.get_num_threads(), help="threads of PyTorch")
    parser.add_argument("--rounds", type=int, default=30, help="rounds in which the models take turns")
    parser.add_argument("--large", action="store_true", help="sampling at 10,000 and 1,000,000 transitions (8 GB)")
    parser.add_argument("--json", metavar="FILE", help="write the figures there, too")
    args = parser.parse_args()
    th.set_num_threads(args.threads)

    models = make_models()
    timings = measure_steps(models, args.rounds)
    stock = np.array(timings["QRDQN (stock)"])
    memory = bytes_per_transition(models)
    rates = measure_collection(models, 500)
    print(f"84x84x4, batch {BATCH_SIZE}, {args.threads} thread(s), {args.rounds} rounds, torch {th.__version__}")
    print(f"{'':20}{'ms/gradient step':>18}{'best':>8}{'ratio':>8}{'env steps/s':>13}{'bytes/transition':>18}")
    figures = {}
    for name, values in timings.items():
        figures[name] = {
            "ms_per_gradient_step": float(np.median(values)),
            "best_ms": min(values),
            "ratio": float(np.median(np.array(values) / stock)),
            "env_steps_per_second": rates[name],
            "bytes_per_transition": memory[name],
        }
        row = figures[name]
        print(
            f"{name:20}{row['ms_per_gradient_step']:18.1f}{row['best_ms']:8.1f}{row['ratio']:8.2f}"
            f"{row['env_steps_per_second']:13.0f}{row['bytes_per_transition']:18.0f}"
        )
    heads = float(np.median(np.array(timings["EqRRainbow"]) / np.array(timings["EqRQRDQN"])))
    print(f"gradient step of EqRRainbow over that of EqRQRDQN: {heads:.2f}")
    result: dict = {
        "threads": args.threads,
        "rounds": args.rounds,
        "torch": th.__version__,
        "models": figures,
        "rainbow_over_qrdqn": heads,
    }
    if args.large:
        result["sampling_ms"] = measure_sampling((10_000, 1_000_000), args.rounds)
        for way, row in result["sampling_ms"].items():
            print(f"sample, {way}: " + ", ".join(f"{ms:.2f} ms at {size:,} stored" for size, ms in row.items()))
    if args.json:
        with open(args.json, "w") as file:
            json.dump(result, file, indent=2)


if __name__ == "__main__":
    main()
