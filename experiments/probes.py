"""
How well the features of an agent encode the state of an environment with a known symmetry: the fraction of variance (R²) of
its positions that a linear probe explains, on held-out frames; for the trunk's features and, with a group, the latent state.

    python -m experiments.probes torus_of_8 --seeds 3 4
    python -m experiments.probes torus_of_4 --steps 8000
"""

import argparse
import pathlib
import tempfile
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th

from experiments import markdown
from sb3_eqr import GroupFeaturesExtractor
from sb3_eqr.benchmark.runs import Settings, plan_runs
from sb3_eqr.benchmark.suites import choose, load_suite
from sb3_eqr.benchmark.training import build
from sb3_eqr.visualize.latents import encode, eval_mode

N_FRAMES, TRAINED_ON, RIDGE = 6_000, 4_500, 100.0
WAVES = {"sine of angle": np.sin, "cosine of angle": np.cos}


def explained(inputs: np.ndarray, target: np.ndarray) -> float:
    """R² of ridge regression on held-out frames."""
    cut = int(len(target) * TRAINED_ON / N_FRAMES)
    mean, scale = inputs[:cut].mean(axis=0), inputs[:cut].std(axis=0) + 1e-6
    x, y = (inputs - mean) / scale, target - target[:cut].mean()
    weights = np.linalg.solve(x[:cut].T @ x[:cut] + RIDGE * np.eye(x.shape[1]), x[:cut].T @ y[:cut])
    left = y[cut:] - x[cut:] @ weights
    return float(1 - left.var() / max(y[cut:].var(), 1e-9))


Frames = tuple[np.ndarray, dict[str, np.ndarray]]  # observations (N, *obs_shape), and name -> position (N,)


def trunk_features(model: Any, observations: th.Tensor) -> th.Tensor:
    """:return: (N, F), what the trunk and its layer norm make of observations, without a group layer on top of them"""
    encoder = model.policy.online.features_extractor
    trunk = encoder.trunk if isinstance(encoder, GroupFeaturesExtractor) else encoder
    return model.policy.online.extract_features(observations, trunk)


def probe(model: Any, frames: Frames) -> dict[str, dict[str, float]]:
    """
    :return: what is probed -> object -> R²; the latent state only for agents with a group
    """
    seen, known = frames
    parts = th.as_tensor(seen).split(250)
    with eval_mode(model), th.no_grad():
        inputs = {"trunk": np.concatenate([trunk_features(model, part).cpu().numpy() for part in parts])}
        if model.policy.group_layer is not None:
            inputs["state"] = encode(model, th.as_tensor(seen)).cpu().numpy()
    return {what: {name: explained(x, y) for name, y in known.items()} for what, x in inputs.items()}


def scattered(env_id: str, env_kwargs: dict[str, Any]) -> Frames:
    """
    Random states of ``SlidingBallTorus-v0`` or ``PixelPendulum-v0``; their positions are sine and cosine of every angle, and
    the pendulum's velocity.
    """
    world: Any = gym.make(env_id, **env_kwargs).unwrapped
    is_pendulum = env_id.startswith("PixelPendulum")
    velocities = np.random.default_rng(0).uniform(-8, 8, N_FRAMES)  # rad/s; it starts with at most 1
    options = [{"velocity": velocity} if is_pendulum else None for velocity in velocities]
    starts = [world.reset(seed=seed, options=option) for seed, option in enumerate(options)]
    angles = np.stack([np.atleast_1d(info["angle"] if is_pendulum else 2 * np.pi * info["position"]) for _, info in starts])
    known = {f"{name} {axis}": wave(angle) for axis, angle in enumerate(angles.T) for name, wave in WAVES.items()}
    seen = np.stack([np.moveaxis(observation, 2, 0) for observation, _ in starts])
    return seen, known | ({"velocity": velocities} if is_pendulum else {})


def table(title: str, found: dict[str, dict[str, dict[str, float]]]) -> str:
    """:return: R² as a Markdown table: a row per object, a column per agent and what is probed"""
    columns = {f"{agent}, {what}": values for agent, parts in found.items() for what, values in parts.items()}
    names = next(iter(columns.values()))
    return markdown([title, *columns], [[name, *(f"{values[name]:.2f}" for values in columns.values())] for name in names])


def make(agent: str, game: str, seed: int, steps: int) -> Any:
    """:return: an untrained agent of the benchmark"""
    with tempfile.TemporaryDirectory() as folder:
        place = pathlib.Path(folder)
        (run,) = plan_runs(place, choose(load_suite("worlds"), [game], max(steps, 1_000)), [agent], [seed])
        return build(run, Settings(device="cpu"), place / "logs")[0]


def main() -> None:
    """Parse the command line, train and probe, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("game", help="of the suite worlds: torus, large_torus, torus_of_4, torus_of_8 or pendulum")
    parser.add_argument("--agent", default="eqr_qrdqn", help="of the benchmark")
    parser.add_argument("--steps", type=int, default=0, help="training steps; default: 0, untrained")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    args = parser.parse_args()
    th.set_num_threads(1)
    protocol = load_suite("worlds").protocol(args.game)
    seen = scattered(protocol["env_id"], protocol["preprocessing"].get("env_kwargs", {}))
    for seed in args.seeds:
        models = {"new": make(args.agent, args.game, seed, args.steps)}
        if args.steps:
            models["trained"] = make(args.agent, args.game, seed, args.steps).learn(args.steps)
        print(table(f"seed {seed}", {name: probe(model, seen) for name, model in models.items()}))


if __name__ == "__main__":
    main()
