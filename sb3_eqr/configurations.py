"""The named configurations: this package's RL Zoo YAML files as keyword arguments."""

import pathlib
import warnings
from typing import Any

from stable_baselines3.common.utils import LinearSchedule

from sb3_eqr.common.checks.arguments import nearest

ZOO_KEYS = ("policy", "n_timesteps", "frame_stack", "n_envs", "normalize", "env_wrapper")  # read by RL Zoo itself
STOCK = "stock"  # the folder of settings for SB3's own agents


def configuration_files() -> dict[str, pathlib.Path]:
    """
    :return: name -> file, for every file in ``zoo_hyperparams``: "eqr_rainbow", "eqr_bbf", "gl2+aet+r", ..., "stock/dqn"
    """
    package = pathlib.Path(__file__).parent
    folders = (package / "zoo_hyperparams", package.parent / "zoo_hyperparams")  # installed from a wheel; in a clone
    folder = next(folder for folder in folders if folder.is_dir())
    files = sorted(folder.rglob("*.yml"))
    return {f"{STOCK}/{path.stem}" if path.parent.name == STOCK else path.stem: path for path in files}


def load_configuration(name: str, env_id: str = "atari", **changes: Any) -> dict[str, Any]:
    """
    Keyword arguments of a named configuration, for the constructor of its agent::

        EqRRainbow("CnnPolicy", env, **load_configuration("eqr_bbf"))
        narrow = {"net_arch": [512], "features_extractor_kwargs": {"width_scale": 1}}
        EqRRainbow("CnnPolicy", env, **load_configuration("eqr_bbf", policy_kwargs=narrow, learning_starts=500))

    :param name: one of ``sb3_eqr.configurations.configuration_files()``; docs/choosing.md describes each one
    :param env_id: the section of that file: "atari", or the name of an environment
    :param changes: arguments that override those of the file; dictionaries are merged
    :return: the arguments, without what RL Zoo itself reads (``ZOO_KEYS``); warns if the section's environment is normalised
    :raises ValueError: if the file or the section does not exist
    """
    try:
        import yaml
    except ImportError as error:
        raise ImportError("load_configuration needs PyYAML: pip install pyyaml") from error
    files = configuration_files()
    if name not in files:
        raise ValueError(f"name must be one of the configurations {list(files)}, got {name!r}.{nearest(name, files)}")
    entries = yaml.safe_load(files[name].read_text(encoding="utf-8"))
    if env_id not in entries:
        default = " Any other environment has a default section, by its observations." if "default" in entries else ""
        raise ValueError(
            f"env_id must be one of the sections {list(entries)} of configuration {name!r}, got {env_id!r}.{default}"
        )
    if normalize := entries[env_id].get("normalize"):
        warnings.warn(
            f"configuration {name!r}, {env_id!r}: its agent is trained with normalize: {normalize}, not an argument of "
            "the agent. Wrap the environment with stable_baselines3.common.vec_env.VecNormalize.",
            stacklevel=2,
        )
    arguments = {key: value for key, value in entries[env_id].items() if key not in ZOO_KEYS}
    if isinstance(arguments.get("policy_kwargs"), str):
        raise ValueError(
            f"configuration {name!r}, {env_id!r}: policy_kwargs must be a dictionary, got Python code, which only RL Zoo "
            f"evaluates. Use sb3-eqr train --conf-file {name}, or pass the arguments to the constructor yourself."
        )
    return with_schedule(merged(arguments, changes))


def with_schedule(arguments: dict[str, Any]) -> dict[str, Any]:
    """
    :param arguments: of an agent; a ``learning_rate`` such as "lin_1e-3" is RL Zoo's for a linear fall from 1e-3 to 0
    :return: the same, with the schedule that such a text names
    :raises ValueError: if ``learning_rate`` is another text
    """
    rate = arguments.get("learning_rate")
    if not isinstance(rate, str):
        return arguments
    if not rate.startswith("lin_"):
        raise ValueError(
            f'learning_rate must be a number or "lin_" and a number, got the text {rate!r}. '
            "In YAML, write 1.0e-4 or !!float 1e-4: it reads 1e-4 as text."
        )
    return {**arguments, "learning_rate": LinearSchedule(float(rate.removeprefix("lin_")), 0.0, 1.0)}


def merged(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """:return: ``old`` with the values of ``new``; nested dictionaries are merged, too"""
    result = {**old, **new}
    for key in old.keys() & new.keys():
        if isinstance(old[key], dict) and isinstance(new[key], dict):
            result[key] = merged(old[key], new[key])
    return result
