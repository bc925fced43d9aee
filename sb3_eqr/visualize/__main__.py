"""The command line: ``sb3-eqr visualize MODEL.zip``."""

import argparse
import os
import pathlib
from collections.abc import Mapping

import gymnasium as gym
from matplotlib.figure import Figure

from sb3_eqr import AGENTS
from sb3_eqr.common.checks.arguments import SuggestingParser
from sb3_eqr.common.off_policy import EqROffPolicy
from sb3_eqr.envs import import_packages
from sb3_eqr.visualize.diagnostics import diagnose
from sb3_eqr.visualize.latents import DEPTH, Play, encode, known_depth, names_of_factors, play
from sb3_eqr.visualize.loading import action_names, factor_names, load_model, make_env, parse_kwargs
from sb3_eqr.visualize.pictures import all_pictures, latent_figure, write_pictures
from sb3_eqr.visualize.tables import all_tables, write_tables

FLAGS = {"n_steps": "--steps", "depth": "--depth", "env": "--env"}  # argument of a function -> flag


def make_parser() -> argparse.ArgumentParser:
    """The parser of the command."""
    parser = SuggestingParser(prog="sb3-eqr visualize", description="Show what an agent's latent model has learned.")
    parser.add_argument("model", type=pathlib.Path, metavar="MODEL", help="a .zip file written by an agent's save")
    parser.add_argument("--env", help="gymnasium id (default: from RL Zoo's files next to MODEL)")
    parser.add_argument("--gym-packages", nargs="+", default=[], help="packages that register environments with gymnasium")
    parser.add_argument("--env-kwargs", nargs="+", default=[], metavar="KEY:VALUE", help="arguments of the environment")
    parser.add_argument("--algo", choices=list(AGENTS), help="default: detected from MODEL")
    parser.add_argument("--steps", type=int, default=1000, help="steps to run, over all environments (default: 1000)")
    parser.add_argument("--depth", type=int, help=f"number of steps to predict (default: the agent's, or {DEPTH} if it has 0)")
    parser.add_argument("--n-envs", type=int, default=1, help="number of environments (default: 1)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the environment and the agent's noise (default: 0)")
    parser.add_argument("--device", default="auto", help="PyTorch device (default: auto)")
    parser.add_argument("--deterministic", action="store_true", help="let the agent act without noise")
    parser.add_argument("--video", action="store_true", help="also write play.mp4 and play.gif")
    parser.add_argument("--trust", action="store_true", help="let MODEL and RL Zoo's files next to it name code that runs")
    parser.add_argument("--out", type=pathlib.Path, metavar="FOLDER", help="output folder (default: <MODEL>_diagnostics)")
    return parser


def run(args: argparse.Namespace) -> None:
    """Run the command; raises a ValueError for invalid arguments."""
    if args.n_envs < 1:
        raise ValueError(f"--n-envs must be >= 1, got {args.n_envs}.")
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # environments draw in memory: pygame needs no display
    import_packages(args.gym_packages)
    model = load_model(args.model, args.algo, args.device, args.trust)
    kwargs = parse_kwargs(args.env_kwargs)
    try:
        env = make_env(model, args.model, args.env, kwargs, args.n_envs, args.seed, args.video, args.trust, args.gym_packages)
        played = play(model, env, args.steps, args.depth, args.deterministic, args.seed)
    except ValueError as error:
        name, space, message = str(error).partition(" ")
        raise ValueError(f"{FLAGS.get(name, name)}{space}{message}") from error
    folder = args.out or args.model.with_name(f"{args.model.stem}_diagnostics")
    diagnostics = diagnose(model, played, args.seed)
    actions, factors = action_names(env, model), factor_names(env)
    periods = (env.get_attr("metadata", 0)[0] or {}).get("periods", {})
    tables = all_tables(diagnostics, actions, factors)
    write_tables(tables, folder)
    figures = all_pictures(diagnostics, actions, factors)
    write_pictures(figures | latent_figures(model, played, factors, periods), folder)
    if args.video:
        from sb3_eqr.visualize import record  # only videos need its libraries

        n_steps = max(200, 2 * known_depth(model, args.depth))
        record(model, env, folder / "play", n_steps, args.depth, seed=args.seed, deterministic=args.deterministic)
    print(diagnostics.summary)
    table = tables["transition"][["steps_ahead", "projection_error", "projection_shuffled", "projection_still"]]
    print(table.to_string(index=False, float_format="{:.2g}".format))
    print(f"Written: {folder}")


def latent_figures(model: EqROffPolicy, played: Play, factors: list[str], periods: Mapping[str, float]) -> dict[str, Figure]:
    """One figure coloured by time, or one per true factor; ``periods`` are those of the keys of ``info``."""
    states = encode(model, played.samples.observations)
    if played.factors is None:
        return {"latents": latent_figure(model, states)}
    names = names_of_factors(played.factors.shape[1], factors)
    return {
        f"latents_{name.replace(' ', '_')}": latent_figure(model, states, values, name, periods.get(name.split(" ")[0]))
        for name, values in zip(names, played.factors.T, strict=True)
    }


def main() -> None:
    """Parse the command line and run the command; an error exits with status 2 and without a traceback, as argparse does."""
    parser = make_parser()
    try:
        run(parser.parse_args())
    except (ValueError, ImportError, OSError, gym.error.Error) as error:
        parser.exit(2, f"{parser.prog}: {str(error).replace('trust=True', '--trust')}\n")


if __name__ == "__main__":
    main()
