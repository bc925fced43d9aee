"""The command line: thin doors to RL Zoo's own functions."""

import argparse
import importlib
import pathlib
import runpy
import sys

import gymnasium as gym
from huggingface_sb3 import EnvironmentName
from rl_zoo3.utils import get_model_path

from sb3_eqr.configurations import configuration_files
from sb3_eqr.zoo import AGENTS, register
from sb3_eqr.zoo.checks import (
    check_algo,
    check_environment,
    check_file,
    check_keys,
    check_machine,
    check_trained_agent,
    fail,
    nearest,
)

# The functions and modules of rl_zoo3 behind each command.
FUNCTIONS = {
    "train": "rl_zoo3.train:train",
    "enjoy": "rl_zoo3.enjoy:enjoy",
    "plot_train": "rl_zoo3.plots.plot_train:plot_train",
    "plot_from_file": "rl_zoo3.plots.plot_from_file:plot_from_file",
    "all_plots": "rl_zoo3.plots.all_plots:all_plots",
}
MODULES = {
    "record_video": "rl_zoo3.record_video",
    "push_to_hub": "rl_zoo3.push_to_hub",
    "load_from_hub": "rl_zoo3.load_from_hub",
}
COMMANDS = [*FUNCTIONS, *MODULES]
PLOTS = ("plot_from_file", "all_plots")
LOADING = ("enjoy", "record_video", "push_to_hub")

USAGE = f"""usage: sb3-eqr {{{",".join(COMMANDS)}}} ...

Every command takes RL Zoo's arguments: sb3-eqr train --help
push_to_hub also takes --dry-run: build the folder hub/, upload nothing."""


def find_hyperparameters(algo: str, conf_file: str | None) -> str | None:
    """
    :param algo: as given to ``--algo``
    :param conf_file: as given to ``--conf-file``: a path, or the name of one of our files
    :return: the file to use; ``None``: RL Zoo's own
    """
    files = configuration_files()
    if conf_file is None:
        return str(files[algo]) if algo in AGENTS else None
    if conf_file in files and not pathlib.Path(conf_file).exists():
        return str(files[conf_file])
    return conf_file


def make_parser() -> argparse.ArgumentParser:
    """
    :return: for what is looked at here; RL Zoo parses everything once more
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--algo", default="ppo")
    parser.add_argument("--env", default="CartPole-v1")
    parser.add_argument("-conf", "--conf-file")
    parser.add_argument("-params", "--hyperparams", nargs="+", default=[])
    parser.add_argument("--device", default="auto")
    parser.add_argument("-i", "--trained-agent", default="")
    parser.add_argument("--track", action="store_true")
    parser.add_argument("-tb", "--tensorboard-log", default="")
    parser.add_argument("--gym-packages", nargs="+", default=[])
    parser.add_argument("-f", "--folder", default="rl-trained-agents")
    parser.add_argument("--exp-id", type=int, default=0)
    parser.add_argument("--load-best", action="store_true")
    parser.add_argument("--load-checkpoint")
    parser.add_argument("--load-last-checkpoint", action="store_true")
    return parser


def check_training(args: argparse.Namespace) -> str | None:
    """
    :param args: of ``train``
    :return: the file of hyperparameters to use; ``None``: RL Zoo's own
    """
    path = find_hyperparameters(args.algo, args.conf_file)
    check_environment(args.env, args.gym_packages)
    check_machine(args.device, args.track, args.tensorboard_log)
    check_trained_agent(args.trained_agent)
    if path is not None:
        check_file(path, args.env, args.algo)
    check_keys(dict.fromkeys(pair.split(":")[0] for pair in args.hyperparams), args.algo, "--hyperparams")
    return path


def check_trained(args: argparse.Namespace) -> None:
    """Leave with a message if the trained agent is not where it is looked for."""
    try:
        get_model_path(
            args.exp_id,
            args.folder,
            args.algo,
            EnvironmentName(args.env),
            args.load_best,
            args.load_checkpoint,
            args.load_last_checkpoint,
        )
    except (AssertionError, ValueError) as error:
        fail(f"{error}. Pass -f with the folder given to train (logs by default), or train one first.")


def run(command: str, arguments: list[str]) -> None:
    """
    :param command: one of ``COMMANDS``
    :param arguments: RL Zoo's own, on its command line
    """
    sys.argv = [f"sb3-eqr {command}", *arguments]
    try:
        if command in MODULES:
            runpy.run_module(MODULES[command], run_name="__main__")
        else:
            module, function = FUNCTIONS[command].split(":")
            getattr(importlib.import_module(module), function)()
    except ModuleNotFoundError as error:
        fail(f'{command} needs {error.name}: pip install "sb3-eqr[zoo]"')
    except gym.error.DependencyNotInstalled as error:
        fail(str(error))
    except ValueError as error:
        if command not in PLOTS:
            raise
        fail(f"{command}: {error}. RL Zoo's plots need two runs of each agent, with two evaluations of two episodes each.")


def main() -> None:
    """The command line."""
    if len(sys.argv) < 2 or sys.argv[1] in ("-h", "--help"):
        print(USAGE)
        return
    command, arguments = sys.argv[1], sys.argv[2:]
    if command not in COMMANDS:
        fail(f"expected one of {', '.join(COMMANDS)}, found {command!r}.{nearest(command, COMMANDS)}")
    register()
    args, _ = make_parser().parse_known_args(arguments)
    wants_help = bool({"-h", "--help"} & set(arguments))
    if command == "push_to_hub":
        from sb3_eqr.zoo import hub

        hub.prepare("--dry-run" in arguments)
        arguments = [argument for argument in arguments if argument != "--dry-run"]
    if not wants_help and command in ("train", *MODULES, "enjoy"):
        check_algo(args.algo)
    is_on_hub = args.folder == "rl-trained-agents" and args.algo not in AGENTS  # RL Zoo downloads stock agents into that
    if not wants_help and command in LOADING and not is_on_hub:
        check_trained(args)
    if not wants_help and command == "train":
        path = check_training(args)
        if path is not None and path != args.conf_file:
            arguments = [*arguments, "--conf-file", path]  # the last one counts
    run(command, arguments)


if __name__ == "__main__":
    main()
