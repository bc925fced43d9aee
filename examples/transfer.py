"""
Does a representation help with another task? A ball on a torus with two goals: the dynamics are the same, the rewards differ.

    python examples/transfer.py --seeds 0 1 2 3 4      # a table of docs/results/representation.md, an hour on one thread

For each seed, an agent learns goal A; agents for goal B start from scratch, from A's representation (also frozen), and from
one that was learned without a goal. Writes models, evaluations and results.jsonl to --out; finished runs are not repeated.
"""

import argparse
import json
import pathlib
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecTransposeImage

from sb3_eqr import EqRQRDQN
from sb3_eqr.representation import train_representation

GOALS = {"A": [0.25, 0.25], "B": [0.75, 0.5]}
N_STEPS = 8  # around the torus, along each axis: 64 positions
STATES: dict[str, Any] = {"group": "SO(2)", "n_blocks": 2, "parameterization": "gram-schmidt", "whiten": True}
STATES |= {"state_dependent_actions": False, "head_input": "state", "layer_norm": False}  # as in train_representation
ARMS = ("scratch", "transferred", "transferred, frozen", "without a goal, frozen")
EVAL_EPISODES = 25


def make_env(goal: str | None, n_envs: int, seed: int) -> Any:
    """A torus with a goal and episodes of at most 50 steps; a shortest path has 4 steps on average, at most 8."""
    kwargs = {"n_steps": N_STEPS, "goal": None if goal is None else GOALS[goal], "max_episode_steps": 50}
    return VecTransposeImage(make_vec_env("SlidingBallTorus-v0", n_envs, seed, env_kwargs=kwargs))


def make_agent(goal: str, seed: int, frozen: bool) -> EqRQRDQN:
    """The same settings for every arm; frozen representations need no transition losses."""
    return EqRQRDQN(
        "CnnPolicy",
        make_env(goal, 1, seed),
        learning_rate=5e-4,
        buffer_size=10_000,
        learning_starts=300,
        gradient_steps=1,
        n_steps=3,
        aet_coef=0.0 if frozen else 5.0,
        symmetry_coef=0.0,
        exploration_fraction=0.15,
        shift_pixels=0,
        policy_kwargs={**STATES, "aet_loss": "contrastive", "projection": "none"},
        seed=seed,
    )


def run(goal: str, arm: str, seed: int, steps: int, out: pathlib.Path) -> dict[str, Any]:
    """Train one agent and return its evaluations during training."""
    frozen = arm.endswith("frozen")
    model = make_agent(goal, seed, frozen)
    if arm.startswith("transferred"):
        model.load_representation(out / f"A-scratch-{seed}.zip", freeze=frozen)
    elif arm.startswith("without"):
        donor = out / f"none-{seed}.zip"
        if not donor.exists():
            train_representation(
                make_env(None, 16, seed), STATES["group"], STATES["n_blocks"], state_dependent_actions=False, seed=seed
            ).save(donor)
        model.load_representation(donor, freeze=True)
    evaluation = make_env(goal, 5, seed + 1_000)
    folder = out / f"{goal}-{arm}-{seed}".replace(", ", "-").replace(" ", "_")
    every = EvalCallback(evaluation, eval_freq=steps // 10, n_eval_episodes=EVAL_EPISODES, log_path=str(folder), verbose=0)
    model.learn(steps, callback=every)
    model.save(folder)
    found = np.load(folder / "evaluations.npz")
    reached = found["results"].mean(axis=1)  # (evaluations,)
    return {
        "goal": goal,
        "arm": arm,
        "seed": seed,
        "steps": steps,
        "evaluated_at": found["timesteps"].tolist(),
        "reached": np.round(reached, 2).tolist(),
        "length": np.round(found["ep_lengths"].mean(axis=1), 1).tolist(),
        "area": round(float(reached.mean()), 3),
    }


def table(results: list[dict[str, Any]]) -> str:
    """
    :return: a Markdown table with mean and standard deviation over seeds per arm; the last column is paired by seed
    """
    rows = ["| goal | start | seeds | mean of all evaluations | last three | more than from scratch |", "|---" * 6 + "|"]
    areas = {(run["goal"], run["arm"], run["seed"]): run["area"] for run in results}
    for goal, arm in dict.fromkeys((run["goal"], run["arm"]) for run in results):
        runs = [run for run in results if (run["goal"], run["arm"]) == (goal, arm)]
        paired = np.array([run["area"] - areas[goal, "scratch", run["seed"]] for run in runs])
        last = np.array([np.mean(run["reached"][-3:]) for run in runs])
        area = np.array([run["area"] for run in runs])
        more = "" if arm == "scratch" else f"{paired.mean():+.2f} ± {paired.std(ddof=1):.2f}"
        figures = " | ".join(f"{values.mean():.2f} ± {values.std(ddof=1):.2f}" for values in (area, last))
        rows.append(f"| {goal} | {arm} | {len(runs)} | {figures} | {more} |")
    return "\n".join(rows)


def main() -> None:
    """Train goal A from scratch, then goal B in every arm."""
    parser = argparse.ArgumentParser(
        description=__doc__.strip().split("\n")[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="seeds of all random generators")
    parser.add_argument("--steps", type=int, default=3_000, help="training steps of each agent")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("results/transfer"), help="output folder")
    args = parser.parse_args()
    th.set_num_threads(1)  # small networks are slower with two
    args.out.mkdir(parents=True, exist_ok=True)
    results = args.out / "results.jsonl"
    lines = results.read_text().splitlines() if results.exists() else []
    done = {tuple(json.loads(line)[key] for key in ("goal", "arm", "seed", "steps")) for line in lines}
    for seed in args.seeds:
        for goal, arm in [("A", "scratch"), *(("B", arm) for arm in ARMS)]:
            if (goal, arm, seed, args.steps) not in done:
                line = json.dumps(run(goal, arm, seed, args.steps, args.out))
                print(line, flush=True)
                with results.open("a") as file:
                    file.write(line + "\n")
    found = [json.loads(line) for line in results.read_text().splitlines()]
    print(table([run for run in found if run["steps"] == args.steps]))


if __name__ == "__main__":
    main()
