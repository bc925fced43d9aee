"""
What ``experiments.peer_speed`` measures: updates, replay and acting of this package's agent and of its peers, each through the
peer's own interface. This module is run with the Python of the peer's environment, so at its top it imports NumPy only:

    python -m experiments.peer_calls NAME THREADS  # prints a line of JSON, and another for each line that it reads
"""

import contextlib
import gc
import importlib.metadata
import itertools
import json
import os
import sys
import time
import types
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple
from unittest.mock import MagicMock

import numpy as np

SIZE, N_STACK, N_ACTIONS, BATCH_SIZE, EPISODE = 84, 4, 6, 32, 250
N_STORED, N_STEP = 1_100, 10  # transitions in a full buffer; n of the returns, where the peer has them
GAMMA, LEARNING_RATE = 0.99, 6.25e-5
COUNTS = {"update": 10, "add": EPISODE, "sample": 50, "act": 100}  # in a round
LONGEST = 1.0  # seconds: fewer of them in a round if they take longer, but at least one
FRAMES = np.random.default_rng(0).integers(
    0, 256, (64, SIZE, SIZE), dtype=np.uint8
)  # reused: an environment that costs nothing


class Calls(NamedTuple):
    """What is measured: each a function of how often; None: not measured, for the reason in the note."""

    update: Callable[[int], object] | None = None  # gradient steps, including sampling and priorities
    add: Callable[[int], object] | None = None  # transitions, to a full buffer
    sample: Callable[[int], object] | None = None  # batches, as an update needs them
    act: Callable[[int], object] | None = None  # steps: choose an action with the network, environment, store; no updates
    bytes_per_transition: float | None = None
    note: str = ""


def repeated(call: Callable[[], object]) -> Callable[[int], None]:
    """:return: a function that calls ``call`` a number of times"""

    def several(n: int) -> None:
        for _ in range(n):
            call()

    return several


def reachable_bytes(root: object) -> int:
    """The memory of an object and of all that it refers to, except classes and functions: arrays, and Python's own objects."""
    seen: set[int] = set()
    todo, total = [root], 0
    while todo:
        one = todo.pop()
        if id(one) in seen or isinstance(one, (type, types.ModuleType, types.FunctionType, types.BuiltinFunctionType)):
            continue
        seen.add(id(one))
        if isinstance(one, np.ndarray) and one.base is not None:
            todo.append(one.base)  # which owns the memory
        elif isinstance(one, np.ndarray):
            total += one.nbytes
            todo += one.ravel().tolist() if one.dtype == object else []
        else:
            total += sys.getsizeof(one)
            todo += gc.get_referents(one)
    return total


def new_frame() -> np.ndarray:
    """A frame with memory of its own, as an environment returns it."""
    return np.random.randint(0, 256, (SIZE, SIZE), dtype=np.uint8)


def stacks_of_frames() -> np.ndarray:
    """Stacked frames of one episode and the last observation, (EPISODE + 1, 4, 84, 84)."""
    frames = np.resize(FRAMES, (EPISODE + N_STACK, SIZE, SIZE))
    return np.stack([frames[i : i + N_STACK] for i in range(EPISODE + 1)])


def make_env(stacked: bool) -> Any:
    """A Gymnasium environment whose observations are frames, (84, 84, 1), or stacks of them, (4, 84, 84)."""
    import gymnasium as gym

    stacks = stacks_of_frames()

    class Frames(gym.Env):
        observation_space = gym.spaces.Box(0, 255, (N_STACK, SIZE, SIZE) if stacked else (SIZE, SIZE, 1), np.uint8)
        action_space = gym.spaces.Discrete(N_ACTIONS)

        def observe(self) -> np.ndarray:
            return stacks[self.t] if stacked else stacks[self.t, -1, :, :, None]

        def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
            self.t = 0
            return self.observe(), {}

        def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
            self.t += 1
            return self.observe(), 0.0, self.t == EPISODE, False, {}

    return Frames()


