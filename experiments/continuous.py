"""
EqRSAC against SB3's SAC: the gate, the comparison, and short runs with small networks. The plans, each older than its first
run, are in experiments/settings/continuous/README.md.

    python -m experiments.continuous train runs/continuous --tasks Ant-v5 --arms sac eqr_sac --seeds 0
    python -m experiments.continuous train runs/short --short --tasks HalfCheetah-v5 --arms sac eqr_sac --seeds 200
    python -m experiments.continuous time
    python -m experiments.continuous still
    python -m experiments.continuous report docs/results/continuous_gate.xz
"""

import argparse
import json
import lzma
import pathlib
import shutil
import time
from collections.abc import Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch as th
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN, create_mlp
from stable_baselines3.common.type_aliases import ReplayBufferSamples, Schedule
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import nn

from experiments import markdown
from experiments.tables import PARTS, area, difference, draw, mean_and_error
from sb3_eqr import EqRSAC, EqRTQC
from sb3_eqr.benchmark.training import load_checkpoint
from sb3_eqr.common.augmentations import random_shift
from sb3_eqr.common.saving.checkpoints import find_checkpoints, write_checkpoint
from sb3_eqr.common.saving.files import atomic_write

PIXELS, N_TORQUES, SHIFT = "PixelPendulum-v0", 201, 3  # EqRSAC shifts images of 48 pixels by up to 3
NOISE, N_NOISE = "+noise", 20  # what the name of a task ends with that has as many dimensions more
COMPARED = ["HalfCheetah-v5", "Walker2d-v5", "Hopper-v5", "Ant-v5", "Humanoid-v5"]
TASKS = [*COMPARED, "HalfCheetah-v5+noise", PIXELS]
N_STEPS, N_SHORT, N_RANDOM_SHORT, N_BETWEEN, N_GREEDY = 100_000, 12_000, 2_000, 10_000, 10
ZOO: dict[str, Any] = {"learning_starts": 10_000, "buffer_size": N_STEPS}  # RL Zoo's; the rest are SB3's defaults
SHORT: dict[str, Any] = {"learning_starts": N_RANDOM_SHORT, "buffer_size": N_SHORT, "learning_rate": 1e-3, "batch_size": 64}
SHORT_NETWORK = {"net_arch": [128, 128]}
OTHERS = {
    **dict.fromkeys(("sac", "sac_layer_norm", "sac_two_updates", "sac_shift", "drq"), SAC),
    **{"tqc": TQC, "crossq": CrossQ, "eqr_tqc": EqRTQC, "none_tqc": EqRTQC},
}


class ShiftedReplay(ReplayBuffer):
    """SB3's replay buffer, whose images are shifted at random when they are sampled, as in DrQ."""

    def _get_samples(self, *args: Any, **kwargs: Any) -> ReplayBufferSamples:
        batch = super()._get_samples(*args, **kwargs)
        shifted = {name: random_shift(getattr(batch, name), SHIFT) for name in ("observations", "next_observations")}
        return batch._replace(**shifted)


class DrQEncoder(NatureCNN):
    """SB3's convolutions, with 50 features after layer norm and tanh, as in DrQ (Kostrikov et al. 2021, appendix B)."""

    def __init__(self, observation_space: gym.spaces.Box):
        super().__init__(observation_space, features_dim=50)
        self.linear[1] = nn.Sequential(nn.LayerNorm(50), nn.Tanh())


class Detached(BaseFeaturesExtractor):
    """Features of another extractor, without gradient."""

    def __init__(self, extractor: BaseFeaturesExtractor):
        super().__init__(extractor._observation_space, extractor.features_dim)
        self.extractor = extractor

    def forward(self, observations: th.Tensor) -> th.Tensor:
        with th.no_grad():
            return self.extractor(observations)


class OneEncoderPolicy(SACPolicy):
    """SAC's policy with one encoder for actor and critics, which only the critics train, as in DrQ."""

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)  # the actor's optimiser keeps its first encoder, which no gradient reaches from here on
        self.actor.features_extractor = Detached(self.critic.features_extractor)


