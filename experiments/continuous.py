"""
The gate of an agent for continuous actions: does a latent model make SB3's SAC learn faster? The plan, which is older than the
first run, is experiments/settings/continuous/README.md.

    python -m experiments.continuous train runs/gate --tasks HalfCheetah-v5 --arms sac se2 --seeds 0
    python -m experiments.continuous report docs/results/continuous_gate.xz
"""

import argparse
import json
import lzma
import pathlib
import time
from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import nn

from experiments.tables import draw
from sb3_eqr import SequenceReplayBuffer
from sb3_eqr.common.groups import NoGroup
from sb3_eqr.common.groups.layer import GroupLayer
from sb3_eqr.common.latent.latent_model import LatentModel, frozen_copy
from sb3_eqr.common.latent.options import LatentOptions
from sb3_eqr.common.saving.files import atomic_write

TASKS = ["HalfCheetah-v5", "Walker2d-v5", "Hopper-v5", "Ant-v5"]
N_STEPS, WIDTH, DEPTH, TAU = 100_000, 256, 2, 0.005
SE2 = {"group": "SE(2)", "n_blocks": 12}
NONE = {"group": NoGroup(72), "n_blocks": 1}  # the same size of the latent state
# name -> arguments of LatentPolicy, None without a latent model
ARMS: dict[str, dict[str, Any] | None] = {
    "sac": None,
    "se2": {"latent": SE2},
    "none": {"latent": NONE},
    "se2_td": {"latent": SE2, "td_gradient": True},
    "se2_td_no_losses": {"latent": SE2, "td_gradient": True, "losses": False},
    "sac_layer_norm": None,
}


