"""The command line: ``sb3-eqr visualize MODEL.zip``."""

import argparse
import pathlib
import sys
from typing import NoReturn

import gymnasium as gym
from matplotlib.figure import Figure
from stable_baselines3.common.vec_env import VecEnv

from sb3_eqr import AGENTS
from sb3_eqr.common.eqr_algorithm import EqRAlgorithm
from sb3_eqr.visualize.diagnostics import diagnose
from sb3_eqr.visualize.latents import Play, encode, play
from sb3_eqr.visualize.loading import action_names, factor_names, load_model, make_env, parse_kwargs
from sb3_eqr.visualize.pictures import all_pictures, latent_figure, write_pictures
from sb3_eqr.visualize.tables import all_tables, write_tables
from sb3_eqr.visualize.tables import factor_names as all_names

DEPTH = 5  # where the agent has no latent losses
FLAGS = {"n_steps": "--steps", "depth": "--depth"}  # what an argument of play is called here


def make_parser() -> argparse.ArgumentParser:
    """
    :return: of the command
    """
    parser = argparse.ArgumentParser(prog="sb3-eqr visualize", description="What an agent's latent model has learned.")
    parser.add_argument("model", type=pathlib.Path, metavar="MODEL", help="a .zip file that an agent's save wrote")
    parser.add_argument("--env", help="of gymnasium (default: what RL Zoo wrote beside MODEL)")
    parser.add_argument("--env-kwargs", nargs="+", default=[], metavar="KEY:VALUE", help="of the environment's constructor")
    parser.add_argument("--algo", choices=list(AGENTS), help="(default: found out from MODEL)")
    parser.add_argument("--steps", type=int, default=1000, help="of play, over all environments (default: 1000)")
    parser.add_argument("--depth", type=int, help=f"how many steps to predict (default: the agent's, {DEPTH} where it has 0)")
    parser.add_argument("--n-envs", type=int, default=1, help="number of environments (default: 1)")
    parser.add_argument("--seed", type=int, default=0, help="of the environment and of the agent's noise (default: 0)")
    parser.add_argument("--device", default="auto", help="of PyTorch (default: auto)")
    parser.add_argument("--deterministic", action="store_true", help="let the agent act without noise")
    parser.add_argument("--video", action="store_true", help="also write play.mp4 and play.gif")
    parser.add_argument("--trust", action="store_true", help="let MODEL, and what RL Zoo wrote beside it, name code that runs")
    parser.add_argument("--out", type=pathlib.Path, metavar="FOLDER", help="(default: MODEL without .zip, and _diagnostics)")
    return parser


def run(args: argparse.Namespace) -> None:
    """
    :param args: of the command
    :raises ValueError: for wrong use
    """
    if args.n_envs < 1:
        raise ValueError(f"--n-envs: expected at least 1, found {args.n_envs}")
    model = load_model(args.model, args.algo, args.device, args.trust)
    kwargs = parse_kwargs(args.env_kwargs)
    env = make_env(model, args.model, args.env, kwargs, args.n_envs, args.seed, args.video, args.trust)
    depth = args.depth if args.depth is not None else model.prediction_depth or DEPTH
    try:
        played = play(model, env, args.steps, depth, args.deterministic, args.seed)
    except ValueError as error:
        name, space, message = str(error).partition(" ")
        raise ValueError(f"{FLAGS.get(name, name)}{space}{message}") from error
    folder = args.out or args.model.with_name(f"{args.model.stem}_diagnostics")
    diagnostics = diagnose(model, played, args.seed)
    actions, factors = action_names(env, model.policy.latent_model.n_actions), factor_names(env)
    tables = all_tables(diagnostics, actions, factors)
    write_tables(tables, folder)
    figures = all_pictures(diagnostics, actions, factors)
    write_pictures({**figures, **latent_figures(model, played, factors)}, folder)
    if args.video:
        write_video(model, env, folder, depth, args)
    print(diagnostics.summary)
    table = tables["transition"][["steps_ahead", "loss", "loss_shuffled", "loss_still"]]
    print(table.to_string(index=False, float_format="{:.2g}".format))
    print(f"Written: {folder}")


def latent_figures(model: EqRAlgorithm, played: Play, factors: list[str]) -> dict[str, Figure]:
    """
    :param factors: names of the true factors, where known
    :return: coloured by time, or by the first factor; then one for each further factor
    """
    states = encode(model, played.samples.observations)
    if played.factors is None:
        return {"latents": latent_figure(model, states)}
    names = all_names(played.factors.shape[1], factors)
    return {
        "latents" if i == 0 else f"latents_{name.replace(' ', '_')}": latent_figure(model, states, played.factors[:, i], name)
        for i, name in enumerate(names)
    }


def write_video(model: EqRAlgorithm, env: VecEnv, folder: pathlib.Path, depth: int, args: argparse.Namespace) -> None:
    """
    :param folder: where play.mp4 and play.gif are written
    """
    from sb3_eqr.visualize.animation import record  # its libraries are needed for this alone

    record(model, env, folder / "play", depth=depth, seed=args.seed, deterministic=args.deterministic)


def fail(message: str) -> NoReturn:
    """Tell what is wrong, without a traceback, and leave with status 2 as argparse does."""
    print(f"sb3-eqr visualize: {message}", file=sys.stderr)
    raise SystemExit(2)


def main() -> None:
    """Parse the command line and do what it says."""
    args = make_parser().parse_args()
    try:
        run(args)
    except (ValueError, ImportError, OSError, gym.error.Error) as error:
        fail(str(error))


if __name__ == "__main__":
    main()
