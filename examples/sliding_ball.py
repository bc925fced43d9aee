"""
Example 2 and Figure 3 of the paper: the latent space of a sliding ball, learned from random actions without reward.

    python examples/sliding_ball.py                                  # the ball, SO(2), one seed, two minutes
    python examples/sliding_ball.py --seeds 0 1 2 3 4 --arms each    # the table of docs/without_reward.md
    python examples/sliding_ball.py --world torus                    # a torus, two blocks

Writes a model and a figure per run, and results.jsonl with a line per run, to --out. Finished runs are not repeated.
"""

import argparse
import json
import pathlib
from typing import Any

import matplotlib
import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env

from sb3_eqr import EqRQRDQN
from sb3_eqr.common.saving.files import atomic_write
from sb3_eqr.envs import SlidingBall
from sb3_eqr.plot_style import COLORS, styled
from sb3_eqr.representation import train_representation
from sb3_eqr.visualize.latents import action_elements, coordinates, encode, split

matplotlib.use("Agg")
import matplotlib.pyplot as plt

PAPER: dict[str, Any] = {"parameterization": "euler", "whiten": False, "aet_loss": "distance", "still_timesteps": 0}
SEAMLESS = {"parameterization": "gram-schmidt"}
WHITENED = {"whiten": True}
CONTRASTIVE = {"aet_loss": "contrastive"}
DEFAULT_ARM = "all"
ARMS: dict[str, dict[str, Any]] = {
    DEFAULT_ARM: {},
    "AET alone": PAPER,
    "seamless": {**PAPER, **SEAMLESS},
    "whitened": {**PAPER, **WHITENED},
    "whitened, seamless": {**PAPER, **WHITENED, **SEAMLESS},
    "contrastive": {**PAPER, **CONTRASTIVE},
    "contrastive, seamless": {**PAPER, **CONTRASTIVE, **SEAMLESS},
    "all, actions not still": {"still_timesteps": 0},
    "all, actions depend on the state": {"state_dependent_actions": True},
}
IDS = {"ball": "SlidingBall-v0", "torus": "SlidingBallTorus-v0"}
DIMENSIONS = {"ball": 1, "torus": 2}
GRID = {"ball": 192, "torus": 48}  # positions per axis at which the learned map is evaluated
AXES = ("vertical", "horizontal")
STEPS_AHEAD = 20
N_ENVS = 16  # in parallel, as random actions in a single one cover little of a torus
WIDTH = 0.25  # of the ball, in loops


def images(world: SlidingBall, positions: np.ndarray) -> th.Tensor:
    """
    :param positions: (N, axes)
    :return: (N, 1, size, size), uint8
    """
    return th.as_tensor(np.stack([np.moveaxis(world.draw(position), -1, 0) for position in positions]))


def turns(model: EqRQRDQN, elements: th.Tensor) -> np.ndarray:
    """
    :param elements: states, (N, D), or elements of actions, (N, A, K, 2, 2)
    :return: the angles of the K blocks, in turns, (N, K) or (N, A, K)
    """
    blocks = split(model, elements)[0]
    return coordinates(blocks.group, blocks.elements)[..., 0].double().numpy() / (2 * np.pi)


def grid(axes: int, per_axis: int) -> np.ndarray:
    """
    :return: positions, (per_axis ** axes, axes)
    """
    return np.stack(np.meshgrid(*[np.arange(per_axis) / per_axis] * axes, indexing="ij"), axis=-1).reshape(-1, axes)


def linearity(angle: np.ndarray, positions: np.ndarray) -> tuple[list[int], float]:
    """
    How well a block's angle is an integer number of turns per loop of each axis, plus a constant. Circular R² is 1 minus
    the mean square of the residual, divided by that of a uniform angle, 1/12 of a turn squared.

    :param angle: in turns, (N,)
    :param positions: in loops, (N, axes)
    :return: the best numbers of turns, at most 3 in either direction, and their R²
    """
    best, best_score = [0] * positions.shape[1], -np.inf
    for counts in np.stack(np.meshgrid(*[np.arange(-3, 4)] * positions.shape[1]), axis=-1).reshape(-1, positions.shape[1]):
        left = np.exp(2j * np.pi * (angle - positions @ counts))
        score = 1 - 12 * np.square(np.angle(left / left.mean()) / (2 * np.pi)).mean() if counts.any() else -np.inf
        if score > best_score:
            best, best_score = counts.tolist(), float(score)
    return best, best_score


