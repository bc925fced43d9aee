"""
A custom group: the affine group of the plane, given by its six generators, learned on a ball that slides over a torus.

    python examples/affine_group.py          # two minutes

Writes model.zip, actions.csv and affine_group.png (what each action does to a square, and the latent states) to --out.
"""

import argparse
import pathlib

import matplotlib
import numpy as np
import pandas as pd
import torch as th
from stable_baselines3.common.env_util import make_vec_env

from sb3_eqr import EqRQRDQN, MatrixLieGroup
from sb3_eqr.representation import train_representation
from sb3_eqr.visualize.diagnostics import diagnose
from sb3_eqr.visualize.latents import action_elements, coordinate_names, coordinates, encode, frame, play, split

matplotlib.use("Agg")
import matplotlib.pyplot as plt

# x -> A x + t as the matrix [[A, t], [0, 1]]: one generator per free entry, row by row.
GENERATORS = np.zeros((6, 3, 3))
for number, (row, column) in enumerate([(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)]):
    GENERATORS[number, row, column] = 1.0
N_BLOCKS = 2
ACTIONS = ("up", "down", "left", "right")
SQUARE = np.array([[0, 1, 1, 0, 0], [0, 0, 1, 1, 0]]) - 0.5  # around the origin


def draw(model: EqRQRDQN, states: th.Tensor, positions: np.ndarray, path: pathlib.Path) -> None:
    """
    :param states: (N, D)
    :param positions: positions of the ball in these states, (N, 2)
    """
    blocks = split(model, states)[0]
    linear, shift = frame(blocks.group, blocks.elements)  # (N, K, 2, 2), (N, K, 2)
    moves = split(model, action_elements(model, states[:1]))[0]  # κ(a), (1, A, K, 2, 3)
    turned, moved = frame(moves.group, moves.elements)
    assert linear is not None and shift is not None and turned is not None and moved is not None
    figure, panels = plt.subplots(N_BLOCKS, 3, figsize=(11, 3.3 * N_BLOCKS), layout="constrained", squeeze=False)
    for k, row in enumerate(panels):
        row[0].plot(*SQUARE, color="0.6", linestyle=":", label="a square")
        for a, name in enumerate(ACTIONS):
            row[0].plot(*(turned[0, a, k].numpy() @ SQUARE + moved[0, a, k].numpy()[:, None]), label=name)
        row[0].set(title=f"block {k}: what actions do", aspect="equal")
        row[0].legend(fontsize="x-small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
        for panel, axis in zip(row[1:], ("vertical", "horizontal"), strict=True):
            colours = positions[:, int(axis == "horizontal")]
            shown = panel.scatter(*shift[:, k].numpy().T, c=colours, cmap="twilight", s=6)
            panel.set(title=f"block {k}: t of the states", aspect="equal")
            figure.colorbar(shown, label=f"{axis} position")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Train, save, tabulate, draw."""
    parser = argparse.ArgumentParser(
        description=__doc__.strip().split("\n")[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=5_500, help="steps of random actions")
    parser.add_argument("--seed", type=int, default=0, help="seed of all random generators")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("results/affine_group"), help="output folder")
    args = parser.parse_args()
    th.set_num_threads(1)  # small networks are slower with two
    args.out.mkdir(parents=True, exist_ok=True)
    env = make_vec_env("SlidingBallTorus-v0", 16, args.seed)
    group = MatrixLieGroup(GENERATORS)
    model = train_representation(env, group, N_BLOCKS, total_timesteps=args.steps, seed=args.seed, device="cpu")
    model.save(args.out / "model")  # the file includes the generators

    seen = play(model, make_vec_env("SlidingBallTorus-v0", 4, args.seed + 100), n_steps=1_200)
    print(diagnose(model, seen).summary)
    states = encode(model, seen.samples.observations)
    moves = split(model, action_elements(model, states[:1]))[0]
    table = pd.DataFrame(
        coordinates(moves.group, moves.elements)[0].flatten(0, 1).numpy().round(3),
        index=pd.MultiIndex.from_product([ACTIONS, range(N_BLOCKS)], names=["action", "block"]),
        columns=coordinate_names(group),
    )
    print(table)
    table.to_csv(args.out / "actions.csv")
    assert seen.factors is not None
    draw(model, states, seen.factors, args.out / "affine_group.png")
    print(f"{args.out}/model.zip, {args.out}/actions.csv, {args.out}/affine_group.png")


if __name__ == "__main__":
    main()
