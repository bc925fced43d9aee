"""What the speed script measures and how: agents, random frames; clocks, tables."""

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from sb3_contrib import QRDQN
from stable_baselines3 import DQN
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack
from torch.profiler import ProfilerActivity, profile
from torch.utils.benchmark import timer

from sb3_eqr import EqRQRDQN, EqRRainbow
from sb3_eqr.common.networks.encoders import ConvExtractor

SIZE, N_STACK, N_ACTIONS = 84, 4, 6  # Atari's frames, Pong's actions
BATCH_SIZE = 32  # Table 5, and SB3's default
EPISODE = 250  # steps; about the time between lost lives in an Atari game
BUFFER_SIZE, N_STORED = 3_000, 1_100  # transitions
OFF, BFLOAT16 = ", group and losses off", ", bfloat16 targets"
EQR_AGENTS = ("EqRQRDQN", "EqRRainbow")


class Network(NamedTuple):
    """An environment, and the agents' arguments for it."""

    policy: str
    make_game: Callable[[], gym.Env]
    n_stack: int = 1
    n_updates: int = 20  # in a timed round
    batch_size: int = BATCH_SIZE
    policy_kwargs: dict[str, Any] = {}
    qrdqn: dict[str, Any] = {}  # policy_kwargs of the stock agent
    eqr: dict[str, Any] = {}  # arguments of the EqR agents


def random_frames(size: int, n_channels: int, n_actions: int) -> FakeImageEnv:
    """Random images (size, size, n_channels), no emulator."""
    game = FakeImageEnv(n_actions, size, size, n_channels=n_channels, discrete=True)
    game.ep_length = EPISODE
    game.observation_space.seed(0)  # which draws the images, and which reset(seed) does not seed
    return game


FEW = {"n_quantiles": 51}
ATARI, MINATAR = partial(random_frames, SIZE, 1, N_ACTIONS), partial(random_frames, 10, 4, 3)
CARTPOLE = partial(gym.make, "CartPole-v1")
SMALL: dict[str, Any] = {"features_extractor_kwargs": {"layers": [[16, 3, 1]]}, "net_arch": [128]}
STILL = {"shift_pixels": 0, "intensity_scale": 0.0}
NETWORKS = {
    "atari": Network("CnnPolicy", ATARI, N_STACK, n_updates=10),  # all at their defaults
    "minatar": Network("CnnPolicy", MINATAR, policy_kwargs=SMALL, qrdqn=FEW, eqr=STILL),
    "cartpole": Network("MlpPolicy", CARTPOLE, batch_size=64, policy_kwargs={"net_arch": [256]}, qrdqn=FEW),
}
ALGORITHMS: tuple[type[Any], ...] = (DQN, QRDQN, EqRQRDQN, EqRRainbow)
AGENTS = {algorithm.__name__: algorithm for algorithm in ALGORITHMS}
AGENTS |= {name + OFF: AGENTS[name] for name in EQR_AGENTS} | {"EqRRainbow" + BFLOAT16: AGENTS["EqRRainbow"]}


def make_agent(
    name: str, network: str = "atari", env: VecEnv | None = None, policy_kwargs: dict[str, Any] | None = None, **kwargs: Any
) -> Any:
    """Create an agent of ``AGENTS`` that logs nothing, with a small and empty replay buffer; arguments override those of
    the network."""
    settings = NETWORKS[network]
    layers = {**settings.policy_kwargs, **(settings.qrdqn if name == "QRDQN" else {}), **(policy_kwargs or {})}
    if "features_extractor_kwargs" in layers:
        layers["features_extractor_class"] = ConvExtractor
    arguments = {"buffer_size": BUFFER_SIZE, "batch_size": settings.batch_size, "seed": 0, "device": "cpu"}
    arguments |= settings.eqr if name.startswith(EQR_AGENTS) else {}
    if BFLOAT16 in name:
        layers["bfloat16_targets"] = True
    if OFF in name:
        layers["group"] = None
        arguments |= {"aet_coef": 0.0, "symmetry_coef": 0.0, "reward_coef": 0.0}
    if env is None:
        env = DummyVecEnv([settings.make_game])
        env = VecFrameStack(env, settings.n_stack) if settings.n_stack > 1 else env
    model = AGENTS[name](settings.policy, env, **{**arguments, **kwargs}, policy_kwargs=layers)
    model.set_logger(configure(None, []))
    return model


