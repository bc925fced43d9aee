"""The command line: thin wrappers of RL Zoo's functions."""

import argparse
import errno
import importlib
import pathlib
import runpy
import shlex
import sys
from functools import partial
from typing import Any

import gymnasium as gym
import yaml
from huggingface_sb3 import EnvironmentName
from rl_zoo3 import train
from rl_zoo3.utils import ALGOS, StoreDict, get_model_path

from sb3_eqr.common.checks.arguments import nearest
from sb3_eqr.common.saving.checkpoints import read_manifest
from sb3_eqr.common.saving.files import temporary_folder
from sb3_eqr.configurations import configuration_files
from sb3_eqr.trust import check_statistics, check_zoo_folder
from sb3_eqr.zoo import AGENTS, register
from sb3_eqr.zoo.checks import check_device, check_environment, fail, failing
from sb3_eqr.zoo.entries import check_entry, entry_name, read_entry, read_file
from sb3_eqr.zoo.registration import trust_files
from sb3_eqr.zoo.resuming import FOLDER, ResumableExperiment, checkpoints_of, config_of

# Each command is a module of RL Zoo with a function of the same name, or a script.
PLOTS = ("plot_train", "plot_from_file", "all_plots")
SCRIPTS = ("record_video", "push_to_hub", "load_from_hub")
LOADING = ("enjoy", "record_video", "push_to_hub")
# Errors of RL Zoo that may have a cause which the user can remove.
MISTAKES = (ImportError, NotImplementedError, AssertionError, ValueError, TypeError, OSError)
UNWRITABLE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM)
DOWNLOADS = "rl-trained-agents"  # enjoy's default folder, also for downloads

# Packages of the extra "zoo".
EXTRA = ("seaborn", "rliable", "scipy", "pytablewriter", "matplotlib", "pandas", "moviepy", "minatar", "Box2D", "pygame")

RESUMING = """train with an agent of this package also takes --checkpoint-every STEPS, which writes checkpoints into the run's
folder, and --resume FOLDER, which resumes a run from its last one; add --trust if its settings contain Python objects
"""


def find_hyperparameters(algo: str, conf_file: str | None) -> str | None:
    """
    :param conf_file: value of ``--conf-file``: a path, or the name of one of our files
    :return: the file to use; ``None``: RL Zoo's
    """
    files = configuration_files()
    if conf_file is None:
        return str(files[algo]) if algo in AGENTS else None
    if conf_file in files and not pathlib.Path(conf_file).is_file():
        return str(files[conf_file])
    return conf_file


def own_parser() -> argparse.ArgumentParser:
    """A parser of the arguments that RL Zoo does not have."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--checkpoint-every", type=int)
    parser.add_argument("--resume", type=pathlib.Path)
    parser.add_argument("--trust", action="store_true")
    return parser


def parse(arguments: list[str]) -> argparse.Namespace:
    """:return: the arguments that are checked here; RL Zoo parses all arguments again"""
    parser = argparse.ArgumentParser(add_help=False, parents=[own_parser()])
    parser.add_argument("--algo", default="ppo")
    parser.add_argument("-n", "--n-timesteps", type=int, default=-1)
    parser.add_argument("--env", default="CartPole-v1")
    parser.add_argument("-conf", "--conf-file")
    parser.add_argument("-params", "--hyperparams", nargs="+", action=StoreDict, default={})
    parser.add_argument("--env-kwargs", nargs="+", action=StoreDict, default={})
    parser.add_argument("-name", "--repo-name")  # of the hub; otherwise argparse reads -n ame
    parser.add_argument("--device", default="auto")
    parser.add_argument("-i", "--trained-agent", default="")
    parser.add_argument("--gym-packages", nargs="+", default=[])
    parser.add_argument("-f", "--folder", default=DOWNLOADS)
    parser.add_argument("--exp-id", type=int, default=0)
    parser.add_argument("--load-best", action="store_true")
    parser.add_argument("--load-checkpoint")
    parser.add_argument("--load-last-checkpoint", action="store_true")
    parser.add_argument("--seed", type=int, default=-1)
    parser.add_argument("-optimize", "--optimize-hyperparameters", action="store_true")
    try:
        return parser.parse_known_args(arguments)[0]
    except (NameError, SyntaxError) as error:
        fail(f"--hyperparams must be key:value with Python values (strings in quotes), got an invalid one: {error}")


def prepare_training(args: argparse.Namespace) -> str | None:
    """Check the arguments of ``train``. Returns the file of hyperparameters to use; ``None``: RL Zoo's."""
    path = find_hyperparameters(args.algo, args.conf_file)
    check_environment(args.env, args.gym_packages)
    check_device(args.device)
    if args.n_timesteps == 0:
        fail("-n must be >= 1 step, or -1 for the number in the file, got 0.")
    if args.trained_agent and not args.trust:
        with failing():
            check_statistics(pathlib.Path(args.trained_agent).parent / EnvironmentName(args.env) / "vecnormalize.pkl")
    if path is None:
        check_entry(args.hyperparams, args.algo, "--hyperparams")
        return None
    if args.resume is not None:
        with failing("--resume: "):
            of_run = config_of(args.resume, args.trust, args.gym_packages)
        path = path if of_run is None else write_entry(args, of_run)
    # as in RL Zoo, --env-kwargs replace those of the entry
    changes = {**args.hyperparams, **({"env_kwargs": args.env_kwargs} if args.env_kwargs else {})}
    entry = read_entry(path, args.env, changes)
    check_entry(entry, args.algo, f"{path} with --hyperparams" if args.hyperparams else path)
    register(policy_kwargs=entry.get("policy_kwargs"))
    name = entry_name(read_file(path), args.env, changes)
    if not name.startswith("default-"):  # RL Zoo would use "default"
        return path
    print(f"Using the section {name!r} of {path}")
    return write_entry(args, entry)


