"""Read entries of hyperparameter files as RL Zoo does, and check them."""

import importlib
import importlib.util
import pathlib
import runpy
from typing import Any

import gymnasium as gym
import numpy as np
import yaml
from rl_zoo3 import exp_manager
from rl_zoo3.utils import ALGOS, get_wrapper_class
from stable_baselines3.common.preprocessing import is_image_space

from sb3_eqr import DISCRETE
from sb3_eqr.common.checks.arguments import (
    ALGORITHM,
    DICTIONARY,
    FLAG,
    NONE,
    TEXT,
    Rule,
    integer,
    nearest,
    number,
    one_of,
    parameters_of,
)
from sb3_eqr.common.off_policy import EqROffPolicy
from sb3_eqr.configurations import ZOO_KEYS, configuration_files
from sb3_eqr.envs.pixels import SMALLEST_PICTURE
from sb3_eqr.trust import wrapper_names
from sb3_eqr.zoo.checks import fail, failing

DISCRETE_NAMES = [agent.__name__ for agent in DISCRETE.values()]
# Keys that RL Zoo removes from an entry before it calls the constructor.
ENTRY_KEYS = {*ZOO_KEYS, "vec_env_wrapper", "monitor_kwargs", "env_kwargs", "callback", "noise_type", "noise_std"}
# Arguments that RL Zoo itself passes to the constructor, and their flags.
FLAGS = {key: f"--{key.replace('_', '-')}" for key in ("env", "seed", "device", "verbose", "tensorboard_log")}
FLAGS["_init_setup_model"] = "nothing"
# Values that RL Zoo itself reads.
RULES = {
    "n_timesteps": number(0, above=True),
    "n_envs": integer(1),
    "frame_stack": integer(1) | NONE,
    "learning_starts": number(0) | NONE,
    "buffer_size": number(1),
    "normalize": FLAG | TEXT | DICTIONARY,
    # RL Zoo converts "lin_1e-3" to a schedule that decreases linearly to 0.
    "noise_type": one_of(["normal", "ornstein-uhlenbeck"]) | NONE,
    "learning_rate": number(0) | Rule("lin_ and a number", lambda value: number_in(value, "lin_") >= 0),
}


def number_in(value: Any, start: str = "") -> float:
    """The number in a text that begins with ``start``; NaN if the value is no such text."""
    try:
        return float(value.removeprefix(start)) if isinstance(value, str) and value.startswith(start) else np.nan
    except ValueError:
        return np.nan


def read_yaml(path: pathlib.Path, where: str = "") -> dict[str, Any]:
    """Read a YAML file; raises ValueError, with ``where`` before its message, if it is not valid, or not a mapping."""
    try:
        found = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ValueError(f"{where}{path} must be valid YAML, got: {error}") from error
    if not isinstance(found, dict):
        raise ValueError(f"{where}{path} must be a mapping, got {found!r:.60}.")
    return found


def read_file(path: str) -> dict[str, Any]:
    """
    :param path: a YAML file, or a Python file or package with a dictionary ``hyperparams``
    :return: its entries; exits with a message if it cannot be read
    """
    if not path.endswith((".yml", ".yaml", ".py")):
        if importlib.util.find_spec(path.split(".")[0]) is None:
            names = ", ".join(configuration_files())
            fail(f"--conf-file must be a YAML file, a Python file or package, or one of {names}, got {path!r}.")
        return importlib.import_module(path).hyperparams
    if not pathlib.Path(path).is_file():
        fail(f"--conf-file: there is no file {path!r}.{nearest(path, configuration_files())}")
    if path.endswith(".py"):
        return runpy.run_path(path)["hyperparams"]
    with failing():
        return read_yaml(pathlib.Path(path))


def entry_name(entries: dict[str, Any], env_id: str, changes: dict[str, Any]) -> str:
    """
    :param entries: entries of a file
    :param changes: changes of the entry, which may wrap the environment
    :return: its own name, "atari", or that of a generic entry: "default", or "default-image", "default-small-image" or
        "default-dict" if the file has them and the observations are images or dicts (RL Zoo itself knows only "default");
        exits with a message if the environment cannot be made
    """
    if env_id in entries:
        return env_id
    if exp_manager.ExperimentManager.is_atari(env_id):
        return "atari"
    if not any(name.startswith("default-") for name in entries):
        return "default"
    with failing(f"{env_id}: ", (ValueError, TypeError, ImportError, AttributeError, gym.error.Error)):
        env = gym.make(env_id, **(changes.get("env_kwargs") or {}))
        wrap = get_wrapper_class(changes) if changes.get("env_wrapper") else None
        space = (env if wrap is None else wrap(env)).observation_space
    env.close()
    name = "default"
    if isinstance(space, gym.spaces.Dict):
        name = "default-dict"
    elif is_image_space(space):
        name = "default-small-image" if sorted(space.shape or ())[1] < SMALLEST_PICTURE else "default-image"
    return name if name in entries else "default"