def make_trainable(name: str, network: str = "atari", n_updates: int = 3, **kwargs: Any) -> Any:
    """As :func:`make_agent`, with ``N_STORED`` transitions of random actions, after ``n_updates`` updates."""
    model = make_agent(name, network, **kwargs)
    starts, model.learning_starts = model.learning_starts, N_STORED + 1
    model.learn(N_STORED)
    model.learning_starts, model.exploration_rate = starts, 0.0
    model.train(n_updates, model.batch_size)
    return model


def bytes_per_transition(model: Any) -> float:
    """The size of all arrays of the replay buffer, divided by its capacity."""
    buffer, names = model.replay_buffer, ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
    nbytes = buffer.nbytes if hasattr(buffer, "nbytes") else sum(getattr(buffer, name).nbytes for name in names)
    return nbytes / (buffer.buffer_size * buffer.n_envs)


class Series(NamedTuple):
    """The cost of one of the calls compared, per round, (rounds,) each."""

    ms: np.ndarray  # milliseconds of wall-clock time
    cpu_ms: np.ndarray  # milliseconds of CPU time, over all threads of this process

    def ratio(self, other: "Series") -> float:
        """Median of the ratios within a round: of CPU time if PyTorch has one thread, else of wall-clock time."""
        numbers = (self.cpu_ms, other.cpu_ms) if th.get_num_threads() == 1 else (self.ms, other.ms)
        return median(numbers[0] / numbers[1])


def median(numbers: Any) -> float:
    """The median as a Python float, for tables and JSON."""
    return float(np.median(numbers))


def read_clocks() -> np.ndarray:
    """In the order of ``Series``, so far. PyTorch's timer waits for a GPU first."""
    return np.array([timer() * 1e3, time.process_time() * 1e3])


def take_turns(calls: Mapping[str, Callable[[], object]], rounds: int, n_per_call: int = 1) -> dict[str, Series]:
    """
    :param calls: the calls to compare; each is called once per round
    :param rounds: number of rounds, after a first one that does not count
    :param n_per_call: number of updates, samples, ... per call; the series are per update
    """
    found: dict[str, list[np.ndarray]] = {name: [] for name in calls}
    for _ in range(rounds + 1):
        for name, call in calls.items():
            start = read_clocks()
            call()
            found[name].append((read_clocks() - start) / n_per_call)
    return {name: Series(*np.array(numbers[1:]).T) for name, numbers in found.items()}


def count_operations(call: Callable[[], object]) -> int:
    """Operations that Python and the backward pass launch: the profiler's ``aten::`` events outside other such events."""
    with profile(activities=[ProfilerActivity.CPU]) as profiled:
        call()

    def is_inside(event: Any) -> bool:
        parent = event.cpu_parent
        return parent is not None and (parent.name.startswith("aten::") or is_inside(parent))

    return sum(event.name.startswith("aten::") and not is_inside(event) for event in profiled.events())


class Table(NamedTuple):
    """Rows as dictionaries, whose keys are the column names. None is printed as a dash, and a column of None is left out."""

    name: str  # its key in the JSON file
    title: str
    rows: list[dict[str, Any]]
    notes: list[str] = []  # lines below the table

    def text(self) -> str:
        """Title, aligned columns, notes."""
        frame = pd.DataFrame(self.rows).dropna(axis="columns", how="all")
        first = frame.columns[0]
        frame = frame.set_index(first).rename(columns=lambda key: key.replace("_", " "))
        shown = frame.rename_axis(index=None, columns=first).to_string(na_rep="-", float_format=three_digits)
        return "\n".join([self.title, shown, *self.notes])


def three_digits(number: float) -> str:
    """Format with three digits, or with all digits before the decimal point."""
    return f"{number:,.0f}" if abs(number) >= 99.95 else f"{number:#.3g}"