def write_entry(args: argparse.Namespace, entry: dict[str, Any]) -> str:
    """:return: a new file with an entry for the environment, in Python, because it may hold objects"""
    file = temporary_folder() / f"{args.algo}.py"
    file.write_text(f"import yaml\nhyperparams = yaml.unsafe_load({yaml.dump({args.env: entry})!r})\n", encoding="utf-8")
    return str(file)


def prepare_resuming(args: argparse.Namespace) -> list[str]:
    """Check ``--checkpoint-every`` and ``--resume`` of ``train``, and make RL Zoo apply them. Returns arguments to add."""
    is_asked = args.checkpoint_every is not None or args.resume is not None
    if is_asked and args.algo not in AGENTS:
        fail(f"--algo must be {' or '.join(AGENTS)} with --checkpoint-every or --resume, got {args.algo}.")
    if args.checkpoint_every is not None and args.checkpoint_every < 1:
        fail(f"--checkpoint-every must be >= 1 step, got {args.checkpoint_every}.")
    if args.optimize_hyperparameters and is_asked:
        fail("--checkpoint-every and --resume are for single runs, got a search (-optimize).")
    seed = None
    if args.resume is not None:
        if args.hyperparams or args.trained_agent or args.seed != -1:
            fail("--resume uses the settings and seed of the run: leave out --hyperparams, --trained-agent and --seed.")
        with failing("--resume: "):
            _, manifest = read_manifest(checkpoints_of(args.resume))
        seed = manifest["settings"].get("seed")
    train.ExperimentManager = partial(ResumableExperiment, given=args)  # type: ignore[misc, assignment]
    return [] if seed is None else ["--seed", str(seed)]  # RL Zoo shows and stores it, and would draw one


def check_runs(arguments: list[str]) -> None:
    """Exit with a message if ``all_plots`` would draw nothing."""
    parser = argparse.ArgumentParser(add_help=False)
    for flags in (("-a", "--algos"), ("-e", "--env"), ("-f", "--exp-folders")):
        parser.add_argument(*flags, nargs="+", default=[])
    args = parser.parse_known_args(arguments)[0]
    if not (args.algos and args.env and args.exp_folders):
        fail("all_plots needs -a ALGO ..., -e ENV ... and -f FOLDER ..., the folder given to train.")
    places = [pathlib.Path(folder) / algo for folder in args.exp_folders for algo in args.algos]
    if not any(any(place.glob(f"{env}*")) for place in places for env in args.env):
        fail(f"all_plots needs runs on {', '.join(args.env)} in {', '.join(map(str, places))}, got none.")


def check_trained(args: argparse.Namespace) -> None:
    """Exit with a message if there is no trained agent at the given place, or if the files beside it would run code."""
    algo, name = args.algo, EnvironmentName(args.env)
    which = (args.load_best, args.load_checkpoint, args.load_last_checkpoint)
    try:
        *_, folder = get_model_path(args.exp_id, args.folder, algo, name, *which)
    except (AssertionError, ValueError) as error:
        runs = pathlib.Path(args.folder, algo).glob(f"{name}_*/*.zip")
        places = {run.parent.name.rpartition("_")[2]: run for run in runs}
        ids = sorted(int(place) for place in places if place.isdigit())  # others are those of -uuid
        unfinished = list(pathlib.Path(args.folder, algo).glob(f"{name}_*/{FOLDER}"))
        if unfinished and not places:
            run = max(unfinished, key=lambda checkpoints: checkpoints.stat().st_mtime).parent  # names: _10 is before _2
            found = f"{run} was interrupted: " + shlex.join(
                ["sb3-eqr", "train", "--algo", algo, "--env", args.env, "-f", str(args.folder), "--resume", str(run)]
            )
        elif ids:
            found = f"There are models in {' and '.join(map(str, ids))}: pass --exp-id."
        elif places:
            found = f"Runs with -uuid have no number: give the file to sb3-eqr visualize, as in {next(iter(places.values()))}."
        else:
            found = "Pass -f with the folder given to train (logs by default), or train one first."
        fail(f"{error}. {found}")
    if args.algo in AGENTS and not args.trust:
        with failing():
            check_zoo_folder(pathlib.Path(folder, name), args.gym_packages)


