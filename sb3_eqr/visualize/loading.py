"""A saved agent, and the environment that it was trained in."""

import ast
import difflib
import importlib
import json
import pathlib
import zipfile
from typing import Any

import gymnasium as gym
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize, unwrap_vec_normalize

import sb3_eqr.envs
from sb3_eqr import AGENTS
from sb3_eqr.common.eqr_algorithm import EqRAlgorithm
from sb3_eqr.common.save_util import is_whole_model
from sb3_eqr.visualize.latents import FACTOR_KEYS
from sb3_eqr.visualize.trust import check_statistics, check_zoo_folder


def load_model(path: pathlib.Path, algo: str | None = None, device: str = "auto", trust: bool = False) -> EqRAlgorithm:
    """
    :param path: of a file that ``save`` wrote
    :param algo: one of ``AGENTS``; found out where not given
    :param device: of PyTorch
    :param trust: as in ``load``
    :raises ValueError: if there is no such file, or it holds something else
    """
    if not path.is_file():
        raise ValueError(f"MODEL: expected the path of a .zip file, such as logs/eqr_qrdqn/ENV_1/ENV.zip, found {str(path)!r}")
    if not is_whole_model(path):
        raise ValueError(f"{path}: expected a whole file of an agent's save, found one that is truncated or something else")
    try:
        return AGENTS[algo or find_algorithm(path)].load(path, device=device, trust=trust)
    except (TypeError, RuntimeError) as error:
        raise ValueError(f"{path}: expected an agent saved by this version of sb3_eqr and by --algo: {error}") from error


def find_algorithm(path: pathlib.Path) -> str:
    """
    By the module of the policy's class, which is plain text: nothing is unpickled.

    :param path: of a whole file
    :return: one of ``AGENTS``
    :raises ValueError: if the policy is not one of this package's
    """
    with zipfile.ZipFile(path) as archive:
        data = json.loads(archive.read("data"))
    saved = data.get("policy_class", {})
    module = str(saved.get("module", saved.get("__module__")))
    for name in AGENTS:
        if module.startswith(f"sb3_eqr.{name}."):
            return name
    raise ValueError(
        f"{path}: expected an agent of {' or '.join(kind.__name__ for kind in AGENTS.values())}, found one whose policy "
        f"is of {module}. Pass --algo if that is a class of your own for one of them."
    )


def make_env(
    model: EqRAlgorithm,
    path: pathlib.Path,
    env_id: str | None = None,
    env_kwargs: dict[str, Any] | None = None,
    n_envs: int = 1,
    seed: int = 0,
    render: bool = False,
    trust: bool = False,
) -> VecEnv:
    """
    The environment as in training. What RL Zoo wrote beside the model says it; for another, Atari is preprocessed as by
    :func:`~sb3_eqr.envs.make_atari100k_env`. Statistics of ``VecNormalize`` beside the model are used, and stay as they are.

    :param model: the agent
    :param path: where it was loaded from
    :param env_id: of gymnasium; RL Zoo's where not given
    :param env_kwargs: of its constructor
    :param n_envs: number of environments
    :param seed: of the first environment
    :param render: whether it is asked to draw itself
    :param trust: whether the files beside the model may name code that runs
    :raises ValueError: if no environment is known, it is not the agent's, or its files need ``trust``
    :raises ImportError: if RL Zoo or the environment is not installed
    """
    sb3_eqr.envs.register()
    kwargs = dict(env_kwargs or {})
    zoo = find_zoo_folder(path)
    if zoo is not None and not trust:
        check_zoo_folder(zoo)
    if zoo is not None and env_id in (None, zoo_arguments(zoo)["env"]):
        env = _zoo_env(zoo, kwargs, n_envs, seed, render)
    elif env_id is None:
        raise ValueError(f"--env: expected the environment of the agent, for RL Zoo has left none (args.yml) beside {path}")
    elif env_id.startswith("ALE/") or "NoFrameskip" in env_id:
        if kwargs:
            raise ValueError(f"--env-kwargs: expected none for Atari, whose protocol is fixed, found {kwargs}")
        env = sb3_eqr.envs.make_atari100k_env(env_id, n_envs, seed, training=True)
    else:
        env = _plain_env(env_id, kwargs, n_envs, seed)
    statistics = path.parent / "vecnormalize.pkl"
    if unwrap_vec_normalize(env) is None and statistics.is_file():
        if not trust:
            check_statistics(statistics)
        env = VecNormalize.load(str(statistics), env)
    normalize = unwrap_vec_normalize(env)
    if normalize is not None:
        normalize.training = False
    env = model._wrap_env(env, monitor_wrapper=False)
    try:
        check_for_correct_spaces(env, model.observation_space, model.action_space)
    except ValueError as error:
        advice = "Pass the --env and --env-kwargs of training."
        raise ValueError(f"--env: the environment is not the agent's. {error}. {advice}") from error
    return env