def first_version(group: str) -> dict[str, Any]:
    """Arguments of EqRSAC as it was at first: actor and critics also read h(s), and the latent model has larger batches."""
    return {"policy_kwargs": {"group": group, "reads_features": True}, "latent_batch_size": None}


# name -> arguments of these, or of EqRSAC; packed runs have more arms
ARMS: dict[str, dict[str, Any]] = {
    **{name: {} for name in OTHERS},
    "sac_two_updates": {"gradient_steps": 2},
    "sac_shift": {"replay_buffer_class": ShiftedReplay},
    "drq": {"replay_buffer_class": ShiftedReplay, "policy_kwargs": {"features_extractor_class": DrQEncoder}},
    "eqr_sac": {},
    "no_losses": {"prediction_depth": 0},
    "none": first_version("none(72)"),
    "none_tqc": first_version("none(72)"),
    "none_no_losses": {**first_version("none(72)"), "prediction_depth": 0},
    "se2": first_version("SE(2)"),  # 12 blocks have as many numbers
    "t72": first_version("T(72)^1"),  # as many, without rotation
}


class LayerNormPolicy(SACPolicy):
    """SAC's policy with layer norm after each hidden linear layer of actor and critics."""

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        actor, arch = super().make_actor(features_extractor), cast(list[int], self.actor_kwargs["net_arch"])
        actor.latent_pi = nn.Sequential(*create_mlp(actor.features_dim, -1, arch, nn.ReLU, post_linear_modules=[nn.LayerNorm]))
        return actor

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        critic, arch = super().make_critic(features_extractor), cast(list[int], self.critic_kwargs["net_arch"])
        first: Any = critic.q_networks[0]
        for i in range(critic.n_critics):
            made = nn.Sequential(*create_mlp(first[0].in_features, 1, arch, nn.ReLU, post_linear_modules=[nn.LayerNorm]))
            critic.q_networks[i] = made
            setattr(critic, f"qf{i}", made)
        return critic


POLICIES = {"sac_layer_norm": LayerNormPolicy, "drq": OneEncoderPolicy}


class Episodes(BaseCallback):
    """
    Collect the step, return and length of each training episode, and the CPU seconds, as attributes of the model; write
    checkpoints into a folder.
    """

    model: Any

    def __init__(self, folder: pathlib.Path):
        super().__init__()
        self.folder = folder

    def _on_rollout_start(self) -> None:
        if self.num_timesteps and self.num_timesteps % N_BETWEEN == 0:
            write_checkpoint(self.folder, self.model)

    def _on_training_start(self) -> None:
        if not hasattr(self.model, "episodes"):
            self.model.episodes, self.model.seconds = {"step": [], "score": [], "length": []}, 0.0
        self._start = time.process_time() - self.model.seconds  # those of a run that was resumed count

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                episode = {"step": self.num_timesteps, "score": info["episode"]["r"], "length": info["episode"]["l"]}
                for name, value in episode.items():
                    self.model.episodes[name].append(round(float(value), 2))
        self.model.seconds = time.process_time() - self._start
        return True