def prediction_errors(model: EqRQRDQN, world: SlidingBall, places: np.ndarray, n: int = 200) -> np.ndarray:
    """
    Predict ``STEPS_AHEAD`` random actions from random positions in the latent space, and decode the result as the position
    with the nearest latent state.

    :param places: positions to choose from, (N, axes)
    :return: distance of the decoded position from the true one, in widths of the ball, (n,)
    """
    rng = np.random.default_rng(0)
    actions = rng.integers(0, 2 * world.dimensions, (n, STEPS_AHEAD))
    starts = rng.random((n, world.dimensions))
    axis, forwards = np.divmod(actions, 2)
    moved = ((2 * forwards - 1)[..., None] * np.eye(world.dimensions)[axis]).sum(axis=1)  # (n, axes), in steps
    latent_model = model.policy.latent_model
    with th.no_grad():
        states = encode(model, images(world, starts))
        predicted = latent_model.rollout(states, model.policy.embed_actions(th.as_tensor(actions)))[:, -1]  # (n, D)
    nearest = th.cdist(predicted, encode(model, images(world, places))).argmin(dim=1).numpy()
    apart = (places[nearest] - starts - moved / world.n_steps + 0.5) % 1 - 0.5
    return np.linalg.norm(apart, axis=1) / WIDTH


