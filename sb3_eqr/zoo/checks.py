"""Wrong use of the command line, told before RL Zoo starts: what was expected, what was found, what to do."""

import difflib
import importlib
import importlib.util
import pathlib
import sys
from collections.abc import Iterable
from typing import NoReturn

import gymnasium as gym
import torch as th
from rl_zoo3.utils import ALGOS

# The start of an environment's name, and what it needs.
EXTRAS = {
    "ALE/": ("ale_py", '".[atari]" in a clone of the repository'),
    "MinAtar/": ("minatar", "minatar"),
}


def nearest(name: str, legal: Iterable[str]) -> str:
    """
    :return: a question for the end of a message: the closest legal name, or nothing
    """
    found = difflib.get_close_matches(name, list(legal), n=1)
    return f" Did you mean {found[0]!r}?" if found else ""


def fail(message: str) -> NoReturn:
    """Tell what is wrong, without a traceback, and leave with status 2 as argparse does."""
    print(f"sb3-eqr: {message}", file=sys.stderr)
    raise SystemExit(2)


def check_algo(algo: str) -> None:
    """Leave with a message if there is no such algorithm."""
    if algo not in ALGOS:
        fail(f"--algo: expected one of {', '.join(ALGOS)}, found {algo!r}.{nearest(algo, ALGOS)}")


def check_environment(env_id: str, packages: list[str]) -> None:
    """Leave with a message if gymnasium does not know the environment once these packages are imported."""
    for package in packages:
        try:
            importlib.import_module(package)
        except ImportError as error:
            fail(f"--gym-packages: {package!r} cannot be imported ({error}). Install it, or correct its name.")
    for start, (package, requirement) in EXTRAS.items():
        is_meant = env_id.startswith(start) or (start == "ALE/" and "NoFrameskip" in env_id)
        if is_meant and importlib.util.find_spec(package) is None:
            fail(f"--env: {env_id} needs {package}: pip install {requirement}")
    if env_id not in gym.registry:
        fail(f"--env: {env_id!r} is not registered with gymnasium.{nearest(env_id, gym.registry)}")


def check_machine(device: str, track: bool, tensorboard_log: str) -> None:
    """Leave with a message if a GPU is asked for and not there, or Weights & Biases, or TensorBoard."""
    try:
        th.device("cpu" if device == "auto" else device)
    except RuntimeError:
        fail(f"--device: expected auto, cpu, cuda or another device of PyTorch, found {device!r}.")
    if device.startswith("cuda") and not th.cuda.is_available():
        fail(f"--device: {device} was asked for, but PyTorch finds no GPU. Pass --device cpu, or leave it out.")
    if track and importlib.util.find_spec("wandb") is None:
        fail("--track: Weights & Biases is not installed: pip install wandb")
    if (track or tensorboard_log) and importlib.util.find_spec("tensorboard") is None:
        fail(f"{'--track' if track else '--tensorboard-log'}: TensorBoard is not installed: pip install tensorboard")


def check_trained_agent(path: str) -> None:
    """Leave with a message if there is nothing to continue from."""
    if path and not (path.endswith(".zip") and pathlib.Path(path).is_file()):
        fail(f"--trained-agent: expected the path of a .zip file, such as logs/eqr_qrdqn/ENV_1/ENV.zip, found {path!r}.")