def stable_env() -> Any:
    """The environment, with frames stacked by Stable-Baselines3."""
    from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

    return VecFrameStack(DummyVecEnv([lambda: make_env(stacked=False)]), N_STACK)


def stable_calls(model: Any, wait: Callable[[], object] = lambda: None, note: str = "") -> Calls:
    """The calls of an agent with the interface of Stable-Baselines3; ``wait`` returns when the last update has ended."""
    model.learning_starts = N_STORED + 1
    model.learn(N_STORED)  # random actions
    model.learning_starts, model.exploration_schedule = 0, lambda progress: 0.0
    buffer, stacks, steps = model.replay_buffer, stacks_of_frames()[:, None], itertools.cycle(range(EPISODE))

    def update() -> None:
        model.train(gradient_steps=1, batch_size=BATCH_SIZE)
        wait()

    def add() -> None:
        i = next(steps)
        buffer.add(stacks[i], stacks[i + 1], np.array([1]), np.zeros(1), np.array([i == EPISODE - 1]), [{}])

    def act(n: int) -> None:
        model.gradient_steps = 0
        model.learn(n, reset_num_timesteps=False)

    arrays = sum(value.nbytes for value in vars(buffer).values() if isinstance(value, np.ndarray))
    nbytes = getattr(buffer, "nbytes", arrays) / buffer.buffer_size
    return Calls(repeated(update), repeated(add), repeated(partial(buffer.sample, BATCH_SIZE)), act, nbytes, note)


def make_stable(name: str) -> Calls:
    """An agent of ``experiments.workload``: Stable-Baselines3's, sb3-contrib's, or ours."""
    from experiments.workload import make_agent

    if not name.startswith("EqR"):
        return stable_calls(make_agent(name, env=stable_env()))
    return stable_calls(
        make_agent(name, env=stable_env(), policy_kwargs={"net_arch": [512]}), note="hidden layer: default 256"
    )


def make_sbx() -> Calls:
    """SBX's DQN."""
    import jax
    from sbx import DQN
    from stable_baselines3.common.logger import configure

    model = DQN("CnnPolicy", stable_env(), buffer_size=3_000, batch_size=BATCH_SIZE, policy_kwargs={"net_arch": [512]})
    model.set_logger(configure(None, []))
    note = "its update is a scan of one step, in which XLA's convolutions take some ten times as long on a CPU"
    return stable_calls(model, lambda: jax.block_until_ready(model.policy.qf_state), note)


def import_dopamine() -> Any:
    """:return: the module of Dopamine's full Rainbow, with its replay buffer set up for all agents made later"""
    # Both are imported for other agents and environments. The first is not declared, the second fails with this JAX.
    for name in ("baselines", "baselines.common", "tensorflow_probability", "tensorflow_probability.substrates"):
        sys.modules[name] = MagicMock()
    import gin
    from dopamine.jax.agents.full_rainbow import full_rainbow_agent

    bindings: dict[str, Any] = {"ReplayBuffer.batch_size": BATCH_SIZE, "ReplayBuffer.max_capacity": N_STORED}
    bindings |= {"PrioritizedSamplingDistribution.max_capacity": N_STORED, "JaxDQNAgent.update_horizon": N_STEP}
    bindings |= {"JaxDQNAgent.gamma": GAMMA, "JaxDQNAgent.min_replay_history": 10**9}  # acting does not train
    for key, value in bindings.items():
        gin.bind_parameter(key, value)
    return full_rainbow_agent


def dopamine_update(agent: Any) -> Callable[[], None]:
    """:return: an update that returns when JAX has finished it"""
    import jax

    def update() -> None:
        agent._training_step_update()
        jax.block_until_ready((agent.online_params, agent.optimizer_state))

    return update


