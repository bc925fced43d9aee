"""
The README's picture: SAC with a latent model and without it on HalfCheetah, both at once.

    python examples/half_cheetah.py    # about four minutes on two idle cores

Writes both models and demo.gif to --out. In the picture's left half the two trained agents run, drawn from the positions of
their bodies, so that no renderer is needed. The right half shows their returns while they learned, over the range of the
seeds kept in docs/results/continuous_early.xz.
"""

import argparse
import json
import lzma
import multiprocessing
import pathlib
from typing import Any, NamedTuple

import gymnasium as gym
import matplotlib
import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor

from sb3_eqr import EqRSAC
from sb3_eqr.plot_style import GREY, INK, looks, styled

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.collections import LineCollection

ENV_ID = "HalfCheetah-v5"
AGENTS: dict[str, type[SAC]] = {"EqRSAC": EqRSAC, "SAC": SAC}
SETTINGS: dict[str, Any] = {
    "learning_rate": 1e-3,
    "batch_size": 64,
    "learning_starts": 2_000,
    "policy_kwargs": {"net_arch": [128, 128]},
}
ROWS = pathlib.Path(__file__).parents[1] / "docs" / "results" / "continuous_early.xz"
OF_ROWS = {"EqRSAC": "eqr_sac", "SAC": "sac"}
N_FRAMES, STEPS_PER_FRAME, FPS = 80, 2, 10  # of 0.05 s each: the film is as fast as the simulation
HALF_WIDTH, HEIGHT = 2.2, 1.5  # of the view, metres
SEED = 209  # of the ten seeds kept of both, that whose difference in the last 2,000 steps is nearest to their mean


class Run(NamedTuple):
    """T frames of an agent, each with G capsules."""

    ends: np.ndarray  # (T, G, 2, 2): the ends of each capsule, x and z, in metres
    radii: np.ndarray  # (G,), metres
    positions: np.ndarray  # (T,): how far the body has come, metres


def train(name: str, steps: int, seed: int, out: str) -> tuple[list[int], list[float]]:
    """Train one agent, save it, and return the last step of each episode and its return."""
    th.set_num_threads(1)
    env = Monitor(gym.make(ENV_ID))
    model = AGENTS[name]("MlpPolicy", env, seed=seed, buffer_size=steps, **SETTINGS)
    model.learn(steps, progress_bar=name == "EqRSAC")
    model.save(f"{out}/{name}")
    return np.cumsum(env.get_episode_lengths()).tolist(), env.get_episode_rewards()


def run(model: SAC, seed: int) -> Run:
    """Let an agent act without noise."""
    env = gym.make(ENV_ID)
    obs, _ = env.reset(seed=seed)
    simulation: Any = env.unwrapped
    is_capsule = simulation.model.geom_bodyid > 0  # the rest is the floor
    radii, half = simulation.model.geom_size[is_capsule, :2].T
    frames, positions = [], []
    for step in range(N_FRAMES * STEPS_PER_FRAME):
        if step % STEPS_PER_FRAME == 0:
            centre = simulation.data.geom_xpos[is_capsule]
            way = simulation.data.geom_xmat[is_capsule].reshape(-1, 3, 3)[:, :, 2] * half[:, None]  # along the capsule's axis
            frames.append(np.stack([centre - way, centre + way], axis=1)[:, :, [0, 2]])
            positions.append(simulation.data.qpos[0])
        obs, *_ = env.step(model.predict(obs, deterministic=True)[0])
    return Run(np.stack(frames), radii, np.array(positions))


def draw_curves(axes: Any, curves: dict[str, tuple[list[int], list[float]]], steps: int) -> None:
    """The returns in training, over the range of the runs that are kept."""
    kept = list(map(json.loads, lzma.open(ROWS, "rt"))) if ROWS.is_file() else []
    seeds = [{row["seed"] for row in kept if (row["arm"], row["task"]) == (arm, ENV_ID)} for arm in OF_ROWS.values()]
    shared = set.intersection(*seeds)
    for name, look in looks(list(AGENTS)).items():
        axes.plot(*curves[name], color=look.color, linestyle=look.line, linewidth=2, label=name)
        of_name = [row for row in kept if (row["arm"], row["task"]) == (OF_ROWS[name], ENV_ID)]
        runs = [row["training"] for row in of_name if row["seed"] in shared]
        if runs:
            scores = np.array([row["score"] for row in runs])
            band = scores.min(axis=0), scores.max(axis=0)
            axes.fill_between(runs[0]["step"], *band, color=look.color, alpha=0.15, linewidth=0)
    axes.set(xlabel="training steps", ylabel="return in training", xlim=(0, steps), xticks=range(0, steps + 1, 4_000))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:,.0f}")
    axes.set_title(ENV_ID, fontsize="medium")
    axes.margins(y=0.08)
    axes.legend(loc="upper left")
    axes.grid()