class Noise(gym.ObservationWrapper):
    """Adds independent standard normal numbers to observations, which no action changes."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        (size,) = env.observation_space.shape  # type: ignore[misc]
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (size + N_NOISE,))

    def observation(self, observation: np.ndarray) -> np.ndarray:
        return np.concatenate([observation, self.np_random.standard_normal(N_NOISE)]).astype(np.float32)


def make_env(task: str) -> gym.Env:
    """The environment; the torque of the pendulum from pixels is made continuous, to 1%."""
    if task.endswith(NOISE):
        return Noise(gym.make(task.removesuffix(NOISE)))
    if task != PIXELS:
        return gym.make(task)
    torque = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    return gym.wrappers.TransformAction(gym.make(task, n_torques=N_TORQUES), nearest_torque, torque)


def nearest_torque(action: np.ndarray) -> int:
    """The number of the torque that is nearest to a share of the largest one, (1,), in [-1, 1]."""
    return round((float(action[0]) + 1) / 2 * (N_TORQUES - 1))


def make_agent(arm: str, task: str, seed: int, is_short: bool) -> SAC | TQC | CrossQ:
    """An agent at RL Zoo's settings, or with small networks that learn in short runs."""
    given = dict(ARMS[arm])
    kwargs = {**(SHORT_NETWORK if is_short else {}), **given.pop("policy_kwargs", {})}
    shared = {**(SHORT if is_short else ZOO), "seed": seed, "device": "cpu", "policy_kwargs": kwargs}
    policy, env = "CnnPolicy" if task == PIXELS else "MlpPolicy", make_env(task)
    return OTHERS.get(arm, EqRSAC)(POLICIES.get(arm, policy), env, **given, **shared)


def train(
    folder: pathlib.Path, tasks: Sequence[str], arms: Sequence[str], seeds: Sequence[int], is_short: bool, steps: int | None
) -> None:
    """Run what is not in the folder, seed by seed, task by task, arm by arm. Runs can be stopped at any time."""
    steps = steps or (N_SHORT if is_short else N_STEPS)
    for seed, task, arm in ((seed, task, arm) for seed in seeds for task in tasks for arm in arms):
        file = folder / f"{arm}-{task}-{seed}.json"
        if file.exists():
            if (there := json.loads(file.read_text())["steps"]) != steps:
                raise ValueError(f"{file} must have {steps} steps, got {there}. Use a folder for each number of steps.")
            continue
        model: Any = make_agent(arm, task, seed, is_short)
        checkpoints = file.with_suffix("")
        if found := find_checkpoints(checkpoints):
            model, *_ = load_checkpoint(found[-1], model)
        begins = model.num_timesteps == 0
        model.learn(steps - model.num_timesteps, callback=Episodes(checkpoints), reset_num_timesteps=begins)
        model.save(file.with_suffix(".zip"))  # for sb3-eqr visualize
        tests = make_vec_env(lambda task=task: make_env(task), seed=N_STEPS)  # type: ignore[misc]
        greedy, _ = evaluate_policy(model, tests, n_eval_episodes=N_GREEDY, return_episode_rewards=True)
        run = {"arm": arm, "task": task, "seed": seed, "steps": steps, "seconds": round(model.seconds)}
        run |= {"torch": th.__version__, "greedy": greedy, "training": model.episodes}
        with atomic_write(file, "json") as out:
            out.write(json.dumps(run).encode())
        shutil.rmtree(checkpoints, ignore_errors=True)
        print(task, arm, seed, round(area(run)), f"{run['seconds']} s", flush=True)


def time_steps(task: str, arms: Sequence[str], rounds: int, is_short: bool) -> str:
    """Milliseconds of a step of learning of each arm, in turns: medians over rounds, and of the ratios to the first arm."""
    agents, n_steps = [make_agent(arm, task, 0, is_short) for arm in arms], 100
    for agent in agents:
        agent.learning_starts = 1_000
        agent.learn(1_100)
    times = np.empty((rounds, len(arms)))
    for i, k in np.ndindex(times.shape):
        started = time.perf_counter()
        agents[k].learn(n_steps, reset_num_timesteps=False)
        times[i, k] = (time.perf_counter() - started) / n_steps * 1_000
    milliseconds, ratios = np.median(times, axis=0), np.median(times / times[:, :1], axis=0)
    table = [[arm, f"{time:.1f}", f"{ratio:.2f}"] for arm, time, ratio in zip(arms, milliseconds, ratios, strict=True)]
    return markdown(["arm", "ms per step", f"times {arms[0]}"], table)