def make_dopamine_rainbow() -> Calls:
    """Dopamine's full Rainbow: n-step, prioritised, distributional, double, noisy, dueling."""
    agent = import_dopamine().JaxFullRainbowAgent(N_ACTIONS, seed=0)
    steps = itertools.count(1)

    def step() -> None:
        i = next(steps)
        if i % EPISODE == 0:
            agent.end_episode(0.0)
            agent.begin_episode(FRAMES[0])
        else:
            agent.step(0.0, FRAMES[i % len(FRAMES)])

    def add() -> None:
        i = next(steps)
        agent._store_transition(FRAMES[i % len(FRAMES)], 1, 0.0, i % EPISODE == 0, episode_end=i % EPISODE == 0)

    agent.begin_episode(FRAMES[0])
    repeated(add)(N_STORED + EPISODE)
    nbytes = reachable_bytes(agent._replay) / len(agent._replay._memory)
    note = "the buffer compresses stacks, of which random frames are the worst case"
    return Calls(
        repeated(dopamine_update(agent)),
        repeated(add),
        repeated(agent._sample_from_replay_buffer),
        repeated(step),
        nbytes,
        note,
    )


def make_dopamine_spr() -> Calls:
    """Dopamine's SPR on a fixed batch, as no release on the package index contains its replay buffer."""
    import_dopamine()
    sys.modules["dopamine.labs.atari_100k.replay_memory"] = MagicMock()
    import gin
    from dopamine.labs.atari_100k.spr_agent import SPRAgent

    gin.bind_parameter("Atari100kRainbowAgent.data_augmentation", True)
    agent, rng = SPRAgent(N_ACTIONS, seed=0), np.random.default_rng(0)
    shape = (BATCH_SIZE, agent._jumps + 1)
    images = {key: rng.integers(0, 256, (*shape, SIZE, SIZE, N_STACK), dtype=np.uint8) for key in ("state", "next_state")}
    actions = {"action": rng.integers(0, N_ACTIONS, shape), "reward": np.zeros(shape, np.float32)}
    flags = {"terminal": np.zeros(shape, np.uint8), "same_trajectory": np.ones(shape, np.float32)}
    replay = {"sampling_probabilities": np.full(BATCH_SIZE, 1 / N_STORED), "indices": np.arange(BATCH_SIZE)}
    agent.replay_elements = images | actions | flags | replay
    agent._sample_from_replay_buffer = lambda: None
    note = "update on a fixed batch, without sampling and priorities: the release lacks its replay buffer, without which it "
    note += (
        "cannot act; SAME padding: 7,744 features instead of 3,136; augmentation; a convolutional transition model, 5 steps"
    )
    return Calls(repeated(dopamine_update(agent)), note=note)


def make_tianshou() -> Calls:
    """Tianshou's Rainbow, with the network of its examples, and a buffer that stores each frame once."""
    from tianshou.algorithm.modelfree.c51 import C51Policy
    from tianshou.algorithm.modelfree.rainbow import RainbowDQN
    from tianshou.algorithm.optim import AdamOptimizerFactory
    from tianshou.data import Batch, Collector, PrioritizedReplayBuffer
    from tianshou.env.atari.atari_network import RainbowNet, ScaledObsInputActionReprNet

    env, stacks, steps = make_env(stacked=True), stacks_of_frames(), itertools.cycle(range(EPISODE))
    network = ScaledObsInputActionReprNet(RainbowNet(c=N_STACK, h=SIZE, w=SIZE, action_shape=[N_ACTIONS]))
    policy = C51Policy(model=network, action_space=env.action_space, observation_space=env.observation_space)
    optim = AdamOptimizerFactory(lr=LEARNING_RATE)
    agent = RainbowDQN(policy=policy, optim=optim, gamma=GAMMA, n_step_return_horizon=N_STEP, target_update_freq=500)
    one_frame = {"stack_num": N_STACK, "ignore_obs_next": True, "save_only_last_obs": True}
    buffer = PrioritizedReplayBuffer(N_STORED, alpha=0.5, beta=0.4, **one_frame)
    policy.is_within_training_step = True  # which the trainer sets
    collector = Collector(agent, env, buffer, exploration_noise=True)
    collector.reset()
    collector.collect(n_step=N_STORED)

    def add() -> None:
        i = next(steps)
        done = i == EPISODE - 1
        buffer.add(
            Batch(obs=stacks[i], obs_next=stacks[i + 1], act=1, rew=0.0, terminated=done, truncated=False, info={"env_id": 0})
        )

    def sample() -> None:
        batch, indices = buffer.sample(BATCH_SIZE)
        agent._preprocess_batch(batch, buffer, indices)  # n-step returns

    update, act = partial(agent.update, buffer, BATCH_SIZE), lambda n: collector.collect(n_step=n)
    return Calls(repeated(update), repeated(add), repeated(sample), act, reachable_bytes(buffer) / N_STORED)


