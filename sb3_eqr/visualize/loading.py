"""Load a saved agent and the environment that it was trained in."""

import ast
import pathlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize, unwrap_vec_normalize

from sb3_eqr import AGENTS
from sb3_eqr.common.off_policy import EqROffPolicy
from sb3_eqr.common.saving.models import data_of, read_model
from sb3_eqr.envs import check_registered, import_packages, make_atari100k_env
from sb3_eqr.trust import check_statistics, check_zoo_folder, read_trusted
from sb3_eqr.visualize.latents import FACTOR_KEYS, as_vec_env


def load_model(path: pathlib.Path, algo: str | None = None, device: str = "auto", trust: bool = False) -> EqROffPolicy:
    """
    :param path: path of a file written by ``save``
    :param algo: one of ``AGENTS``; default: detected from the file
    :param device: PyTorch device
    :param trust: as in ``load``
    :raises ValueError: if the file does not exist or is not a saved agent
    """
    if not path.is_file():
        example = "such as logs/eqr_qrdqn/ENV_1/ENV.zip"
        raise ValueError(f"MODEL must be the path of a .zip file, {example}, got {str(path)!r}, which does not exist.")
    try:
        return AGENTS[algo or find_algorithm(path)].load(path, device=device, trust=trust)
    except (TypeError, RuntimeError) as error:
        raise ValueError(f"{path} must be an agent of --algo, saved by this version of sb3_eqr: {error}") from error


def find_algorithm(path: pathlib.Path) -> str:
    """
    Detect which of ``AGENTS`` saved a file from the module of the policy's class, which is plain text: nothing is unpickled.

    :raises ValueError: if the policy is not one of this package's
    """
    saved = data_of(read_model(path)).get("policy_class", {})
    module = str(saved.get("module", saved.get("__module__")))
    for name in AGENTS:
        if module.startswith(f"sb3_eqr.{name}."):
            return name
    raise ValueError(
        f"{path} must be a saved {' or '.join(kind.__name__ for kind in AGENTS.values())}, got one whose policy is from "
        f"{module}. Pass --algo if that is your own policy class for one of them."
    )


def make_env(
    model: EqROffPolicy,
    path: pathlib.Path,
    env_id: str | None = None,
    env_kwargs: dict[str, Any] | None = None,
    n_envs: int = 1,
    seed: int = 0,
    render: bool = False,
    trust: bool = False,
    packages: Sequence[str] = (),
) -> VecEnv:
    """
    The environment as in training, from RL Zoo's files next to the model. Without them, Atari is preprocessed as by
    :func:`~sb3_eqr.envs.make_atari100k_env`. Statistics of ``VecNormalize`` next to the model are used, and not updated.

    :param model: the agent
    :param path: path that the agent was loaded from
    :param env_id: gymnasium id; default: RL Zoo's
    :param env_kwargs: arguments of the environment's constructor
    :param n_envs: number of environments
    :param seed: seed of the first environment
    :param render: whether the environment is made to render, if it can
    :param trust: whether the files next to the model may name code that runs
    :param packages: packages whose code they may name in any case
    :raises ValueError: if the environment is unknown or does not fit the agent, or its files need ``trust``
    :raises ImportError: if RL Zoo or the environment is not installed
    """
    kwargs = env_kwargs or {}
    folders = [file.parent for file in sorted(path.parent.glob("*/args.yml")) if (file.parent / "config.yml").is_file()]
    if folders and not trust:
        check_zoo_folder(folders[0], packages)
    arguments = read_trusted(folders[0] / "args.yml") if folders else {}
    if folders and env_id in (None, arguments["env"]):
        env = _zoo_env(folders[0], arguments, kwargs, n_envs, seed, render)
    elif env_id is None:
        raise ValueError(f"--env must be the agent's environment, got none, and RL Zoo's args.yml is not next to {path}.")
    elif env_id.startswith("ALE/") or "NoFrameskip" in env_id:
        if kwargs:
            raise ValueError(f"--env-kwargs must be empty for Atari, whose protocol is fixed, got {kwargs}.")
        env = make_atari100k_env(env_id, n_envs, seed, training=True, render_mode="rgb_array" if render else None)
    else:
        check_registered(env_id, "--env")
        env = _make_envs(env_id, kwargs, n_envs, seed, render, None)
    statistics = path.parent / "vecnormalize.pkl"
    if unwrap_vec_normalize(env) is None and statistics.is_file():
        if not trust:
            check_statistics(statistics)
        env = VecNormalize.load(str(statistics), env)
    if (normalize := unwrap_vec_normalize(env)) is not None:
        normalize.training = False
    elif model.trained_normalized:
        raise ValueError(
            f"{statistics} must exist, because the agent was trained with VecNormalize, got none. "
            "Write it with the save method of that VecNormalize."
        )
    return as_vec_env(model, env)