def measure(model: EqRQRDQN, world: SlidingBall, per_axis: int) -> dict[str, Any]:
    """Metrics of what was learned. Angles of actions are in steps of the ball."""
    places = grid(world.dimensions, per_axis)
    states = encode(model, images(world, places))
    angles = turns(model, states)  # (N, K)
    fits = [linearity(angles[:, k], places) for k in range(angles.shape[1])]
    elements = action_elements(model, states[:: max(len(states) // 64, 1)])
    moves = np.angle(np.exp(2j * np.pi * turns(model, elements)).mean(axis=0)) / (2 * np.pi) * world.n_steps  # (A, K)
    wrapped = np.diff(angles[:, 0], append=angles[:1, 0])
    errors = prediction_errors(model, world, places)
    return {
        "turns_per_loop": [counts for counts, _ in fits],
        "circular_r2": [round(score, 5) for _, score in fits],
        "winding": float(np.round(np.sum((wrapped + 0.5) % 1 - 0.5), 2)) if world.dimensions == 1 else None,
        "action_steps": np.round(moves, 4).tolist(),
        "not_opposite": round(float(np.abs(moves[0::2] + moves[1::2]).max()), 4),
        "ahead_mean": round(float(errors.mean()), 4),
        "ahead_max": round(float(errors.max()), 4),
    }


def draw(model: EqRQRDQN, world: SlidingBall, path: pathlib.Path) -> None:
    """Figure 3: the image of the vector (1, 0) under each block; the eight numbered points are equal steps along an axis."""
    n_blocks, axes = model.policy.latent_model.n_blocks, world.dimensions
    with styled():
        figure = plt.figure(figsize=(3.9, 2.8 * axes), layout="constrained")
        grids = figure.add_gridspec(2 * axes, n_blocks, height_ratios=[1, 3.5] * axes)
        for axis in range(axes):
            along = np.full((GRID["ball"], axes), 0.5)
            along[:, axis] = np.arange(GRID["ball"]) / GRID["ball"]
            every = along[:: GRID["ball"] // 8]  # eight positions
            angles = 2 * np.pi * turns(model, encode(model, images(world, along)))
            eight = 2 * np.pi * turns(model, encode(model, images(world, every)))
            shown = np.pad(images(world, every)[:, 0].numpy(), ((0, 0), (0, 0), (2, 2)), constant_values=150)  # (8, h, w)
            strip = figure.add_subplot(grids[2 * axis, :])
            strip.imshow(np.concatenate(list(shown), axis=1), cmap="gray")
            strip.set_title(f"{AXES[axis]} motion, 0 to 7")
            strip.set_axis_off()
            for k in range(n_blocks):
                panel = figure.add_subplot(grids[2 * axis + 1, k])
                panel.plot(np.cos(angles[:, k]), -np.sin(angles[:, k]), ".", color="#b0b0b0", markersize=3)
                panel.plot(np.cos(eight[:, k]), -np.sin(eight[:, k]), "o", color=COLORS[1], markersize=5)
                is_wide = np.ptp(np.cos(eight[:, k])) > 1  # otherwise the numbers would overlap
                for number, angle in enumerate(eight[:, k] if is_wide else []):
                    place = (1.22 * np.cos(angle), -1.22 * np.sin(angle))
                    panel.annotate(str(number), place, ha="center", va="center", fontsize=8)
                panel.set(xlim=(-1.5, 1.5), ylim=(-1.5, 1.5), aspect="equal", xticks=[-1, 0, 1], yticks=[-1, 0, 1])
                panel.set(xlabel="x", ylabel="y")
                panel.set_title(f"block {k}" if n_blocks > 1 else "latent states, SO(2)")
        with atomic_write(path, "png") as file:
            figure.savefig(file, dpi=200)
        plt.close(figure)


def run(world_name: str, arm: str, seed: int, steps: int, out: pathlib.Path) -> dict[str, Any]:
    """Train, save, measure, draw."""
    world = SlidingBall(dimensions=DIMENSIONS[world_name])
    env = make_vec_env(IDS[world_name], N_ENVS, seed)
    model = train_representation(
        env,
        "SO(2)",
        n_blocks=world.dimensions,
        total_timesteps=steps,
        progress_bar=True,
        seed=seed,
        device="cpu",
        **ARMS[arm],
    )
    name = f"{world_name}-{arm}-{seed}".replace(", ", "-").replace(" ", "_")
    model.save(out / name)
    result = {"world": world_name, "arm": arm, "seed": seed, "steps": steps, **measure(model, world, GRID[world_name])}
    draw(model, world, out / f"{name}.png")
    return result


def is_found(result: dict[str, Any]) -> bool:
    """Each block makes one full turn per loop of its own axis, with R² ≥ 0.99."""
    counts = np.abs(result["turns_per_loop"])
    return sorted(counts.tolist()) == np.eye(len(counts))[::-1].tolist() and min(result["circular_r2"]) >= 0.99


def table(results: list[dict[str, Any]]) -> str:
    """
    :return: a Markdown table, a row per world and arm; every column has the worst of the seeds
    """
    columns = "environment | options | steps | found | circular R² | not opposite | 20 steps ahead: mean | furthest"
    rows = [f"| {columns} |", "|---" * 8 + "|"]
    for key in dict.fromkeys((result["world"], result["arm"], result["steps"]) for result in results):
        runs = [result for result in results if (result["world"], result["arm"], result["steps"]) == key]
        worst = {name: max(np.max(run[name]) for run in runs) for name in ("not_opposite", "ahead_mean", "ahead_max")}
        r2 = min(min(run["circular_r2"]) for run in runs)
        found = f"{sum(map(is_found, runs))} of {len(runs)}"
        figures = " | ".join(f"{figure:.3f}" for figure in (r2, *worst.values()))
        rows.append(f"| {key[0]} | {key[1]} | {key[2]:,} | {found} | {figures} |")
    return "\n".join(rows)


def main() -> None:
    """Run what is not yet in results.jsonl, then print the table of all runs."""
    parser = argparse.ArgumentParser(
        description=__doc__.strip().split("\n")[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--world", choices=DIMENSIONS, default="ball", help="a loop or a torus")
    parser.add_argument("--arms", nargs="+", default=[DEFAULT_ARM], choices=[*ARMS, "each"], help="settings to train with")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="seeds of all random generators")
    parser.add_argument("--steps", type=int, default=5_500, help="steps of random actions; from 3000 on, an update for each")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("results/sliding_ball"), help="output folder")
    args = parser.parse_args()
    th.set_num_threads(1)  # small networks are slower with two
    args.out.mkdir(parents=True, exist_ok=True)
    results = args.out / "results.jsonl"
    lines = results.read_text().splitlines() if results.exists() else []
    done = {tuple(json.loads(line)[key] for key in ("world", "arm", "seed", "steps")) for line in lines}
    for arm in ARMS if "each" in args.arms else args.arms:
        for seed in args.seeds:
            if (args.world, arm, seed, args.steps) not in done:
                line = json.dumps(run(args.world, arm, seed, args.steps, args.out))
                print(line, flush=True)
                with results.open("a") as file:
                    file.write(line + "\n")
    print(table([json.loads(line) for line in results.read_text().splitlines()]))


if __name__ == "__main__":
    main()