def find_entry(path: str, env_id: str, changes: dict[str, Any]) -> dict[str, Any]:
    """
    :param changes: changes from the command line
    :return: the entry as in the file, with the changes; exits with a message if there is none
    """
    entries = read_file(path)
    name = entry_name(entries, env_id, changes)
    if name not in entries:
        fail(f"{path} has no section for {env_id!r}, only for {', '.join(entries) or 'none'}. Add one, or use another file.")
    if not isinstance(entries[name] or {}, dict):
        fail(f"{path}: {name} must be a mapping of hyperparameters, got {entries[name]!r:.60}.")
    entry = {**(entries[name] or {}), **changes}
    for key in ("policy", "n_timesteps"):
        if key not in entry:
            fail(f"{path}: the section {name!r} needs {key!r}.")
    return entry


def read_entry(path: str, env_id: str, changes: dict[str, Any]) -> dict[str, Any]:
    """As :func:`find_entry`, with ``policy_kwargs`` evaluated."""
    entry = find_entry(path, env_id, changes)
    if isinstance(entry.get("policy_kwargs"), str):
        try:
            entry["policy_kwargs"] = eval(entry["policy_kwargs"], vars(exp_manager))
        except Exception as error:
            fail(f"{path}: policy_kwargs: {entry['policy_kwargs']!r} cannot be evaluated ({error}).")
    return entry


def check_entry(entry: dict[str, Any], algo: str, source: str) -> None:
    """
    Exit with a message if a key is not an argument of the constructor, or a value or wrapper does not work.

    :param entry: hyperparameters for one environment
    :param source: where they are from, for messages
    """
    algorithm = ALGOS[algo]
    policy = algorithm.policy_aliases.get(entry.get("policy", ""))
    own = {} if policy is None else parameters_of(policy)
    legal = ENTRY_KEYS | parameters_of(algorithm).keys() - FLAGS.keys()
    for key in entry:
        if key in FLAGS:
            fail(f"{source}: {key!r} is not allowed here, because RL Zoo sets it from {FLAGS[key]}.")
        if key not in legal:
            advice = f" Put it into policy_kwargs: dict({key}=...)." if key in own else nearest(key, legal)
            fail(f"{source}: {key!r} is not an argument of {algorithm.__name__}.{advice}")
    check_values(entry, source)
    policy_kwargs = entry.get("policy_kwargs")
    if policy is not None and isinstance(policy_kwargs, dict):
        for key in policy_kwargs:
            if key not in own:
                advice = " Put it beside policy_kwargs." if key in ALGORITHM else nearest(key, own)
                fail(f"{source}: {key!r} is not an argument of {algorithm.__name__}'s policy.{advice}")
    if issubclass(algorithm, EqROffPolicy):
        check_wrappers(entry, algorithm.__name__, source)


def check_values(entry: dict[str, Any], source: str) -> None:
    """Exit with a message if a value is a number that was read as text, or if RL Zoo cannot use it."""
    for key, value in entry.items():
        if np.isfinite(number_in(value)):  # as YAML reads 1e5
            written = np.format_float_positional(float(value), trim="-")
            fail(
                f"{source}: {key} must be a number, got the text {value!r}, which YAML does not read as one: write {written}."
            )
    for key, rule in RULES.items():
        if key in entry and not rule.holds(entry[key]):
            fail(f"{source}: {key} must be {rule.says}, got {entry[key]!r}.")
    if entry.get("noise_type") and "noise_std" not in entry:
        fail(f"{source}: noise_type needs noise_std, got none. Add noise_std: 0.1, or leave noise_type out.")


def check_wrappers(entry: dict[str, Any], name: str, source: str) -> None:
    """Exit with a message if a wrapper does not exist, or does not work with our agents."""
    for key in ("env_wrapper", "vec_env_wrapper"):
        for wrapper in wrapper_names(entry.get(key)):
            module, _, kind = wrapper.rpartition(".")
            try:
                getattr(importlib.import_module(module), kind)
            except (ImportError, AttributeError, ValueError) as error:
                fail(f"{source}: {key} must name classes such as gymnasium.wrappers.TimeLimit, got {wrapper!r} ({error}).")
    if name in DISCRETE_NAMES and "HistoryWrapper" in str(entry.get("env_wrapper")):
        fail(
            f"{source}: RL Zoo's HistoryWrapper needs continuous actions, but {name} supports discrete ones. "
            "Use frame_stack: 4 instead."
        )
    if entry.get("normalize") and entry.get("frame_stack"):
        fail(f"{source}: with both normalize and frame_stack, RL Zoo normalises before it stacks. Leave one of them out.")
