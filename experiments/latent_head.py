"""
Does a Q head learn faster that reads [s, φ(s), x] of a moving average, with the encoder trained apart, as the networks of
EqRSAC do? A prototype; the plan, which is older than the runs, is experiments/settings/latent_head.md.

    python -m experiments.latent_head train runs/head.jsonl --tasks LunarLander-v3 --arms head_none off --seeds 200 201
    python -m experiments.latent_head report experiments/settings/latent_head.jsonl.xz
"""

import argparse
import json
import lzma
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, sync_envs_normalization

from experiments import markdown
from experiments.continuous import Episodes
from experiments.tables import area, difference, mean_and_error
from sb3_eqr import EqRQRDQN, load_configuration
from sb3_eqr.common.actor_critic_policies import LatentReader
from sb3_eqr.common.groups.layer import GroupLayer
from sb3_eqr.common.latent.latent_model import LatentModel, frozen_copy
from sb3_eqr.common.networks.encoders import TwoLayerExtractor, make_trunk
from sb3_eqr.common.networks.inputs import Augmentation
from sb3_eqr.common.networks.target_copy import TargetCopy
from sb3_eqr.common.objective import LossTerms, Objective
from sb3_eqr.common.type_aliases import SequenceReplayBufferSamples
from sb3_eqr.eqr_qrdqn.policies import EqRQRDQNPolicy

STEPS = {"LunarLander-v3": 60_000, "Acrobot-v1": 20_000, "MountainCar-v0": 30_000, "CartPole-v1": 10_000}
NORMALIZED = ("MountainCar-v0",)  # tasks whose section in zoo_hyperparams/eqr_qrdqn.yml normalises observations
ARMS = ("head_none", "head_se2", "eqr", "off")
LATENT = {"latent_tau": 0.005, "latent_norm": "layer", "projection": "own", "predictor": True, "parameterization": "euler"}
LOSSES = {"prediction_depth": 2, "aet_coef": 1.0, "reward_coef": 1.0, "symmetry_coef": 0.0}
OTHERS = ("features_extractor_class", "layer_norm", "head_input", "center")  # arguments of policies that have no use here


class LatentHeadPolicy(EqRQRDQNPolicy):
    """EqRQRDQN's policy, whose Q head reads the moving average of an encoder and a latent model that only the losses train."""

    def _build(self, lr_schedule: Any) -> None:
        space, options = self.observation_space, self.options
        self.apart = make_trunk(TwoLayerExtractor, space, {"features_dim": 256}, True, False)
        layer = GroupLayer(self.apart.features_dim, options.group or "none", options.n_blocks)
        self.trained = LatentModel(layer, layer.group, layer.n_blocks, int(self.action_space.n), options)
        averages = frozen_copy(self.apart), frozen_copy(self.trained)
        self.reader = LatentReader(space, *averages, Augmentation(space, True, 0, 0.0))
        super()._build(lr_schedule)
        self.latent_encoder, self.latent_target = averages
        pairs: Any = [(self.apart, self.latent_encoder), (self.trained, self.latent_target)]
        self.latent_target_copy = TargetCopy(pairs)
        self.optimizer.param_groups[0]["params"] += list(self.apart.parameters())

    def make_features_extractor(self) -> LatentReader:  # type: ignore[override]
        return self.reader

    def _make_latent_model(self) -> LatentModel:
        return self.trained

    def after_gradient_step(self) -> None:
        super().after_gradient_step()
        self.reader.forget()


class LatentHeadObjective(Objective):
    """TD loss of what the reader yields, auxiliary losses of the encoder that is trained apart."""

    def __init__(self, policy: Any, **kwargs: Any):
        super().__init__(policy, **kwargs)
        self.apart, self.reader = policy.apart, policy.reader
        self.target_encoder = self.encoder = policy.reader

    def __call__(self, samples: SequenceReplayBufferSamples, coefs: Mapping[str, float]) -> LossTerms:
        observations = self.augment(samples.observations)
        td, priorities, q_values = self.td_loss(samples, self.reader(observations))
        names = [name for name, coef in coefs.items() if coef > 0 and name != "td"]
        losses = {"td": td, **self.latent_losses(names, samples, observations, self.apart(observations))}
        loss = (samples.weights * sum(coefs[name] * loss for name, loss in losses.items())).mean()
        return LossTerms(losses, loss, priorities, q_values)


