"""
How much the latent state x₀ varies at initialisation and later, and which gradients reach it in the first updates.

    python -m experiments.state_signal --games Krull Pong MsPacman Boxing --json docs/results/state_signal.json

Spread: the root mean square distance from the mean state. Logits: their standard deviation over states, and over samples of
the head's noise at one state. Gradients: medians of their norms where the losses meet. Later, after ``--later`` updates:
spread over constant part, skill one and five steps ahead, the share of the trunk's features that are the same for all frames,
and the largest feature, compared with that at initialisation.
"""

import argparse
import json
import pathlib
from functools import partial
from typing import Any

import numpy as np
import torch as th
import yaml

from sb3_eqr import EqRRainbow, envs
from sb3_eqr.common.networks.encoders import ConvExtractor
from sb3_eqr.common.networks.layers import Centering
from sb3_eqr.configurations import load_configuration
from sb3_eqr.visualize.diagnostics import diagnose
from sb3_eqr.visualize.latents import replayed

N_DRAWS = 32  # samples of noise
N_WINDOWS = 512  # for the skill
FILE = pathlib.Path(__file__).with_name("settings") / "state_signal.yml"
CHANGES: dict[str, dict[str, Any]] = yaml.safe_load(FILE.read_text(encoding="utf-8"))
FAR = ("random_actions", "neither", "no_losses")  # κ and ρ start with PyTorch's initial weights


@th.no_grad()
def signal(model: EqRRainbow, observations: np.ndarray) -> dict[str, float]:
    """Constant part and spread of the state of observations, (N, *obs_shape), deviation of logits over states and noise."""
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
    """Train on the replay buffer; medians of the gradients' norms at the state, and of their ratio before it is limited."""
    model.train(n_updates, model.batch_size)
    norms = [[update[f"{which}_state_gradient"] for which in ("td", "aux")] for update in model._monitor.collect(0)]
    td, auxiliary = np.array(norms).T
    return {name: float(np.median(x)) for name, x in (("td", td), ("auxiliary", auxiliary), ("ratio", auxiliary / td))}


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
        Centering.forward(layer, features)  # notes the batch
        return features - layer.running_mean

    for layer in model.policy.online.modules():
        if isinstance(layer, Centering):
            layer.forward = partial(forward, layer)  # type: ignore[method-assign]


def measure(game: str, configuration: str, n_updates: int, n_later: int, n_frames: int) -> dict[str, Any]:
    """
    :param configuration: a file of ``zoo_hyperparams`` or a key of ``CHANGES``
    :return: a row
    """
    th.manual_seed(0)
    env = envs.make_atari100k_env(game, seed=0)
    arguments = CHANGES[configuration] if configuration in CHANGES else load_configuration(configuration)
    arguments = {**arguments, "buffer_size": 4_000, "learning_starts": n_frames}
    model = EqRRainbow("CnnPolicy", env, seed=0, device="cpu", **arguments)
    latent: Any = model.policy.latent_model
    random = [latent.predictor] if configuration == "random_predictor" else []
    random += [list(part)[-1] for part in (latent.transition, latent.action_symmetry) if configuration in FAR]
    for layer in random:
        layer.reset_parameters()
    if configuration == "constant_gradient":
        keep_constant_gradient(model)
    model.learn(n_frames)
    buffer: Any = model.replay_buffer
    observations = buffer.sample(256).observations.numpy()
    before = largest_feature(model, observations)
    found = signal(model, observations)
    if model.depth:
        found |= gradients(model, n_updates)
    if n_later > n_updates:
        model.train(n_later - n_updates, model.batch_size)
        after = diagnose(model, replayed(model, N_WINDOWS, np.random.default_rng(0)))
        found |= {"relative_spread": after.collapse.spread, "skill_1": after.loss.skill[0], "skill_5": after.loss.skill[-1]}
        found |= {"dead_units": after.collapse.dead_units, "growth": largest_feature(model, observations) / before}
    return {"game": game, "configuration": configuration, **{key: float(f"{value:.4g}") for key, value in found.items()}}


def main() -> None:
    """Parse the command line, measure, print and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--games", nargs="+", default=["Krull", "Pong", "MsPacman", "Boxing"])
    parser.add_argument("--configurations", nargs="+", default=["paper", "eqr_rainbow", *CHANGES])
    parser.add_argument("--updates", type=int, default=90, help="for the gradients")
    parser.add_argument("--later", type=int, default=500, help="updates before spread and skill are measured; 0: not")
    parser.add_argument("--frames", type=int, default=1_000, help="frames of random actions to train on")
    parser.add_argument("--json", type=pathlib.Path, help="write all rows here")
    args = parser.parse_args()
    rows = []
    for game in args.games:
        for configuration in args.configurations:
            rows.append(measure(game, configuration, args.updates, args.later, args.frames))
            print(rows[-1], flush=True)
    if args.json:
        args.json.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")


if __name__ == "__main__":
    main()
