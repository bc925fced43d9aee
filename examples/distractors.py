"""
The README's picture: a task where EqR helps, learned with EqR and without it, both at once.

    python examples/distractors.py    # about three minutes on two idle cores

Writes both models and demo.gif to --out. In the picture's left half the trained agent moves the white ball to the goal; the
orange ring is where its latent model predicted, three steps before, that the ball would be. The right half shows the goals
that both agents reached while they learned, over the range of ten seeds (docs/results/first_page.jsonl.xz).
"""

import argparse
import multiprocessing
import pathlib
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import torch as th
from matplotlib.animation import FuncAnimation, PillowWriter
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor

from sb3_eqr import EqRQRDQN, load_configuration
from sb3_eqr.benchmark.packed import read
from sb3_eqr.plot_style import COLORS, looks, styled
from sb3_eqr.visualize.film import predictions
from sb3_eqr.visualize.latents import encode

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ENV_ID = "SlidingBallDistractors-v0"
AGENTS: dict[str, dict[str, Any]] = {
    "with EqR": {},
    "without EqR": {"prediction_depth": 0, "policy_kwargs": {"group": None}},
}
ROWS = pathlib.Path(__file__).parents[1] / "docs" / "results" / "first_page.jsonl.xz"
OF_ROWS = {"with EqR": "eqr_qrdqn:aet_5", "without EqR": "eqr_qrdqn:plain"}
DEPTH, N_FRAMES, N_FITTED = 3, 90, 1_500  # steps ahead, frames of the film, observations that the read-out is fitted to
FPS = 5
SEED = 24  # of the ten seeds kept, the one whose difference is nearest to their mean


class Walk(NamedTuple):
    """T steps of an agent."""

    observations: np.ndarray  # (T, 1, size, size), uint8
    positions: np.ndarray  # (T, 2): where the ball is, in fractions of the loop
    actions: np.ndarray  # (T,), int64
    starts: np.ndarray  # (T,), int64: the step at which each step's episode began


def train(name: str, steps: int, seed: int, out: str) -> list[int]:
    """Train one agent, save it, and return the steps at which it reached the goal."""
    th.set_num_threads(1)
    settings = load_configuration("eqr_qrdqn", ENV_ID, **AGENTS[name])
    env = make_vec_env(ENV_ID, seed=seed)
    model = EqRQRDQN("CnnPolicy", env, seed=seed, **settings)
    model.learn(steps, progress_bar=name == "with EqR")
    model.save(f"{out}/{name}")
    monitor: Monitor = env.envs[0]  # type: ignore[attr-defined]
    ends = np.cumsum(monitor.get_episode_lengths())
    return [int(end) for end, score in zip(ends, monitor.get_episode_rewards(), strict=True) if score > 0]


def walk(model: EqRQRDQN, n_steps: int, seed: int, deterministic: bool) -> Walk:
    """Let an agent act; random actions if it is not deterministic."""
    env, rng = make_vec_env(ENV_ID, seed=seed), np.random.default_rng(seed)
    obs, start, rows = env.reset(), 0, []
    position = env.reset_infos[0]["position"]
    for step in range(n_steps):
        seen = np.moveaxis(obs, -1, 1)
        action = model.predict(seen, deterministic=True)[0] if deterministic else rng.integers(4, size=1)
        rows.append((seen[0], position, int(action[0]), start))
        obs, _, dones, infos = env.step(action)
        position = env.reset_infos[0]["position"] if dones[0] else infos[0]["position"]
        start = step + 1 if dones[0] else start
    return Walk(*map(np.array, zip(*rows, strict=True)))


def ball_as_predicted(model: EqRQRDQN, film: Walk) -> np.ndarray:
    """
    Where the latent model predicted the ball ``DEPTH`` steps before, read out of the predicted latent states by a linear
    function that is fitted to other episodes: (T, 2), in fractions of the loop; NaN in the first steps of an episode.
    """
    known = walk(model, N_FITTED, seed=1, deterministic=False)
    predicted, shown = (_ahead(model, one) for one in (known, film))  # (T, D + 1)
    angles, is_known = 2 * np.pi * known.positions, np.isfinite(predicted).all(axis=1)
    wanted = np.concatenate([np.cos(angles), np.sin(angles)], axis=1)
    read_out = np.linalg.lstsq(predicted[is_known], wanted[is_known], rcond=1e-4)[0]
    cosine, sine = np.split(shown @ read_out, 2, axis=1)
    return np.mod(np.arctan2(sine, cosine) / (2 * np.pi), 1)