def still(n_episodes: int = 20) -> str:
    """Mean return of the action 0, episodes weighted by their lengths, as in ``area``."""
    table = []
    for task in COMPARED:
        env, returns = gym.make(task), []
        action = np.zeros(env.action_space.shape or (), np.float32)
        for seed in range(n_episodes):
            env.reset(seed=seed)
            rewards, is_over = [], False
            while not is_over:
                _, reward, terminated, truncated, _ = env.step(action)
                rewards.append(float(reward))
                is_over = terminated or truncated
            returns.append([sum(rewards), len(rewards)])
        scores, lengths = np.transpose(returns)
        table.append([task, f"{np.average(scores, weights=lengths):.0f}", f"{np.mean(lengths):.0f}"])
    return markdown(["task", "return", "steps"], table)


def read(paths: Sequence[pathlib.Path]) -> dict[tuple[str, str], dict[int, dict[str, Any]]]:
    """Runs by seed by (task, arm), from folders of ``train`` and packed files; of equal names, the last one."""
    runs: dict[tuple[str, str], dict[int, dict[str, Any]]] = {}
    for path in paths:
        texts = [file.read_text() for file in sorted(path.glob("*.json"))] if path.is_dir() else lzma.open(path, "rt")
        for run in map(json.loads, texts):
            runs.setdefault((run["task"], run["arm"]), {})[run["seed"]] = run
    return runs


def report(
    runs: dict[tuple[str, str], dict[int, dict[str, Any]]],
    baseline: str,
    after: int,
    cost: float,
    until: int = N_STEPS,
    is_greedy: bool = False,
) -> str:
    """
    Areas by task and arm, the difference from the baseline's with Welch's interval; ratios to the baseline's, geometric mean
    over tasks with positive areas, bootstrap interval over seeds, which is too narrow for few. The areas of all but the
    baseline end after 1 / ``cost`` of the steps, and all at ``until``. With ``is_greedy``, areas are replaced by the mean
    return after training, without exploration noise.
    """
    seconds = {key: float(min(run["seconds"] for run in of_key.values())) for key, of_key in runs.items()}
    areas: dict[tuple[str, str], np.ndarray] = {}
    for key, of_key in runs.items():
        share = 1.0 if key[1] == baseline else 1 / cost
        found = [
            np.mean(run["greedy"]) if is_greedy else area(run, after, min(share * run["steps"], until))
            for run in of_key.values()
        ]
        areas[key] = np.array(found)
    tasks = [task for task in TASKS if (task, baseline) in areas]
    table, rng = [], np.random.default_rng(0)
    for arm in dict.fromkeys(arm for _, arm in areas):
        cells, ratios = [], []
        for task in tasks:
            values, of_baseline = areas.get((task, arm)), areas[task, baseline]
            if values is None:
                cells.append("")
                continue
            gain = "" if arm == baseline else difference(values, of_baseline)
            cells.append(f"{mean_and_error(values)}{gain}, {len(values)} seeds, {seconds[task, arm] / 60:.1f} min")
            pair = values, of_baseline
            if min(values.mean(), of_baseline.mean()) <= 0:
                continue  # a ratio would say nothing
            draws = [sample[rng.integers(len(sample), size=(10_000, len(sample)))].mean(axis=1) for sample in pair]
            ratios.append(np.append(draws[0] / draws[1], values.mean() / of_baseline.mean()))
        shown = ""
        if ratios:
            mean = np.exp(np.mean(np.log(np.maximum(ratios, 1e-3)), axis=0))
            low, high = np.percentile(mean[:-1], [2.5, 97.5])
            has_interval = min(len(areas[task, arm]) for task in tasks if (task, arm) in areas) > 1
            interval = f" [{low:.2f}, {high:.2f}]" if has_interval else ""
            shown = f"{mean[-1]:.2f}{interval}, {len(ratios)} tasks"
        if any(cells):
            table.append([arm, *cells, shown])
    return markdown(["arm", *tasks, f"ratio to {baseline}, geometric mean"], table)


