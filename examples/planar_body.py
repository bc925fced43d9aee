"""
What EqRSAC's latent state learns about a body in the plane, driven by commands in its own frame: whether blocks of SE(2) turn
by the angle by which the body turns.

    python examples/planar_body.py                   # one seed, two minutes on an idle core
    python examples/planar_body.py --seeds 0 1 2

Writes a model per seed and a figure to --out, and prints a table. Finished seeds are not trained again.
"""

import argparse
import pathlib
from typing import Any

import matplotlib
import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env

from sb3_eqr import EqRSAC
from sb3_eqr.envs.planar_body import TURN
from sb3_eqr.plot_style import COLORS, styled
from sb3_eqr.visualize import diagnose, play
from sb3_eqr.visualize.latents import coordinates, split

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ENV_ID, N_STEPS, DEPTH = "PlanarBody-v0", 12_000, 5
KWARGS: dict[str, Any] = {"net_arch": [128, 128], "group": "SE(2)", "n_blocks": 2, "state_dependent_actions": False}
KWARGS |= {"reads_features": False, "latent_hidden_dim": 128, "features_extractor_kwargs": {"features_dim": 128}}
COMMANDS = np.linspace(-1, 1, 21, dtype=np.float32)
AXES = ("forward", "turn")


def train(path: pathlib.Path, seed: int) -> EqRSAC:
    """The agent of this seed, from its file if there is one."""
    if path.exists():
        return EqRSAC.load(path, device="cpu")
    model = EqRSAC(
        "MlpPolicy", ENV_ID, learning_rate=1e-3, batch_size=64, learning_starts=1_000, buffer_size=N_STEPS, seed=seed,
        policy_kwargs=KWARGS, device="cpu",
    )  # fmt: skip
    model.learn(N_STEPS)
    model.save(path)
    return model


def angles(model: EqRSAC, axis: int) -> np.ndarray:
    """The angle of κ(a) in each block, radians, (C, K), for C commands along one axis of the action."""
    actions = np.zeros((len(COMMANDS), len(AXES)), np.float32)
    actions[:, axis] = COMMANDS
    latent_model = model.policy.latent_model
    with th.no_grad():
        element = latent_model.action_element(th.zeros(len(actions), latent_model.state_dim), th.as_tensor(actions))
    (blocks,) = split(model, element.flatten(1))
    return coordinates(blocks.group, blocks.elements)[..., 0].double().numpy()


def draw(file: pathlib.Path, model: EqRSAC) -> None:
    """The angles of κ over commands, beside the angle by which the body turns."""
    turned = angles(model, AXES.index("turn"))[-1]
    sign = np.sign(turned[np.abs(turned).argmax()])  # which direction a block counts as positive is free
    with styled():
        figure, panels = plt.subplots(2, 1, figsize=(3.9, 4.8), layout="constrained")
        for axis, (panel, name) in enumerate(zip(panels, AXES, strict=True)):
            for k, values in enumerate(angles(model, axis).T):
                panel.plot(COMMANDS, values, color=COLORS[k], label=f"block {k}")
            panel.plot(COMMANDS, sign * TURN * COMMANDS * (axis == 1), color="black", linestyle=":", label="the body")
            panel.set(xlabel=f"command: {name}", ylim=(-1.5 * TURN, 1.5 * TURN))
        figure.supylabel("angle of κ(a), radians", fontsize="medium")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
        figure.savefig(file, dpi=200)
        plt.close(figure)


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("planar_body"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    print(f"angles of κ(a) in radians at the full command; the body turns by {TURN}")
    for seed in args.seeds:
        model = train(args.out / f"seed_{seed}.zip", seed)
        draw(args.out / f"seed_{seed}.png", model)
        forward, turn = (np.round(angles(model, axis)[-1], 3) for axis in range(len(AXES)))
        errors = diagnose(model, play(model, make_vec_env(ENV_ID, 2), n_steps=2_000, depth=DEPTH, seed=1_000)).transition
        print(f"seed {seed}: forward {forward}, turn {turn}, error / no motion {np.round(errors.error / errors.still, 2)}")


if __name__ == "__main__":
    main()