def _ahead(model: EqRQRDQN, seen: Walk) -> np.ndarray:
    """The latent states that were predicted ``DEPTH`` steps before, and a column of ones, (T, D + 1)."""
    states = encode(model, th.as_tensor(seen.observations))
    ahead = predictions(model, states, seen.actions, seen.starts, DEPTH).double().numpy()
    return np.pad(ahead, ((0, 0), (0, 1)), constant_values=1)


def draw(
    goals: dict[str, list[int]], film: Walk, ghosts: np.ndarray, goal: np.ndarray, steps: int, path: pathlib.Path
) -> None:
    """Write the picture: the film on the left, the curves on the right."""
    size = film.observations.shape[-1]
    with styled(), plt.rc_context({"font.size": 12}):
        figure, (world, curves) = plt.subplots(1, 2, figsize=(9, 4), dpi=100, layout="constrained", width_ratios=(4, 5))
        x = np.arange(steps + 1)
        kept = read(ROWS)[1] if ROWS.is_file() else []
        for name, look in looks(list(AGENTS)).items():
            curve = np.searchsorted(goals[name], x, side="right")
            curves.plot(x, curve, color=look.color, linestyle=look.line, linewidth=2, label=f"{name}: {curve[-1]} goals")
            runs = [row["training"] for row in kept if row["agent"] == OF_ROWS[name]]
            if runs:
                ends = [np.array(run["step"])[np.array(run["score"]) > 0] for run in runs]
                kept_curves = np.stack([np.searchsorted(one, x, side="right") for one in ends])
                curves.fill_between(
                    x, kept_curves.min(axis=0), kept_curves.max(axis=0), color=look.color, alpha=0.15, linewidth=0
                )
        curves.set(xlabel="environment steps", ylabel="goals reached so far", xlim=(0, steps), ylim=(0, None))
        curves.legend(loc="upper left")
        curves.grid()
        world.set_axis_off()
        picture = world.imshow(film.observations[0, 0], cmap="gray", vmin=0, vmax=255)
        world.set(xlim=(-0.5, size - 0.5), ylim=(size - 0.5, -0.5))
        around = [(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1)]  # the image is a torus
        ring = {"fill": False, "linewidth": 2.5}
        circles = {}
        for label, color in (("goal", COLORS[2]), (f"predicted {DEPTH} steps before", COLORS[4])):
            circles[label] = [world.add_patch(plt.Circle((-99, -99), size / 8 + 0.5, color=color, **ring)) for _ in around]
            world.plot([], [], "o", color=color, mfc="none", mew=2, label=label)
        world.legend(loc="upper center", bbox_to_anchor=(0.5, -0.01), ncols=2, fontsize=11, handletextpad=0.2)

        def place(name: str, position: np.ndarray) -> None:
            for circle, (row, column) in zip(circles[name], around, strict=True):
                circle.center = (size * (position[1] + column) - 0.5, size * (position[0] + row) - 0.5)

        def frame(t: int) -> list[Any]:
            picture.set_data(film.observations[t, 0])
            place("goal", goal)
            place(f"predicted {DEPTH} steps before", np.nan_to_num(ghosts[t], nan=-99))
            return []

        FuncAnimation(figure, frame, frames=len(film.actions)).save(path, writer=PillowWriter(fps=FPS))
        plt.close(figure)


def main() -> None:
    """Train both agents at once, draw."""
    parser = argparse.ArgumentParser(
        description=__doc__.strip().split("\n")[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=8_000, help="environment steps")
    parser.add_argument("--seed", type=int, default=SEED, help="seed of all random generators")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("demo_results/distractors"), help="output folder")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    with multiprocessing.get_context("spawn").Pool(len(AGENTS)) as pool:
        found = pool.starmap(train, [(name, args.steps, args.seed, str(args.out)) for name in AGENTS])
    goals = dict(zip(AGENTS, found, strict=True))
    for name, reached in goals.items():
        print(f"{name}: {len(reached)} goals in {args.steps} steps")
    th.set_num_threads(1)
    model = EqRQRDQN.load(args.out / "with EqR", device="cpu")
    film = walk(model, N_FRAMES, seed=2, deterministic=True)
    ghosts = ball_as_predicted(model, film)
    way = np.abs(ghosts - film.positions)
    error = np.linalg.norm(np.minimum(way, 1 - way), axis=1)
    print(f"the ball {DEPTH} steps ahead: median error {np.nanmedian(error):.3f} of the image's side")
    goal = np.array([0.25, 0.25])
    draw(goals, film, ghosts, goal, args.steps, args.out / "demo.gif")
    print(args.out / "demo.gif")


if __name__ == "__main__":
    main()
