"""
Train agents on CartPole-v1, with learning curves.

    python examples/cartpole.py --seeds 0 1 2 3 4                      # EqRQRDQN, 30,000 steps
    python examples/cartpole.py --agent eqr_rainbow --seeds 0 1 2 3 4  # EqRRainbow with the same settings
    python examples/cartpole.py --agent without_eqr --seeds 0 1 2 3 4  # EqRQRDQN without group and losses
    python examples/cartpole.py --agent qrdqn --seeds 0 1 2 3 4        # sb3_contrib's QRDQN with the same settings
    python examples/cartpole.py --agent plain_rainbow --seeds 0 1 2 3 4    # EqRRainbow, all extensions off: a categorical DQN
    python examples/cartpole.py --agent dqn --seeds 0 1 2 3 4              # SB3's DQN with the same settings

The values of RL Zoo's tuned entries for CartPole-v1 are marked (Zoo); the others of EqRQRDQN were chosen by hand
on seed 3, see docs/results/cartpole.md.
"""

import argparse
import json
import tempfile

import numpy as np
import torch as th
from sb3_contrib import QRDQN
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_eqr import EqRQRDQN, EqRRainbow

STEPS = 30_000
SETTINGS = {
    "learning_rate": 1e-3,
    "batch_size": 64,  # (Zoo)
    "buffer_size": STEPS,
    "learning_starts": 1_000,  # (Zoo)
    "gamma": 0.99,  # (Zoo)
    "train_freq": 64,
    "gradient_steps": 64,
    "n_steps": 3,
    "target_update_interval": 100,
    "exploration_fraction": 0.16,  # (Zoo)
    "exploration_final_eps": 0.04,  # (Zoo)
    "policy_kwargs": {"net_arch": [256, 256], "n_quantiles": 10, "noisy": False},  # (Zoo); SE(2), 12 blocks: defaults
}


DQN_SETTINGS = {  # all (Zoo)
    "learning_rate": 2.3e-3,
    "batch_size": 64,
    "buffer_size": 100_000,
    "learning_starts": 1_000,
    "gamma": 0.99,
    "train_freq": 256,
    "gradient_steps": 128,
    "target_update_interval": 10,
    "exploration_fraction": 0.16,
    "exploration_final_eps": 0.04,
    "n_steps": 1,
    "max_grad_norm": 10,
}
OFF = {"prediction_depth": 0, "double_q": False, "prioritized_replay": False}
OFF_NETWORK = {"group": None, "dueling": False, "noisy": False, "v_min": 0.0, "v_max": 100.0}  # 1 / (1 - gamma)
OFF_NETWORK |= {"features_extractor_class": "flatten", "layer_norm": False, "spread_init": None}
DQN_NETWORK = {"net_arch": [256, 256], "optimizer_class": th.optim.Adam, "optimizer_kwargs": {"eps": 1e-8}}


def make_model(agent: str, seed: int) -> OffPolicyAlgorithm:
    """
    :param agent: one of ``STEPS_OF``
    """
    if agent == "eqr_qrdqn":
        return EqRQRDQN("MlpPolicy", "CartPole-v1", seed=seed, **SETTINGS)
    if agent == "without_eqr":
        network = {**SETTINGS["policy_kwargs"], "group": None}
        return EqRQRDQN("MlpPolicy", "CartPole-v1", seed=seed, prediction_depth=0, **{**SETTINGS, "policy_kwargs": network})
    if agent == "eqr_rainbow":
        network = {"net_arch": [256, 256], "noisy": False, "v_min": 0.0, "v_max": 100.0}
        return EqRRainbow("MlpPolicy", "CartPole-v1", seed=seed, **{**SETTINGS, "policy_kwargs": network})
    if agent == "qrdqn":
        network = {key: value for key, value in SETTINGS["policy_kwargs"].items() if key != "noisy"}
        return QRDQN("MlpPolicy", "CartPole-v1", seed=seed, **{**SETTINGS, "max_grad_norm": 10, "policy_kwargs": network})
    if agent == "dqn":
        return DQN("MlpPolicy", "CartPole-v1", seed=seed, **DQN_SETTINGS, policy_kwargs=DQN_NETWORK)
    network = {**DQN_NETWORK, **OFF_NETWORK}
    return EqRRainbow("MlpPolicy", "CartPole-v1", seed=seed, **DQN_SETTINGS, **OFF, policy_kwargs=network)


STEPS_OF = {
    "eqr_qrdqn": STEPS,
    "eqr_rainbow": STEPS,
    "without_eqr": STEPS,
    "qrdqn": STEPS,
    "plain_rainbow": 50_000,
    "dqn": 50_000,
}


def train(agent: str, seed: int, steps: int) -> dict:
    """
    :return: the learning curve of one seed, and the mean return of 100 episodes of the trained agent
    """
    eval_env = make_vec_env("CartPole-v1", 20, seed=1_000 + seed)
    with tempfile.TemporaryDirectory() as folder:  # EvalCallback keeps its results only if it can write them
        curve = EvalCallback(eval_env, eval_freq=1_000, n_eval_episodes=20, log_path=folder, verbose=0)
        model = make_model(agent, seed).learn(steps, callback=curve)
    mean, std = evaluate_policy(model, make_vec_env("CartPole-v1", 20, seed=2_000 + seed), n_eval_episodes=100)
    returns = np.mean(curve.evaluations_results, axis=1)
    reached = [int(step) for step, value in zip(curve.evaluations_timesteps, returns, strict=True) if value >= 475]
    return {
        "agent": agent,
        "seed": seed,
        "first_step_at_475": reached[0] if reached else None,
        "best_of_curve": float(returns.max()),
        "final_mean_of_100": float(mean),
        "final_std": float(std),
        "curve": returns.tolist(),
    }


def main() -> None:
    """Train each seed and print its metrics."""
    parser = argparse.ArgumentParser(description=__doc__.strip().split("\n")[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--agent", choices=STEPS_OF, default="eqr_qrdqn")
    parser.add_argument("--steps", type=int)
    parser.add_argument("--json", metavar="FILE", help="append one line of metrics per seed")
    args = parser.parse_args()
    th.set_num_threads(1)
    for seed in args.seeds:
        result = train(args.agent, seed, args.steps or STEPS_OF[args.agent])
        print({key: value for key, value in result.items() if key != "curve"}, flush=True)
        if args.json:
            with open(args.json, "a") as file:
                file.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