def _zoo_env(
    folder: pathlib.Path, arguments: dict[str, Any], kwargs: dict[str, Any], n_envs: int, seed: int, render: bool
) -> VecEnv:
    """The environment of the run whose arguments of ``train`` and config.yml are in a folder."""
    try:
        import rl_zoo3.import_envs  # noqa: F401 - registers Atari and others
        from rl_zoo3.utils import get_saved_hyperparams, get_wrapper_class
    except ImportError as error:
        advice = 'Run pip install ".[zoo]" in a clone of the repository.'
        raise ImportError(f"{folder} needs RL Zoo, which is not installed ({error}). {advice}") from error
    import_packages(arguments.get("gym_packages") or [])
    config, _ = get_saved_hyperparams(str(folder))
    made_with = {**(config.get("env_kwargs") or {}), **(arguments.get("env_kwargs") or {}), **kwargs}
    wrap, wrap_all = get_wrapper_class(config), get_wrapper_class(config, "vec_env_wrapper")
    env: Any = _make_envs(arguments["env"], made_with, n_envs, seed, render, wrap)
    env = env if wrap_all is None else wrap_all(env)
    if config["normalize"]:
        statistics = folder / "vecnormalize.pkl"
        if not statistics.is_file():
            raise ValueError(f"{statistics} must exist, because the agent was trained with normalize: true. Copy it there.")
        env = VecNormalize.load(str(statistics), env)  # the reward predictor was trained on its rewards
    return VecFrameStack(env, config["frame_stack"]) if config.get("frame_stack") else env


def _make_envs(
    env_id: str, kwargs: dict[str, Any], n_envs: int, seed: int, render: bool, wrap: Callable[[gym.Env], gym.Env] | None
) -> VecEnv:
    """Environments that render if asked and able to."""
    make = partial(make_vec_env, partial(gym.make, env_id), n_envs, seed, wrapper_class=wrap)  # by name, all would render
    try:
        return make(env_kwargs={"render_mode": "rgb_array", **kwargs} if render else kwargs)
    except TypeError as error:
        if render and "render_mode" in str(error):
            return _make_envs(env_id, kwargs, n_envs, seed, False, wrap)
        raise ValueError(f"--env-kwargs: {env_id} does not accept {kwargs} ({error}).") from error


def parse_kwargs(pairs: list[str]) -> dict[str, Any]:
    """Arguments from pairs "key:value", where the value is a Python literal or a string; others raise a ValueError."""
    found = {}
    for pair in pairs:
        key, colon, value = pair.partition(":")
        if not (key.isidentifier() and colon):
            raise ValueError(f"--env-kwargs must be key:value, got {pair!r}.")
        try:
            found[key] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            found[key] = value
    return found


def action_names(env: VecEnv, model: EqROffPolicy) -> list[str]:
    """The environment's names of its actions, or else their numbers; of a Box, names of the typical actions."""
    typical = model.policy.typical_actions
    if typical.ndim == 2:
        return [f"{sign}{axis}" for axis in range(typical.shape[1]) for sign in "+-"]
    n_actions = len(typical)
    is_named = env.has_attr("get_action_meanings")
    names = env.env_method("get_action_meanings", indices=0)[0] if is_named else []
    return list(names) if len(names) == n_actions else [str(a) for a in range(n_actions)]


def factor_names(env: VecEnv) -> list[str]:
    """Names of the factors that an environment reported at its last reset, in the order of ``Play``."""
    info = env.unwrapped.reset_infos[0]
    sizes = {key: np.size(info[key]) for key in FACTOR_KEYS if key in info}
    return [key if size == 1 else f"{key} {i}" for key, size in sizes.items() for i in range(size)]