class LatentHeadQRDQN(EqRQRDQN):
    """EqRQRDQN with these."""

    policy_aliases = {**EqRQRDQN.policy_aliases, "MlpPolicy": LatentHeadPolicy}

    def _set_up_objective(self) -> None:
        self._objective_options, self._captured = self._options_of_objective(), None
        self.objective = LatentHeadObjective(self.policy, **self._objective_options)


def make_env(task: str, n_envs: int, seed: int) -> VecEnv:
    """Environments as that section says."""
    env = make_vec_env(task, n_envs, seed=seed)
    return VecNormalize(env, norm_reward=False) if task in NORMALIZED else env


def make(task: str, arm: str, seed: int) -> EqRQRDQN:
    """An agent with the settings of the task in zoo_hyperparams/eqr_qrdqn.yml, and what the arm changes."""
    off = {"prediction_depth": 0, "policy_kwargs": {"group": None}} if arm == "off" else {}
    settings = load_configuration("eqr_qrdqn", task, **off)
    kind: type[EqRQRDQN] = EqRQRDQN
    if arm.startswith("head"):
        kind, group = LatentHeadQRDQN, {"group": "SE(2)", "n_blocks": 12}
        group = {"group": "none(72)"} if arm == "head_none" else group
        kept = {name: value for name, value in settings["policy_kwargs"].items() if name not in OTHERS}
        settings |= {**LOSSES, "policy_kwargs": {**kept, **LATENT, **group}}
    return kind("MlpPolicy", make_env(task, 1, seed), **settings, seed=seed, device="cpu")


def train(file: pathlib.Path, tasks: list[str], arms: list[str], seeds: list[int]) -> None:
    """Run what is not in the file, seed by seed, task by task, arm by arm."""
    done = {(run["task"], run["arm"], run["seed"]) for run in read(file)}
    for seed, task, arm in ((seed, task, arm) for seed in seeds for task in tasks for arm in arms):
        if (task, arm, seed) in done:
            continue
        model: Any = make(task, arm, seed)
        model.learn(STEPS[task], callback=Episodes())
        score: Any
        eval_env = make_env(task, 10, 10_000 + seed)
        if isinstance(eval_env, VecNormalize):
            eval_env.training = False
            sync_envs_normalization(model.get_env(), eval_env)
        score, _ = evaluate_policy(model, eval_env, 50)
        run = {
            "task": task,
            "arm": arm,
            "seed": seed,
            "score": float(score),
            "cpu_seconds": round(model.seconds),
            "training": model.episodes,
        }
        with file.open("a") as out:
            out.write(json.dumps(run) + "\n")
        print(task, arm, seed, f"score {score:.1f}, in training {area(run):.1f}, {run['cpu_seconds']} s", flush=True)


def read(file: pathlib.Path) -> list[dict[str, Any]]:
    """The runs in a file."""
    if not file.exists():
        return []
    return [json.loads(line) for line in (lzma.open(file, "rt") if file.suffix == ".xz" else file.open())]


def report(runs: list[dict[str, Any]]) -> str:
    """Final scores and returns in training: means, and the difference from the agent without EqR with its 95% interval."""
    lines = []
    for task in STEPS:
        for arm in ARMS:
            own, off = ([run for run in runs if (run["task"], run["arm"]) == (task, name)] for name in (arm, "off"))
            cells = [task, arm, str(len(own))]
            for measure in (lambda run: run["score"], area):
                values, others = (np.array([measure(run) for run in found]) for found in (own, off))
                cells.append(mean_and_error(values) + (difference(values, others) if arm != "off" else ""))
            if own:
                lines.append([*cells, f"{np.mean([run['cpu_seconds'] for run in own]):.0f}"])
    return markdown(["task", "arm", "seeds", "final score", "return in training", "CPU seconds"], lines)


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=["train", "report"])
    parser.add_argument("file", type=pathlib.Path)
    parser.add_argument("--tasks", nargs="+", default=list(STEPS))
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[200, 201, 202, 203, 204])
    args = parser.parse_args()
    th.set_num_threads(1)
    if args.command == "train":
        train(args.file, args.tasks, args.arms, args.seeds)
    print(report(read(args.file)))


if __name__ == "__main__":
    main()
