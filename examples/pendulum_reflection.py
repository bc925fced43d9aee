"""
Example 1 of the paper: does ρ negate the torque of a pendulum without gravity when the environment is mirrored?

    python examples/pendulum_reflection.py --seeds 0 1      # a table of docs/results/representation.md, some minutes per group

For pairs of a state and its mirror image, ρ(τ_g) κ(s, a) is compared with κ at the mirrored state for the same torque and for
the opposite one: the distance between the states to which they move the mirrored state, relative to that between the two
torques. Ideally it is 0 to the torque that ρ gives and 1 to the other.
"""

import argparse
import json
import pathlib
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env

from sb3_eqr import EqRQRDQN
from sb3_eqr.envs import PixelPendulum
from sb3_eqr.representation import train_representation
from sb3_eqr.visualize.diagnostics import diagnose
from sb3_eqr.visualize.latents import encode, play

GROUPS = {"SO(2)": 4, "SE(2)": 4, "GL(2)": 4}
N_STATES = 512


def images(world: PixelPendulum, angles: np.ndarray, velocities: np.ndarray) -> th.Tensor:
    """
    :return: (N, 2, size, size), uint8
    """
    drawn = [np.moveaxis(world.draw(a, v), -1, 0) for a, v in zip(angles, velocities, strict=True)]
    return th.as_tensor(np.stack(drawn))


def measure(model: EqRQRDQN, world: PixelPendulum, seed: int) -> dict[str, Any]:
    """Compare where ρ(τ_g) κ(s, a) and the two torques move the mirrored state."""
    rng = np.random.default_rng(seed)
    angles, velocities = rng.uniform(-np.pi, np.pi, N_STATES), rng.uniform(-4, 4, N_STATES)
    x = encode(model, images(world, angles, velocities))  # (N, D)
    mirrored = encode(model, images(world, -angles, -velocities))
    latent_model, group = model.policy.latent_model.eval(), model.policy.latent_model.group
    clockwise, other = (
        model.policy.embed_actions(th.tensor([0, latent_model.action_dim - 1])).repeat_interleave(N_STATES, dim=0).chunk(2)
    )  # opposite torques
    with th.no_grad():
        symmetry = group.compose(latent_model.blocks(mirrored), group.inverse(latent_model.blocks(x)))  # τ_g
        rho = latent_model.element(latent_model.action_symmetry(symmetry.flatten(1)))
        torque = latent_model.action_element(x, clockwise)
        by_rho = latent_model.act(group.compose(rho, torque), mirrored)
        without = latent_model.act(torque, mirrored)
        same = latent_model.act(latent_model.action_element(mirrored, clockwise), mirrored)
        opposite = latent_model.act(latent_model.action_element(mirrored, other), mirrored)
    gap = (same - opposite).square().sum(dim=1).mean().sqrt()

    def distance(one: th.Tensor, two: th.Tensor) -> float:
        return round(((one - two).square().sum(dim=1).mean().sqrt() / gap).item(), 2)

    nearer = ((by_rho - opposite).norm(dim=1) < (by_rho - same).norm(dim=1)).float().mean().item()
    return {
        "rho_to_same_torque": distance(by_rho, same),
        "rho_to_opposite_torque": distance(by_rho, opposite),
        "without_rho_to_same": distance(without, same),
        "without_rho_to_opposite": distance(without, opposite),
        "nearer_to_opposite": round(nearer, 2),
        "rho_from_identity": round((rho - group.identity()).flatten(2).norm(dim=2).mean().item(), 3),
    }


def main() -> None:
    """Train one representation per group and seed, with the GET loss, and measure."""
    parser = argparse.ArgumentParser(
        description=__doc__.strip().split("\n")[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--groups", nargs="+", choices=GROUPS, default=list(GROUPS), help="groups of the blocks")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="seeds of all random generators")
    parser.add_argument("--steps", type=int, default=5_500, help="steps of random actions")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("results/pendulum.jsonl"), help="output file")
    args = parser.parse_args()
    th.set_num_threads(1)  # small networks are slower with two
    args.out.parent.mkdir(parents=True, exist_ok=True)
    for group in args.groups:
        for seed in args.seeds:
            world = PixelPendulum(gravity=False)
            envs = make_vec_env("PixelPendulum-v0", 16, seed, env_kwargs={"gravity": False})
            model = train_representation(
                envs,
                group,
                n_blocks=GROUPS[group],
                total_timesteps=args.steps,
                symmetry_coef=1.0,
                state_dependent_actions=True,  # the effect of a torque on the angle depends on the velocity
                seed=seed,
                device="cpu",
            )
            env = make_vec_env("PixelPendulum-v0", 1, seed + 100, env_kwargs={"gravity": False})
            diagnostics = diagnose(model, play(model, env, n_steps=500))
            symmetry = diagnostics.action_symmetry
            assert symmetry is not None
            result = {
                "group": group,
                "seed": seed,
                "steps": args.steps,
                "skill": np.round(diagnostics.transition.skill, 3).tolist(),
                "get": round(symmetry.distance, 4),
                "get_without_rho": round(symmetry.identity, 4),
                "get_shuffled": round(symmetry.shuffled, 4),
                **measure(model, world, seed),
            }
            print(json.dumps(result), flush=True)
            with args.out.open("a") as file:
                file.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