def save_where_nothing_is_shown(command: str) -> None:
    """Without a display, write matplotlib's figures to files instead of showing them."""
    import matplotlib.pyplot as plt

    def save(*_: object, **__: object) -> None:
        for number in plt.get_fignums():
            name = f"{command}-{number}.png"
            plt.figure(number).savefig(name, dpi=150)
            print(f"No display: saved {name}")

    if plt.get_backend().lower() == "agg":
        plt.show = save


def run(command: str, arguments: list[str]) -> None:
    """Run a command of RL Zoo with these arguments."""
    sys.argv = [f"sb3-eqr {command}", *arguments]
    module = f"rl_zoo3.plots.{command}" if command in PLOTS else f"rl_zoo3.{command}"
    try:
        if command in PLOTS:
            save_where_nothing_is_shown(command)
        if command in SCRIPTS:
            runpy.run_module(module, run_name="__main__")
        else:
            getattr(importlib.import_module(module), command)()
    except KeyboardInterrupt:
        raise SystemExit(130) from None  # as after Ctrl-C in a shell; RL Zoo handles it while it trains
    except (*MISTAKES, gym.error.DependencyNotInstalled) as error:
        message = explanation(command, error)
        if message is None:
            raise
        fail(message)


def explanation(command: str, error: Exception) -> str | None:
    """:return: what the user can do about an error of RL Zoo; ``None`` for an error with another cause"""
    if isinstance(error, ImportError):
        advice = ' Run pip install ".[zoo]" in a clone of the repository.' if str(error.name).split(".")[0] in EXTRA else ""
        return f"{command}: {error}.{advice}"
    if isinstance(error, OSError) and error.errno in UNWRITABLE:
        return f"{command}: {error}. Free some space, or pass another folder with -f."
    if "pass trust=True" in str(error) or str(error).startswith(("observation_space", "The trained_agent")):
        return f"{command}: {error}"
    if isinstance(error, gym.error.DependencyNotInstalled):
        return str(error)
    if "observation space is not supported" in str(error):
        return f"{command}: {error}. Wrap the environment so that it has Box or Discrete observations, or a Dict of these."
    if "as action space" in str(error):
        return f"{command}: {error}"
    if command in PLOTS and not isinstance(error, (AssertionError, NotImplementedError)):
        return f"{command}: {error}. RL Zoo's plots need two runs of each agent, with two evaluations of two episodes each."
    if command == "load_from_hub" and "TRUST_REMOTE_CODE" in str(error):
        return f"{error} Run TRUST_REMOTE_CODE=True sb3-eqr load_from_hub ..."
    return None


def prepare(command: str, arguments: list[str]) -> list[str]:
    """Check a command's arguments before RL Zoo starts; returns those for RL Zoo."""
    if command == "all_plots":
        check_runs(arguments)
    if command in PLOTS:
        return arguments
    args, own = parse(arguments), own_parser()
    if args.algo not in ALGOS:
        fail(f"--algo must be one of {', '.join(ALGOS)}, got {args.algo!r}.{nearest(args.algo, ALGOS)}")
    if command == "train":
        resuming = prepare_resuming(args)  # before settings beside --resume are read
        arguments = [*own.parse_known_args(arguments)[1], *resuming]
        path = prepare_training(args)
        arguments = arguments if path == args.conf_file else [*arguments, "--conf-file", str(path)]  # the last one counts
    elif command in LOADING:
        check_device(args.device)
        check_environment(args.env, args.gym_packages)  # imports the packages, for which two commands have no argument
        own.add_argument("--gym-packages", nargs="+")
        arguments = own.parse_known_args(arguments)[1]
        downloads = command == "enjoy" and args.folder.rstrip("/") == DOWNLOADS and args.algo not in AGENTS
        if not downloads:
            check_trained(args)
    if args.trust and args.algo in AGENTS:
        trust_files(args.algo)
    return arguments


def main() -> None:
    """Run the command that the first argument names; ``sb3_eqr.cli`` checks it."""
    command, arguments = sys.argv[1], sys.argv[2:]
    register()
    if command.endswith("_hub"):
        from sb3_eqr.zoo import hub

        hub.prepare("--dry-run" in arguments)
        arguments = [argument for argument in arguments if argument != "--dry-run"]
    if not {"-h", "--help"} & set(arguments):
        arguments = prepare(command, arguments)
    elif command == "train":
        print(RESUMING)
    run(command, arguments)


if __name__ == "__main__":
    main()