def make_pfrl() -> Calls:
    """PFRL's Rainbow, as in its examples."""
    import pfrl
    import torch as th
    from pfrl.replay_buffer import batch_experiences
    from pfrl.wrappers.atari_wrappers import LazyFrames

    network = pfrl.q_functions.DistributionalDuelingDQN(N_ACTIONS, 51, -10, 10)
    pfrl.nn.to_factorized_noisy(network, sigma_scale=0.5)
    buffer = pfrl.replay_buffers.PrioritizedReplayBuffer(N_STORED, alpha=0.5, beta0=0.4, num_steps=N_STEP)

    def phi(stack: Any) -> np.ndarray:
        return np.asarray(stack, dtype=np.float32) / 255

    optimizer, explorer = th.optim.Adam(network.parameters(), LEARNING_RATE), pfrl.explorers.Greedy()
    agent = pfrl.agents.CategoricalDoubleDQN(
        network, optimizer, buffer, GAMMA, explorer, replay_start_size=N_STORED, update_interval=10**9,
        target_update_interval=10**9, minibatch_size=BATCH_SIZE, phi=phi,
    )  # fmt: skip
    frames, steps = [new_frame()[None] for _ in range(N_STACK)], itertools.count(1)

    def following(frame: np.ndarray) -> tuple[Any, Any, bool]:
        before = LazyFrames(list(frames), stack_axis=0)
        frames[:] = [*frames[1:], frame[None]]
        return before, LazyFrames(list(frames), stack_axis=0), next(steps) % EPISODE == 0

    def add(frame: np.ndarray | None = None) -> None:
        before, after, done = following(FRAMES[0] if frame is None else frame)
        buffer.append(before, 1, 0.0, after, None, done)

    def step() -> None:
        before, after, done = following(FRAMES[0])
        agent.act(before)
        agent.observe(after, 0.0, done, False)

    def sample() -> None:
        batch_experiences(buffer.sample(BATCH_SIZE), agent.device, phi, GAMMA)
        buffer.update_errors([1.0] * BATCH_SIZE)

    for _ in range(N_STORED + EPISODE):
        add(new_frame())
    nbytes = reachable_bytes(buffer.memory) / len(buffer)
    note = "sample includes new priorities, without which the buffer refuses to be sampled again"
    update = repeated(lambda: agent.update(buffer.sample(BATCH_SIZE)))
    return Calls(update, repeated(add), repeated(sample), repeated(step), nbytes, note)


def make_torchrl() -> Calls:
    """TorchRL's replay buffer, prioritised if its compiled part fits the installed PyTorch."""
    import torch as th
    from tensordict import TensorDict
    from torchrl.data import LazyTensorStorage, TensorDictPrioritizedReplayBuffer, TensorDictReplayBuffer

    storage, note = LazyTensorStorage(N_STORED), "buffer only, which stores both stacks; "
    try:
        buffer = TensorDictPrioritizedReplayBuffer(alpha=0.5, beta=0.4, storage=storage, batch_size=BATCH_SIZE)
    except RuntimeError:
        buffer = TensorDictReplayBuffer(storage=storage, batch_size=BATCH_SIZE)
        note += "uniform sampling: the compiled priorities of this release need another PyTorch"
    stacks, steps = th.as_tensor(stacks_of_frames()), itertools.cycle(range(EPISODE))

    def add() -> None:
        i = next(steps)
        after = {"pixels": stacks[i + 1], "reward": th.zeros(1), "done": th.tensor([i == EPISODE - 1])}
        buffer.add(TensorDict({"pixels": stacks[i], "action": th.tensor(1), "next": after}))

    repeated(add)(N_STORED)
    nbytes = sum(tensor.nbytes for tensor in storage[:].values(True, True)) / N_STORED
    return Calls(None, repeated(add), repeated(buffer.sample), None, nbytes, note)