def find_zoo_folder(path: pathlib.Path) -> pathlib.Path | None:
    """
    :param path: of a model, such as logs/eqr_qrdqn/CartPole-v1_1/best_model.zip
    :return: the folder beside it that holds args.yml and config.yml, such as CartPole-v1
    """
    found = sorted(file.parent for file in path.parent.glob("*/args.yml") if (file.parent / "config.yml").is_file())
    return found[0] if found else None


def zoo_arguments(folder: pathlib.Path) -> dict[str, Any]:
    """
    :param folder: of :func:`find_zoo_folder`
    :return: the command line of ``train``
    """
    import yaml

    # As RL Zoo reads it: make_env has looked at it, or it is trusted.
    return yaml.load((folder / "args.yml").read_text(encoding="utf-8"), Loader=yaml.UnsafeLoader)


def _zoo_env(folder: pathlib.Path, kwargs: dict[str, Any], n_envs: int, seed: int, render: bool) -> VecEnv:
    try:
        from rl_zoo3.utils import create_test_env, get_saved_hyperparams
    except ImportError as error:
        advice = 'pip install ".[zoo]" in a clone of the repository'
        raise ImportError(f"{folder} is of RL Zoo, which is not installed ({error}): {advice}") from error
    arguments = zoo_arguments(folder)
    for package in arguments.get("gym_packages") or []:
        importlib.import_module(package)
    hyperparams, stats_path = get_saved_hyperparams(str(folder))
    norm_reward = (hyperparams.get("normalize_kwargs") or {}).get("norm_reward", True)
    made_with = {**(arguments.get("env_kwargs") or {}), **({"render_mode": "rgb_array"} if render else {}), **kwargs}
    env = create_test_env(
        arguments["env"],
        n_envs,
        stats_path,
        seed,
        should_render=False,
        hyperparams=hyperparams,
        env_kwargs=made_with,
        vec_env_cls=DummyVecEnv,
    )
    normalize = unwrap_vec_normalize(env)
    if normalize is not None:
        normalize.norm_reward = norm_reward  # the reward predictor has learned these
    return env


def _plain_env(env_id: str, kwargs: dict[str, Any], n_envs: int, seed: int) -> VecEnv:
    if env_id not in gym.registry:
        near = difflib.get_close_matches(env_id, list(gym.registry), n=1)
        raise ValueError(f"--env: {env_id!r} is not registered with gymnasium.{f' Did you mean {near[0]!r}?' if near else ''}")
    try:
        return make_vec_env(env_id, n_envs, seed, env_kwargs=kwargs)  # which asks for pictures where there are any
    except TypeError as error:
        raise ValueError(f"--env-kwargs: {env_id} does not take {kwargs} ({error})") from error


def parse_kwargs(pairs: list[str]) -> dict[str, Any]:
    """
    :param pairs: "key:value", the value in Python, or a text
    :raises ValueError: for something else
    """
    found = {}
    for pair in pairs:
        key, colon, value = pair.partition(":")
        if not (key.isidentifier() and colon):
            raise ValueError(f"--env-kwargs: expected key:value, found {pair!r}")
        try:
            found[key] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            found[key] = value
    return found


def action_names(env: VecEnv, n_actions: int) -> list[str]:
    """
    :return: what the environment calls its actions, else their numbers
    """
    world = env.get_attr("unwrapped", 0)[0]
    names = world.get_action_meanings() if hasattr(world, "get_action_meanings") else []
    return list(names) if len(names) == n_actions else [str(a) for a in range(n_actions)]


def factor_names(env: VecEnv) -> list[str]:
    """
    :param env: after a reset
    :return: of what the environment tells of its true state, in the order of :class:`~sb3_eqr.visualize.latents.Play`
    """
    info = env.unwrapped.reset_infos[0]
    sizes = {key: getattr(info[key], "size", 1) for key in FACTOR_KEYS if key in info}
    return [key if size == 1 else f"{key} {i}" for key, size in sizes.items() for i in range(size)]
