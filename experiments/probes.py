"""
How well the latent state of an agent encodes the objects in a game: the fraction of variance (R²) of their positions that a
linear probe explains, on held-out frames; the same for the trunk's features, and for an untrained agent. The positions are
from MinAtar's planes, for Atari from the console's memory, and from the environments with a known symmetry themselves.

    python -m experiments.probes minatar Breakout --steps 10000 --seeds 0 1
    python -m experiments.probes minatar SpaceInvaders --agent eqr_rainbow:experiments/settings/ablation.yml:contrastive
    python -m experiments.probes worlds torus_of_4
    python -m experiments.probes atari100k Boxing --models runs/atari/runs/*/Boxing/0/models/*/*/*.zip

Games and agents are those of the benchmark; ``--models`` probes agents that ``sb3-eqr benchmark run --save-models`` kept.
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

# MinAtar's planes (Young and Tian 2019); targets are the mean position and the number of lit pixels per plane.
PLANES = {
    "Breakout": ["paddle", "ball", "trail", "bricks"],
    "SpaceInvaders": ["cannon", "aliens", "aliens left", "aliens right", "own bullet", "their bullet"],
}
# Addresses in the memory of the console (Anand et al. 2019, https://arxiv.org/abs/1906.08226, table of their annotations).
MEMORY = {
    "Pong": {"own paddle: y": 51, "their paddle: y": 50, "ball: x": 49, "ball: y": 54},
    "Boxing": {"own: x": 32, "own: y": 34, "their: x": 33, "their: y": 35},
    "Breakout": {"paddle: x": 72, "ball: x": 99, "ball: y": 101},
}
N_FRAMES, TRAINED_ON, RIDGE = 6_000, 4_500, 100.0
WAVES = {"sine of angle": np.sin, "cosine of angle": np.cos}


def targets(planes: np.ndarray, names: list[str]) -> dict[str, np.ndarray]:
    """
    :param planes: (N, channels, 10, 10), 0 or 255
    :return: name -> (N,), row, column and count of each plane, as far as they vary; NaN where the plane is empty
    """
    found: dict[str, np.ndarray] = {}
    for name, lit in zip(names, np.moveaxis(planes > 0, 1, 0), strict=False):  # (N, 10, 10)
        for what, axis in (("row", 2), ("column", 1)):
            line = lit.any(axis=axis)
            with np.errstate(invalid="ignore"):
                found[f"{name}: {what}"] = (line * np.arange(10)).sum(axis=1) / line.sum(axis=1)
        found[f"{name}: number"] = lit.sum(axis=(1, 2)).astype(float)
    return {name: value for name, value in found.items() if np.nanstd(value) > 1e-6}


def explained(inputs: np.ndarray, target: np.ndarray) -> float:
    """R² of ridge regression on held-out frames; frames with a NaN target are left out."""
    known = ~np.isnan(target)
    inputs, target = inputs[known], target[known]
    cut = int(len(target) * TRAINED_ON / N_FRAMES)
    mean, scale = inputs[:cut].mean(axis=0), inputs[:cut].std(axis=0) + 1e-6
    x, y = (inputs - mean) / scale, target - target[:cut].mean()
    weights = np.linalg.solve(x[:cut].T @ x[:cut] + RIDGE * np.eye(x.shape[1]), x[:cut].T @ y[:cut])
    left = y[cut:] - x[cut:] @ weights
    return float(1 - left.var() / max(y[cut:].var(), 1e-9))


Frames = tuple[np.ndarray, dict[str, np.ndarray]]  # observations, and object -> position, in random order


def watch(model: Any, env: Any, suite: str, game: str, rng: np.random.Generator) -> Frames:
    """
    Frames of the agent's own episodes, with about a third of its actions random; (N, *obs_shape) and (N,), with NaN where a
    ball is not in play.
    """
    obs, frames, memory = env.reset(), [], []
    for _ in range(N_FRAMES):
        frames.append(obs[0].copy())
        if suite != "minatar":
            memory.append(env.envs[0].unwrapped.ale.getRAM())
        action, _ = model.predict(obs, deterministic=True)
        action = rng.integers(0, env.action_space.n, 1) if rng.random() < 0.3 else action
        obs, *_ = env.step(action)
    seen = np.stack(frames)
    if suite == "minatar":
        known = targets(seen, PLANES[game])
    else:
        known = {name: np.stack(memory)[:, address].astype(float) for name, address in MEMORY[game].items()}
        if "ball: y" in known:  # 0 while no ball is in play, and x is then the last one or that of no ball
            is_out = known["ball: y"] == 0
            known |= {name: np.where(is_out, np.nan, known[name]) for name in ("ball: x", "ball: y")}
    order = rng.permutation(N_FRAMES)  # training and held-out frames are from the same episodes
    return seen[order], {name: positions[order] for name, positions in known.items()}


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


def make(agent: str, suite: str, game: str, seed: int, steps: int) -> Any:
    """:return: an untrained agent of the benchmark"""
    with tempfile.TemporaryDirectory() as folder:
        place = pathlib.Path(folder)
        (run,) = plan_runs(place, choose(load_suite(suite), [game], max(steps, 1_000)), [agent], [seed])
        return build(run, Settings(device="cpu"), place / "logs")[0]


def main() -> None:
    """Parse the command line, train and probe, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", choices=["minatar", "atari100k", "worlds"])
    parser.add_argument("game", help=f"{', '.join(PLANES)}; {', '.join(MEMORY)}; or an environment of worlds")
    parser.add_argument("--agent", help="default: eqr_rainbow, of worlds eqr_qrdqn")
    parser.add_argument("--steps", type=int, default=0, help="training steps; default: 0, untrained")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--models", nargs="+", default=[], help="saved agents, instead of training one")
    args = parser.parse_args()
    th.set_num_threads(1)
    agent = args.agent or ("eqr_qrdqn" if args.suite == "worlds" else "eqr_rainbow")
    for seed in args.seeds:
        models = {"new": make(agent, args.suite, args.game, seed, args.steps)}
        for path in args.models:
            settings = {"device": "cpu", "custom_objects": {"buffer_size": 100}}
            models[path] = type(models["new"]).load(path, models["new"].get_env(), **settings)
        if args.steps:
            models["trained"] = make(agent, args.suite, args.game, seed, args.steps).learn(args.steps)
        player = list(models.values())[-1]
        if args.suite == "worlds":
            protocol = load_suite("worlds").protocol(args.game)
            seen = scattered(protocol["env_id"], protocol["preprocessing"].get("env_kwargs", {}))
        else:
            seen = watch(player, player.get_env(), args.suite, args.game, np.random.default_rng(seed))
        print(table(f"seed {seed}", {name: probe(model, seen) for name, model in models.items()}))


if __name__ == "__main__":
    main()