class Peer(NamedTuple):
    """A row of the table. ``forward``, ``trained``: images per update that pass the convolutions without and with gradient."""

    make: Callable[[], Calls]
    packages: tuple[str, ...]  # whose versions are shown
    environment: str | None = None  # None: that of this package
    n_step: int | None = None
    forward: int | None = None
    trained: int | None = None


OFF = "EqRRainbow, group and losses off"
PEERS = {
    "SB3 DQN": Peer(partial(make_stable, "DQN"), ("stable_baselines3", "torch"), None, 1, 32, 32),
    "sb3-contrib QRDQN": Peer(partial(make_stable, "QRDQN"), ("sb3_contrib", "torch"), None, 1, 32, 32),
    "EqRRainbow": Peer(partial(make_stable, "EqRRainbow"), ("sb3_eqr", "torch"), None, N_STEP, 192, 32),
    OFF: Peer(partial(make_stable, OFF), ("sb3_eqr", "torch"), None, N_STEP, 32, 32),
    "SBX DQN": Peer(make_sbx, ("sbx-rl", "jax"), "sbx", 1, 32, 32),
    "Dopamine Rainbow": Peer(make_dopamine_rainbow, ("dopamine-rl", "jax"), "dopamine", N_STEP, 64, 32),
    "Dopamine SPR": Peer(make_dopamine_spr, ("dopamine-rl", "jax"), "dopamine", N_STEP, 224, 32),
    "tianshou Rainbow": Peer(make_tianshou, ("tianshou", "torch"), "tianshou", N_STEP, 64, 32),
    "PFRL Rainbow": Peer(make_pfrl, ("pfrl", "torch"), "pfrl", N_STEP, 64, 32),
    "TorchRL buffer": Peer(make_torchrl, ("torchrl", "torch"), "torchrl", 1),
}


def version(package: str) -> str:
    """:return: name and version; a checkout that is not installed has none"""
    try:
        return f"{package} {importlib.metadata.version(package)}"
    except importlib.metadata.PackageNotFoundError:
        return package


def timed(call: Callable[[int], object], n: int) -> list[float]:
    """:return: seconds of wall-clock time and of CPU time over all threads, for each of ``n``"""
    start = time.perf_counter(), time.process_time()
    call(n)
    return [(time.perf_counter() - start[0]) / n, (time.process_time() - start[1]) / n]


def main() -> None:
    """Make the peer, warm it up, print what it is; then measure a round for each line of the standard input."""
    name, n_threads = sys.argv[1], int(sys.argv[2])
    if hasattr(os, "sched_setaffinity"):  # before JAX is imported: it starts a thread for each core
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:n_threads])
    with contextlib.redirect_stdout(sys.stderr):
        peer = PEERS[name]
        calls = peer.make()
        counts = {}
        for key, most in COUNTS.items():
            if (call := getattr(calls, key)) is not None:
                call(2)  # compiles
                seconds = min(timed(call, n)[0] for n in (1, 10))  # the start of a call may take longer than its steps
                counts[key] = int(np.clip(LONGEST / seconds, 1, most))
    about = {"version": ", ".join(map(version, peer.packages)), "note": calls.note, "counts": counts}
    print(json.dumps({**about, "bytes_per_transition": calls.bytes_per_transition}), flush=True)
    for _ in sys.stdin:
        with contextlib.redirect_stdout(sys.stderr):
            gc.collect()
            found = {key: timed(getattr(calls, key), n) for key, n in counts.items()}
        print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
