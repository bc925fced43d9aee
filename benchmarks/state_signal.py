"""
How much the latent state x₀ varies at initialisation, and which gradients reach it in the first updates.

    python -m benchmarks.state_signal --games Krull Pong MsPacman --json docs/results/state_signal.json

Spread over states: the root mean square distance from the mean state. Logits: the standard deviation over states without
noise, and over samples of the head's noise at one state, each as root mean square over atoms and actions. Gradients: their
norms where the losses meet, medians over the updates (train/td_state_gradient, train/aux_state_gradient).
"""

import argparse
import json
import pathlib
from typing import Any

import numpy as np
import torch as th

from sb3_eqr import EqRRainbow, envs
from sb3_eqr.common.objective import LossCoefs
from sb3_eqr.configurations import load_configuration

N_DRAWS = 32  # samples of noise


@th.no_grad()
def signal(model: EqRRainbow, observations: np.ndarray) -> dict[str, float]:
    """
    :param model: any EqR agent
    :param observations: observations from the environment, (N, *obs_shape)
    :return: constant part and spread of the state, standard deviation of logits over states and over noise
    """
    policy = model.policy
    policy.set_training_mode(False)
    features = policy.online.features(policy.obs_to_tensor(observations)[0])  # (N, F)
    state = policy.latent_model.embedding(features)
    logits = policy.online.head(features)  # (N, atoms, A)
    draws = th.stack([policy.online.head(features[:1], noisy=True)[0] for _ in range(N_DRAWS)])
    return {
        "constant": state.mean(dim=0).norm().item(),
        "spread": state.var(dim=0, correction=0).sum().sqrt().item(),
        "logits_over_states": logits.var(dim=0).mean().sqrt().item(),
        "logits_over_noise": draws.var(dim=0).mean().sqrt().item(),
    }


def gradients(model: EqRRainbow, n_updates: int) -> dict[str, float]:
    """
    Train on the replay buffer.

    :param model: an agent whose buffer has complete windows
    :param n_updates: number of updates
    :return: medians of the norms of TD and auxiliary gradient at the state, and of their ratio before it is limited
    """
    norms = []
    record = model.objective.__class__.__call__

    def watch(objective: Any, samples: Any, coefs: LossCoefs) -> Any:
        terms = record(objective, samples, coefs)
        norms.append(terms.gram)
        return terms

    model.objective.__class__.__call__ = watch  # type: ignore[method-assign,assignment]
    try:
        model.train(n_updates, model.batch_size)
    finally:
        model.objective.__class__.__call__ = record  # type: ignore[method-assign]
    td, auxiliary = th.stack([gram.diagonal().sqrt() for gram in norms if gram is not None]).cpu().numpy().T
    return {"td": float(np.median(td)), "auxiliary": float(np.median(auxiliary)), "ratio": float(np.median(auxiliary / td))}


def measure(game: str, changes: dict[str, Any], configuration: str, n_updates: int, n_frames: int) -> dict[str, Any]:
    """
    :param game: an Atari game
    :param changes: arguments of the agent that override the configuration's
    :param configuration: a file of ``zoo_hyperparams``, or "default" for ``EqRRainbow("CnnPolicy", env)``
    :return: a row
    """
    th.manual_seed(0)
    env = envs.make_atari100k_env(game, seed=0)
    arguments = changes if configuration == "default" else load_configuration(configuration, **changes)
    model = EqRRainbow(
        "CnnPolicy", env, seed=0, device="cpu", **{**arguments, "buffer_size": 4_000, "learning_starts": n_frames}
    )
    model.learn(n_frames)
    assert model.replay_buffer is not None
    observations = model.replay_buffer.sample(256).observations
    found = signal(model, observations.numpy())  # type: ignore[union-attr]
    if model.depth:
        found |= gradients(model, n_updates)
    return {"game": game, "configuration": configuration, **{key: float(f"{value:.4g}") for key, value in found.items()}}


def main() -> None:
    """Parse the command line, measure, print and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--games", nargs="+", default=["Krull", "Pong", "MsPacman"])
    parser.add_argument("--configurations", nargs="+", default=["paper", "default"])
    parser.add_argument("--updates", type=int, default=90)
    parser.add_argument("--frames", type=int, default=1_000, help="frames of random actions to train on")
    parser.add_argument("--json", type=pathlib.Path, help="write all rows here")
    arguments = parser.parse_args()
    rows = []
    for game in arguments.games:
        for configuration in arguments.configurations:
            rows.append(measure(game, {}, configuration, arguments.updates, arguments.frames))
            print(rows[-1], flush=True)
    if arguments.json:
        arguments.json.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")


if __name__ == "__main__":
    main()
