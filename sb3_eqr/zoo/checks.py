"""Wrong use of the command line, told before RL Zoo starts: what was expected, what was found, what to do."""

import difflib
import importlib
import importlib.util
import inspect
import pathlib
import sys
from collections.abc import Iterable
from typing import Any, NoReturn

import gymnasium as gym
import torch as th
import yaml
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import ALGOS

from sb3_eqr.common.eqr_algorithm import EqRAlgorithm
from sb3_eqr.configurations import ZOO_KEYS, configuration_files

# What RL Zoo takes out of an entry before it calls the constructor.
ENTRY_KEYS = {*ZOO_KEYS, "vec_env_wrapper", "monitor_kwargs", "env_kwargs", "callback", "noise_type", "noise_std"}

# The start of an environment's name, and what it needs.
EXTRAS = {
    "ALE/": ("ale_py", '"sb3-eqr[atari]"'),
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
    if device.startswith("cuda") and not th.cuda.is_available():
        fail(f"--device: {device} was asked for, but PyTorch finds no GPU. Pass --device cpu, or leave it out.")
    if track and importlib.util.find_spec("wandb") is None:
        fail("--track: Weights & Biases is not installed: pip install wandb")
    if (track or tensorboard_log) and importlib.util.find_spec("tensorboard") is None:
        fail(f"{'--track' if track else '--tensorboard-log'}: TensorBoard is not installed: pip install tensorboard")


def check_file(path: str, env_id: str, algo: str) -> None:
    """Leave with a message if a hyperparameter file has no entry for the environment, or a wrong key in it."""
    if not path.endswith((".yml", ".yaml")):
        if not path.endswith(".py") and importlib.util.find_spec(path.split(".")[0]) is None:
            fail(f"--conf-file: {path!r} is no file, no Python package, and none of {', '.join(configuration_files())}.")
        return
    if not pathlib.Path(path).is_file():
        fail(f"--conf-file: there is no file {path!r}.{nearest(path, configuration_files())}")
    entries = yaml.safe_load(pathlib.Path(path).read_text(encoding="utf-8")) or {}
    is_atari = ExperimentManager.is_atari(env_id) and "atari" in entries
    name = env_id if env_id in entries else "atari" if is_atari else "default"
    if name not in entries:
        fail(f"{path}: no entry for {env_id!r}; it has {', '.join(entries)}. Add one, or pass --conf-file with another file.")
    check_keys(entries[name], algo, path)


def check_keys(entry: dict[str, Any], algo: str, source: str) -> None:
    """
    Leave with a message if there is a key that no constructor takes.

    :param entry: hyperparameters for one environment
    :param algo: the algorithm that they are for
    :param source: where they stand
    """
    algorithm = ALGOS[algo]
    legal = ENTRY_KEYS | set(inspect.signature(algorithm).parameters)
    for key in entry:
        if key not in legal:
            fail(f"{source}: {key!r} is no argument of {algorithm.__name__}.{nearest(key, legal)}")
    policy_kwargs = entry.get("policy_kwargs")
    if isinstance(policy_kwargs, dict):
        policy = algorithm.policy_aliases["MlpPolicy"]
        kinds = policy.__mro__[: 2 if issubclass(algorithm, EqRAlgorithm) else 1]
        own = {name for kind in kinds for name in inspect.signature(kind.__init__).parameters}  # type: ignore[misc]
        for key in policy_kwargs:
            if key not in own:
                fail(f"{source}: {key!r} is no policy_kwargs of {algorithm.__name__}.{nearest(key, own)}")
    if issubclass(algorithm, EqRAlgorithm):
        check_wrappers(entry, algorithm.__name__, source)


def check_wrappers(entry: dict[str, Any], name: str, source: str) -> None:
    """Leave with a message if RL Zoo would wrap the environment in a way that our agents cannot use."""
    if "HistoryWrapper" in str(entry.get("env_wrapper")):
        fail(
            f"{source}: RL Zoo's HistoryWrapper takes continuous actions, {name} has discrete ones. "
            "Use frame_stack: 4 instead."
        )
    if entry.get("normalize") and entry.get("frame_stack"):
        fail(f"{source}: with both normalize and frame_stack, RL Zoo normalises before it stacks. Leave one of them out.")


def check_trained_agent(path: str) -> None:
    """Leave with a message if there is nothing to continue from."""
    if path and not (path.endswith(".zip") and pathlib.Path(path).is_file()):
        fail(f"--trained-agent: expected the path of a .zip file, such as logs/eqr_qrdqn/ENV_1/ENV.zip, found {path!r}.")