def draw(runs: dict[str, Run], curves: dict[str, tuple[list[int], list[float]]], steps: int, path: pathlib.Path) -> None:
    """Write the picture: the film on the left, the curves on the right."""
    with styled(), plt.rc_context({"font.size": 18, "legend.fontsize": 18}):
        figure = plt.figure(figsize=(9, 4.8), dpi=100, layout="constrained")
        worlds = figure.subplot_mosaic([[name, "curves"] for name in AGENTS], width_ratios=(4, 4))
        draw_curves(worlds.pop("curves"), curves, steps)
        bodies, labels, marks = {}, {}, {}
        for name, look in looks(list(AGENTS)).items():
            axes = worlds[name]
            axes.set(xlim=(-HALF_WIDTH, HALF_WIDTH), ylim=(-0.25, HEIGHT), aspect="equal", yticks=[])
            axes.set_xticks([])
            axes.spines["left"].set_visible(False)
            axes.spines["bottom"].set_visible(False)
            axes.axhline(0, color=GREY, linewidth=1)
            bodies[name] = axes.add_collection(LineCollection([], colors=look.color, capstyle="round"))
            labels[name] = axes.text(-HALF_WIDTH, HEIGHT, "", va="top", color=INK)
            marks[name] = [axes.text(0, -0.04, "", ha="center", va="top", color=INK) for _ in range(7)]

        def frame(t: int) -> list[Any]:
            for name, found in runs.items():
                here = found.positions[t]
                points = 72 / figure.dpi * np.diff(worlds[name].transData.transform([(0, 0), (1, 0)])[:, 0])[0]  # per metre
                bodies[name].set_segments(found.ends[t] - [here, 0])
                bodies[name].set_linewidths(2 * found.radii * points)
                labels[name].set_text(f"{name}: {round(here)} m after {t * STEPS_PER_FRAME * 0.05:.0f} s")
                for mark, metre in zip(marks[name], round(here) + np.arange(-3, 4), strict=True):
                    mark.set_x(metre - here)
                    mark.set_text(f"{metre:.0f} m" if abs(metre - here) < HALF_WIDTH - 0.5 and metre % 2 == 0 else "")
            return []

        figure.canvas.draw()  # the layout, on which the bodies' width in points depends
        figure.set_layout_engine("none")
        order = [N_FRAMES - 1, *range(N_FRAMES)]  # where a film does not play, the end shows
        FuncAnimation(figure, frame, frames=order).save(path, writer=PillowWriter(fps=FPS))
        plt.close(figure)


def main() -> None:
    """Train both agents at once, draw."""
    parser = argparse.ArgumentParser(
        description=__doc__.strip().split("\n")[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=12_000, help="environment steps, at least one episode of 1,000")
    parser.add_argument("--seed", type=int, default=SEED, help="seed of all random generators")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("demo_results/half_cheetah"), help="output folder")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    with multiprocessing.get_context("spawn").Pool(len(AGENTS)) as pool:
        found = pool.starmap(train, [(name, args.steps, args.seed, str(args.out)) for name in AGENTS])
    curves = dict(zip(AGENTS, found, strict=True))
    runs = {name: run(kind.load(args.out / name, device="cpu"), args.seed) for name, kind in AGENTS.items()}
    for name, (_, returns) in curves.items():
        print(f"{name}: return {np.mean(returns[-2:]):.0f} in the last two episodes, {runs[name].positions[-1]:.1f} m in 8 s")
    draw(runs, curves, args.steps, args.out / "demo.gif")
    print(args.out / "demo.gif")


if __name__ == "__main__":
    main()
