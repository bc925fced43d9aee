"""
How much the latent state x₀ varies at initialisation and later, and which gradients reach it in the first updates.

    python -m experiments.state_signal --games Krull Pong MsPacman Boxing --json docs/results/state_signal.json

Spread over states: the root mean square distance from the mean state. Logits: the standard deviation over states without
noise, and over samples of the head's noise at one state, each as root mean square over atoms and actions. Gradients: their
norms where the losses meet, medians over the updates (train/td_state_gradient, train/aux_state_gradient). Later, after
``--later`` updates: the spread over the constant part, the skill of the predictions one and five steps ahead, the share of
the trunk's features that are the same for all frames, and the largest feature, compared with that at initialisation.
"""

import argparse
import json
import pathlib
from functools import partial
from typing import Any

import numpy as np
import torch as th

from sb3_eqr import EqRRainbow, envs
from sb3_eqr.common.networks.encoders import ConvExtractor
from sb3_eqr.common.networks.layers import Centering
from sb3_eqr.configurations import load_configuration
from sb3_eqr.visualize.diagnostics import diagnose
from sb3_eqr.visualize.latents import replayed

N_DRAWS = 32  # samples of noise
N_WINDOWS = 512  # for the skill
CHANGES: dict[str, dict[str, Any]] = {  # name -> arguments that differ from those of EqRRainbow("CnnPolicy", env)
    "default": {},
    "constant_gradient": {},  # the gradient of what all frames have in common reaches the trunk
    "no_centring": {"policy_kwargs": {"center": False}},
    "no_predictor": {"policy_kwargs": {"predictor": False}},
    "random_predictor": {},  # the predictor starts with PyTorch's initial weights
    "random_actions": {},  # κ and ρ start with PyTorch's initial weights
    "neither": {"policy_kwargs": {"center": False}},  # no centring, random actions
    "no_losses": {"aux_gradient_share": 0.0, "policy_kwargs": {"center": False}},  # as "neither"; only TD trains the encoder
}
FAR = ("random_actions", "neither", "no_losses")


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
    head = policy.online.head
    logits = head(features)  # (N, atoms, A)
    draws = th.stack([head(features[:1], head.draw_noise())[0] for _ in range(N_DRAWS)])
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

    def watch(objective: Any, samples: Any, coefs: Any) -> Any:
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


def later(model: EqRRainbow) -> dict[str, float]:
    """
    :param model: an agent after some updates
    :return: spread of the latent states over their size, skill one and M steps ahead, share of constant features
    """
    found = diagnose(model, replayed(model, N_WINDOWS, np.random.default_rng(0)))
    skill = {"skill_1": found.loss.skill[0], "skill_5": found.loss.skill[-1]}
    return {"relative_spread": found.collapse.spread, **skill, "dead_units": found.collapse.dead_units}


@th.no_grad()
def largest_feature(model: EqRRainbow, observations: np.ndarray) -> float:
    """The largest output of the last ReLU for observations, (N, *obs_shape)."""
    trunk: Any = model.policy.online.features_extractor
    while not isinstance(trunk, ConvExtractor):
        trunk = trunk.trunk
    return trunk(th.as_tensor(observations) / 255).max().item()


def keep_constant_gradient(model: EqRRainbow) -> None:
    """Let the gradient of what all frames have in common reach the trunk, where the running mean removes the effect again."""

    def forward(layer: Centering, features: th.Tensor) -> th.Tensor:
        if layer.training and th.is_grad_enabled():
            mean = features.detach().mean(dim=0)
            layer.note(mean, features.detach() - mean)
        return features - layer.running_mean

    for layer in model.policy.online.modules():
        if isinstance(layer, Centering):
            layer.forward = partial(forward, layer)  # type: ignore[method-assign]


def measure(game: str, configuration: str, n_updates: int, n_later: int, n_frames: int) -> dict[str, Any]:
    """
    :param game: an Atari game
    :param configuration: a file of ``zoo_hyperparams`` or a key of ``CHANGES``
    :return: a row
    """
    th.manual_seed(0)
    env = envs.make_atari100k_env(game, seed=0)
    arguments = CHANGES[configuration] if configuration in CHANGES else load_configuration(configuration)
    model = EqRRainbow(
        "CnnPolicy", env, seed=0, device="cpu", **{**arguments, "buffer_size": 4_000, "learning_starts": n_frames}
    )
    if configuration in FAR:
        networks: tuple[Any, ...] = model.policy.latent_model.transition, model.policy.latent_model.action_symmetry
        for *_, last in networks:
            last.reset_parameters()
    if configuration == "random_predictor":
        predictor: Any = model.policy.latent_model.predictor
        predictor.reset_parameters()
    if configuration == "constant_gradient":
        keep_constant_gradient(model)
    model.learn(n_frames)
    assert model.replay_buffer is not None
    observations = model.replay_buffer.sample(256).observations.numpy()  # type: ignore[union-attr]
    before = largest_feature(model, observations)
    found = signal(model, observations)
    if model.depth:
        found |= gradients(model, n_updates)
    if n_later > n_updates:
        model.train(n_later - n_updates, model.batch_size)
        found |= later(model) | {"growth": largest_feature(model, observations) / before}
    return {"game": game, "configuration": configuration, **{key: float(f"{value:.4g}") for key, value in found.items()}}


def main() -> None:
    """Parse the command line, measure, print and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--games", nargs="+", default=["Krull", "Pong", "MsPacman", "Boxing"])
    parser.add_argument("--configurations", nargs="+", default=["paper", *CHANGES])
    parser.add_argument("--updates", type=int, default=90, help="for the gradients")
    parser.add_argument("--later", type=int, default=500, help="updates before spread and skill are measured; 0: not")
    parser.add_argument("--frames", type=int, default=1_000, help="frames of random actions to train on")
    parser.add_argument("--json", type=pathlib.Path, help="write all rows here")
    arguments = parser.parse_args()
    rows = []
    for game in arguments.games:
        for configuration in arguments.configurations:
            rows.append(measure(game, configuration, arguments.updates, arguments.later, arguments.frames))
            print(rows[-1], flush=True)
    if arguments.json:
        arguments.json.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")


if __name__ == "__main__":
    main()