class Latent(nn.Module):
    """φ, x = τ(s), and the latent model: everything that the auxiliary losses train."""

    def __init__(self, n_observed: int, action_dim: int, group: Any, n_blocks: int):
        super().__init__()
        self.encoder = nn.Sequential(
            nn.Linear(n_observed, WIDTH), nn.LayerNorm(WIDTH), nn.ELU(), nn.Linear(WIDTH, WIDTH), nn.LayerNorm(WIDTH)
        )
        layer = GroupLayer(WIDTH, group, n_blocks)
        options = LatentOptions(group=group, n_blocks=n_blocks)
        self.model = LatentModel(layer, layer.group, n_blocks, action_dim, options)
        self.features_dim = n_observed + WIDTH + layer.state_dim

    def forward(self, observations: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """[s, φ(s), x], (B, features_dim), and x, (B, D), from s."""
        features = self.encoder(observations)
        state = self.model.embedding(features)
        return th.cat([observations, features, state], dim=1), state

    def moved(self, state: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """κ(x, a) · x, (B, D)."""
        return self.model.act(self.model.action_element(state, actions), state)


class Reader(BaseFeaturesExtractor):
    """What the actor reads, without gradient."""

    def __init__(self, observation_space: gym.Space, latent: Latent):
        super().__init__(observation_space, latent.features_dim)
        self.latent = [latent]  # in a list: it belongs to the policy

    def forward(self, observations: th.Tensor) -> th.Tensor:
        with th.no_grad():
            return self.latent[0](observations)[0]


class LatentCritic(ContinuousCritic):
    """Q(s, a, φ(s), x, κ(x, a) · x). The gradient for the action also passes κ."""

    latent: list[Latent]
    td_gradient = False

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        latent = self.latent[0]
        with nullcontext() if self.td_gradient else th.no_grad():
            features, state = latent(obs.float())
        inputs = th.cat([features, actions, latent.moved(state, actions)], dim=1)
        return tuple(q_net(inputs) for q_net in self.q_networks)


class LatentPolicy(SACPolicy):
    """
    SAC's policy, whose networks read a latent state. Without ``td_gradient``, all of them read the moving average of the
    latent model, which only the auxiliary losses train. With it, the critics' loss trains the online one, which the critics
    and the actor read, and the target critics read the moving average.
    """

    def __init__(self, *args: Any, latent: dict[str, Any], td_gradient: bool = False, losses: bool = True, **kwargs: Any):
        self.latent_kwargs, self.td_gradient, self.has_losses = latent, td_gradient, losses
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Any) -> None:
        shapes = self.observation_space.shape[0], self.action_space.shape[0]  # type: ignore[index]
        self.latent = Latent(*shapes, **self.latent_kwargs)
        self.latent_target = frozen_copy(self.latent)
        super()._build(lr_schedule)
        self.latent_optimizer = th.optim.Adam(self.latent.parameters(), lr=lr_schedule(1))
        if self.td_gradient:
            self.critic.latent, self.critic.td_gradient = [self.latent], True  # type: ignore[assignment]
            self.critic.optimizer.add_param_group({"params": list(self.latent.parameters())})

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        read = self.latent if self.td_gradient else self.latent_target
        return super().make_actor(Reader(self.observation_space, read))

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        reader = Reader(self.observation_space, self.latent_target)
        kwargs = self._update_features_extractor(self.critic_kwargs, reader)
        kwargs["features_dim"] += self.latent.model.state_dim
        critic = LatentCritic(**kwargs)
        critic.latent = [self.latent_target]
        return critic


class LayerNormPolicy(SACPolicy):
    """SAC's policy with layer norm after each hidden linear layer."""

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        actor = super().make_actor(features_extractor)
        arch: Any = self.actor_kwargs["net_arch"]
        actor.latent_pi = nn.Sequential(*create_mlp(actor.features_dim, -1, arch, nn.ReLU, post_linear_modules=[nn.LayerNorm]))
        return actor

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        critic = super().make_critic(features_extractor)
        first: Any = critic.q_networks[0]
        arch: Any = self.critic_kwargs["net_arch"]
        for i in range(critic.n_critics):
            made = nn.Sequential(*create_mlp(first[0].in_features, 1, arch, nn.ReLU, post_linear_modules=[nn.LayerNorm]))
            critic.q_networks[i] = made
            setattr(critic, f"qf{i}", made)
        return critic


class LatentSAC(SAC):
    """SAC that trains the latent model of its policy by AET and reward loss, one update before each of its own."""

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        for step in range(gradient_steps):
            if (self._n_updates + step) % 1000 == 0:
                buffer: Any = self.replay_buffer
                self.reward_scale = float(buffer.rewards[: buffer.size()].std()) + 1e-6
            self._update_latent(batch_size)
            super().train(1, batch_size)

    def _update_latent(self, batch_size: int) -> None:
        policy: Any = self.policy
        latent, target = policy.latent, policy.latent_target
        if policy.has_losses:
            samples: Any = self.replay_buffer.sample(batch_size)  # type: ignore[union-attr]
            with th.no_grad():
                wanted = target.encoder(samples.rollout_observations.flatten(0, 1).float())
            features, rewards = latent.encoder(samples.observations.float()), samples.rollout_rewards / self.reward_scale
            names, actions = ["aet", "reward"], samples.rollout_actions
            losses = latent.model(names, features, actions, rewards, samples.mask, target.model, None, wanted)
            policy.latent_optimizer.zero_grad()
            sum(losses.values()).mean().backward()
            policy.latent_optimizer.step()
        polyak_update(latent.parameters(), target.parameters(), TAU)


class Episodes(BaseCallback):
    """Collect the step, return and length of each training episode."""

    def __init__(self) -> None:
        super().__init__()
        self.found: dict[str, list[float]] = {"step": [], "score": [], "length": []}

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                self.found["step"].append(self.num_timesteps)
                self.found["score"].append(info["episode"]["r"])
                self.found["length"].append(info["episode"]["l"])
        return True


def make_agent(arm: str, task: str, seed: int) -> SAC:
    """SAC at RL Zoo's settings (learning_starts; the rest are SB3's defaults), or one that has a latent model."""
    shared: dict[str, Any] = {"learning_starts": 10_000, "buffer_size": N_STEPS, "seed": seed, "device": "cpu"}
    if ARMS[arm] is None:
        return SAC(LayerNormPolicy if arm == "sac_layer_norm" else "MlpPolicy", task, **shared)
    shared |= {"replay_buffer_class": SequenceReplayBuffer, "replay_buffer_kwargs": {"prediction_depth": DEPTH}}
    return LatentSAC(LatentPolicy, task, policy_kwargs=dict(ARMS[arm] or {}), **shared)


def train(folder: pathlib.Path, tasks: Sequence[str], arms: Sequence[str], seeds: Sequence[int], steps: int) -> None:
    """Run what is not in the folder, seed by seed, task by task, arm by arm."""
    for seed, task, arm in ((seed, task, arm) for seed in seeds for task in tasks for arm in arms):
        file = folder / f"{arm}-{task}-{seed}.json"
        if file.exists():
            continue
        started, episodes = time.perf_counter(), Episodes()
        make_agent(arm, task, seed).learn(steps, callback=episodes)
        run = {"arm": arm, "task": task, "seed": seed, "steps": steps, "seconds": round(time.perf_counter() - started)}
        found = {name: [round(float(value), 2) for value in values] for name, values in episodes.found.items()}
        with atomic_write(file, "json") as out:
            out.write(json.dumps({**run, "torch": th.__version__, "training": found}).encode())
        print(task, arm, seed, round(area(found)), f"{run['seconds']} s", flush=True)


def area(training: dict[str, list[float]]) -> float:
    """The mean return in training over steps: each finished episode weighs as many steps as it has."""
    return float(np.average(training["score"], weights=training["length"]))


def read(paths: Sequence[pathlib.Path]) -> dict[tuple[str, str], dict[int, dict[str, Any]]]:
    """Runs by seed by (task, arm), from folders of ``train`` and packed files."""
    runs: dict[tuple[str, str], dict[int, dict[str, Any]]] = {}
    for path in paths:
        texts = [file.read_text() for file in sorted(path.glob("*.json"))] if path.is_dir() else lzma.open(path, "rt")
        for run in map(json.loads, texts):
            runs.setdefault((run["task"], run["arm"]), {})[run["seed"]] = run
    return runs


def report(runs: dict[tuple[str, str], dict[int, dict[str, Any]]]) -> str:
    """Areas by task and arm, and each arm's ratio to SAC's: per task, and the geometric mean with a bootstrap interval."""
    areas = {key: np.array([area(run["training"]) for run in of_key.values()]) for key, of_key in runs.items()}
    tasks = [task for task in TASKS if (task, "sac") in areas]
    lines = ["| arm | " + " | ".join(tasks) + " | ratio to SAC's, geometric mean |", "|---" * (len(tasks) + 2) + "|"]
    rng = np.random.default_rng(0)
    for arm in ARMS:
        cells, ratios = [], []
        for task in tasks:
            values, of_sac = areas.get((task, arm)), areas[task, "sac"]
            if values is None:
                cells.append("")
                continue
            error = f" ± {values.std(ddof=1) / len(values) ** 0.5:,.0f}" if len(values) > 1 else ""
            minutes = np.mean([run["seconds"] for run in runs[task, arm].values()]) / 60
            cells.append(f"{values.mean():,.0f}{error} ({len(values)}; {minutes:.0f} min)")
            draws = [sample[rng.integers(len(sample), size=(10_000, len(sample)))].mean(axis=1) for sample in (values, of_sac)]
            ratios.append(np.append(draws[0] / draws[1], values.mean() / of_sac.mean()))
        mean = np.exp(np.mean(np.log(np.maximum(ratios, 1e-3)), axis=0)) if ratios else [np.nan]
        low, high = np.percentile(mean[:-1], [2.5, 97.5]) if ratios else (np.nan, np.nan)
        lines.append(f"| {arm} | " + " | ".join(cells) + f" | {mean[-1]:.2f} [{low:.2f}, {high:.2f}], {len(ratios)} tasks |")
    return "\n".join(lines)


def rows(runs: dict[tuple[str, str], dict[int, dict[str, Any]]], arms: Sequence[str]) -> list[dict[str, Any]]:
    """The runs of these arms as rows of a benchmark, for ``experiments.tables``."""
    found = [
        run for (_, arm), of_key in sorted(runs.items(), key=lambda item: TASKS.index(item[0][0])) for run in of_key.values()
    ]
    named = {"agent": "arm", "game": "task", "seed": "seed", "training": "training"}
    kept = sorted((run for run in found if run["arm"] in arms), key=lambda run: arms.index(run["arm"]))
    return [{**{key: run[name] for key, name in named.items()}, "protocol": {"steps": run["steps"]}} for run in kept]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    running = commands.add_parser("train", help="run what is not in the folder yet")
    running.add_argument("folder", type=pathlib.Path)
    running.add_argument("--tasks", nargs="+", default=TASKS)
    running.add_argument("--arms", nargs="+", default=list(ARMS), choices=list(ARMS))
    running.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    running.add_argument("--steps", type=int, default=N_STEPS)
    reporting = commands.add_parser("report", help="print the table")
    reporting.add_argument("paths", nargs="+", type=pathlib.Path, help="folders of train, or packed files")
    reporting.add_argument(
        "--figure", type=pathlib.Path, help="also draw the returns of sac and none in training into this file"
    )
    reporting.add_argument("--pack", type=pathlib.Path, help="also write all runs into this file, packed by xz")
    args = parser.parse_args()
    if args.command == "train":
        train(args.folder, args.tasks, args.arms, args.seeds, args.steps)
        return
    runs = read(args.paths)
    if args.pack is not None:
        lines = [json.dumps(run) + "\n" for key in sorted(runs) for _, run in sorted(runs[key].items())]
        with atomic_write(args.pack, "xz") as out:
            out.write(lzma.compress("".join(lines).encode()))
    if args.figure is not None:
        draw(rows(runs, ["none", "sac"]), "return", args.figure, ["SAC with a latent model", "SAC"])
    print(report(runs))


if __name__ == "__main__":
    main()