def rows(runs: dict[tuple[str, str], dict[int, dict[str, Any]]], arms: Sequence[str]) -> list[dict[str, Any]]:
    """The runs of these arms as rows for ``experiments.tables``, with the area of each tenth."""
    found = []
    for arm, task in ((arm, task) for arm in arms for task in TASKS):
        for run in runs.get((task, arm), {}).values():
            tenth = run["steps"] // PARTS
            areas = [area(run, start, start + tenth) for start in range(0, run["steps"], tenth)]
            row = {"agent": arm, "game": task, "seed": run["seed"], "tenths": {"return": areas}}
            found.append({**row, "protocol": {"steps": run["steps"]}})
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    running = commands.add_parser("train", help="run what is not in the folder yet")
    running.add_argument("folder", type=pathlib.Path)
    running.add_argument("--tasks", nargs="+", default=COMPARED)
    running.add_argument("--arms", nargs="+", default=["sac", "eqr_sac"], choices=list(ARMS))
    running.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    running.add_argument("--short", action="store_true", help=f"{N_SHORT:,} steps with small networks")
    running.add_argument("--steps", type=int, help="stop after so many steps; a folder of its own is needed")
    timing = commands.add_parser("time", help="compare the time of a step of learning")
    timing.add_argument("--task", default=TASKS[0])
    timing.add_argument("--arms", nargs="+", default=["sac", "eqr_sac", "none", "se2"], choices=list(ARMS))
    timing.add_argument("--rounds", type=int, default=10)
    timing.add_argument("--short", action="store_true", help="with small networks")
    commands.add_parser("still", help="print the returns of the action 0")
    reporting = commands.add_parser("report", help="print the table")
    reporting.add_argument("paths", nargs="+", type=pathlib.Path, help="folders of train, or packed files")
    reporting.add_argument("--figure", type=pathlib.Path, help="also draw the returns of --drawn and sac into this file")
    reporting.add_argument("--drawn", default="eqr_sac", help="an arm of EqRSAC")
    reporting.add_argument("--to", default="sac", help="the arm whose area is 1")
    reporting.add_argument("--seeds", nargs="+", type=int, help="only these, of all arms")
    reporting.add_argument("--after", type=int, default=0, help="count episodes that end after this step")
    reporting.add_argument("--until", type=int, default=N_STEPS, help="count episodes that end until this step")
    reporting.add_argument(
        "--cost", type=float, default=1.0, help="compare in the same time, if a step takes so many times as long as that arm's"
    )
    reporting.add_argument("--greedy", action="store_true", help="compare returns after training, without exploration noise")
    reporting.add_argument("--pack", type=pathlib.Path, help="also write all runs into this file, packed by xz")
    args = parser.parse_args()
    if args.command == "train":
        args.folder.mkdir(parents=True, exist_ok=True)
        train(args.folder, args.tasks, args.arms, args.seeds, args.short, args.steps)
        return
    if args.command == "time":
        print(time_steps(args.task, args.arms, args.rounds, args.short))
        return
    if args.command == "still":
        print(still())
        return
    runs = read(args.paths)
    if args.pack is not None:
        lines = [json.dumps(run) + "\n" for key in sorted(runs) for _, run in sorted(runs[key].items())]
        with atomic_write(args.pack, "xz") as out:
            out.write(lzma.compress("".join(lines).encode()))
    if args.seeds is not None:
        runs = {key: {seed: run for seed, run in found.items() if seed in args.seeds} for key, found in runs.items()}
    if args.greedy:  # older runs were not evaluated
        runs = {key: {seed: run for seed, run in found.items() if "greedy" in run} for key, found in runs.items()}
    runs = {key: found for key, found in runs.items() if found}
    if args.to not in (arms := sorted({arm for _, arm in runs})):
        parser.error(f"--to must be one of {arms}, got {args.to!r}")
    if args.figure is not None:
        label = {"eqr_sac": "EqRSAC", "none": "EqRSAC, first version"}.get(args.drawn, args.drawn)
        draw(rows(runs, [args.drawn, "sac"]), "return", args.figure, [label, "SAC"])
    print(report(runs, args.to, args.after, args.cost, args.until, args.greedy))


if __name__ == "__main__":
    main()
