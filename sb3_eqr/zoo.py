"""
RL Zoo with the EqR agents: registration, search spaces, and the command line ``sb3-eqr`` (or ``python -m sb3_eqr.zoo``).

    sb3-eqr train --algo eqr_rainbow --env CartPole-v1 --conf-file FILE_OR_NAME ...

Every command is RL Zoo's own, with all of its flags; what is added is the agents ``eqr_qrdqn`` and ``eqr_rainbow``, their
hyperparameter files, and messages instead of tracebacks for wrong use.
"""

import argparse
import difflib
import importlib
import importlib.util
import inspect
import pathlib
import runpy
import sys
from collections.abc import Callable, Iterable
from typing import Any, NoReturn

import torch as th

from sb3_eqr import EqRQRDQN, EqRRainbow
from sb3_eqr.common.eqr_algorithm import EqRAlgorithm
from sb3_eqr.configurations import ZOO_KEYS, configuration_files

try:
    import gymnasium as gym
    import rl_zoo3.import_envs  # noqa: F401
    import yaml
    from rl_zoo3.exp_manager import ExperimentManager
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
    from rl_zoo3.utils import ALGOS
except ImportError as error:
    raise ImportError('sb3_eqr.zoo needs RL Zoo: pip install "sb3-eqr[zoo]"') from error

AGENTS: dict[str, type[EqRAlgorithm]] = {"eqr_qrdqn": EqRQRDQN, "eqr_rainbow": EqRRainbow}

# The functions and modules of rl_zoo3 behind each command.
FUNCTIONS = {
    "train": "rl_zoo3.train:train",
    "enjoy": "rl_zoo3.enjoy:enjoy",
    "plot_train": "rl_zoo3.plots.plot_train:plot_train",
    "plot_from_file": "rl_zoo3.plots.plot_from_file:plot_from_file",
    "all_plots": "rl_zoo3.plots.all_plots:all_plots",
}
MODULES = {"record_video": "rl_zoo3.record_video", "push_to_hub": "rl_zoo3.push_to_hub"}

NET_ARCHS = {"small": [64, 64], "medium": [256, 256], "one": [256]}


def convert_eqr_params(sampled: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled: values of the search, by the names of :func:`make_sampler`
    :return: keyword arguments of the agent
    """
    params = dict(sampled)
    batch_size, train_freq = 2 ** params.pop("batch_size_pow"), 2 ** params.pop("train_freq_pow")
    policy_kwargs: dict[str, Any] = {
        "group": params.pop("group"),
        "n_blocks": params.pop("n_blocks"),
        "net_arch": NET_ARCHS[params.pop("net_arch")],
        "noisy": params.pop("noisy"),
    }
    if "return_range" in params:
        policy_kwargs["v_max"] = float(params.pop("return_range"))
        policy_kwargs["v_min"] = -policy_kwargs["v_max"]
    return {
        "gamma": 1 - params.pop("one_minus_gamma"),
        "batch_size": batch_size,
        "train_freq": train_freq,
        "gradient_steps": max(round(train_freq * params.pop("replay_ratio")), 1),
        **params,
        "policy_kwargs": policy_kwargs,
    }


def make_sampler(categorical: bool) -> Callable[..., dict[str, Any]]:
    """
    :param categorical: whether the range of returns is searched, too
    :return: a search space for RL Zoo: group, blocks, depth, the three coefficients, learning rate, n-step, replay ratio
    """

    def sample_eqr_params(trial: Any, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
        sampled = {
            "learning_rate": trial.suggest_float("learning_rate", 1e-4, 5e-3, log=True),
            "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.001, 0.05, log=True),
            "batch_size_pow": trial.suggest_int("batch_size_pow", 4, 7),
            "train_freq_pow": trial.suggest_int("train_freq_pow", 0, 8),
            "replay_ratio": trial.suggest_categorical("replay_ratio", [0.25, 0.5, 1.0, 2.0]),
            "n_steps": trial.suggest_int("n_steps", 1, 10),
            "prediction_depth": trial.suggest_int("prediction_depth", 1, 5),
            "aet_coef": trial.suggest_categorical("aet_coef", [0.0, 0.1, 0.3, 1.0]),
            "get_coef": trial.suggest_categorical("get_coef", [0.0, 0.1, 0.3, 1.0]),
            "reward_coef": trial.suggest_categorical("reward_coef", [0.0, 0.1, 0.3, 1.0]),
            "target_update_interval": trial.suggest_int("target_update_interval", 1, 1_000, log=True),
            "exploration_fraction": trial.suggest_float("exploration_fraction", 0.02, 0.5),
            "exploration_final_eps": trial.suggest_float("exploration_final_eps", 0.01, 0.1),
            "group": trial.suggest_categorical("group", ["SE(2)", "SO(3)", "GL(2)", "T(2)"]),
            "n_blocks": trial.suggest_int("n_blocks", 2, 16),
            "net_arch": trial.suggest_categorical("net_arch", list(NET_ARCHS)),
            "noisy": trial.suggest_categorical("noisy", [False, True]),
        }
        if categorical:
            sampled["return_range"] = trial.suggest_categorical("return_range", [10, 30, 100, 300])
        return convert_eqr_params(sampled)

    return sample_eqr_params


def register() -> None:
    """Put the agents into RL Zoo's tables."""
    ALGOS.update(AGENTS)  # type: ignore[arg-type]
    for name in AGENTS:
        HYPERPARAMS_SAMPLER[name] = make_sampler(categorical=name == "eqr_rainbow")
        HYPERPARAMS_CONVERTER[name] = convert_eqr_params  # type: ignore[assignment]


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
    if env_id in gym.registry:
        return
    if ("NoFrameskip" in env_id or env_id.startswith("ALE/")) and importlib.util.find_spec("ale_py") is None:
        fail(f'--env: {env_id} needs ale-py: pip install "sb3-eqr[atari]"')
    fail(f"--env: {env_id!r} is not registered with gymnasium.{nearest(env_id, gym.registry)}")


def check_machine(device: str, track: bool) -> None:
    """Leave with a message if a GPU is asked for and not there, or Weights & Biases."""
    if device.startswith("cuda") and not th.cuda.is_available():
        fail(f"--device: {device} was asked for, but PyTorch finds no GPU. Pass --device cpu, or leave it out.")
    if track and importlib.util.find_spec("wandb") is None:
        fail("--track: Weights & Biases is not installed: pip install wandb")


def check_file(path: str, env_id: str, algorithm: type[EqRAlgorithm]) -> None:
    """Leave with a message if a hyperparameter file has no entry for the environment, or a wrong key in it."""
    if not path.endswith((".yml", ".yaml")):
        if not path.endswith(".py") and importlib.util.find_spec(path.split(".")[0]) is None:
            fail(f"--conf-file: {path!r} is no file, no Python package, and none of {', '.join(configuration_files())}.")
        return
    if not pathlib.Path(path).is_file():
        fail(f"--conf-file: there is no file {path!r}.")
    entries = yaml.safe_load(pathlib.Path(path).read_text(encoding="utf-8")) or {}
    is_atari = ExperimentManager.is_atari(env_id) and "atari" in entries
    name = env_id if env_id in entries else "atari" if is_atari else "default"
    if name not in entries:
        fail(f"{path}: no entry for {env_id!r}; it has {', '.join(entries)}. Add one, or pass --conf-file with another file.")
    check_keys(entries[name], algorithm, path)


# What RL Zoo takes out of an entry before it calls the constructor.
ENTRY_KEYS = {*ZOO_KEYS, "vec_env_wrapper", "monitor_kwargs", "env_kwargs", "callback"}


def check_keys(entry: dict[str, Any], algorithm: type[EqRAlgorithm], path: str) -> None:
    """
    Leave with a message if an entry has a key that no constructor takes.

    :param entry: hyperparameters for one environment
    :param algorithm: whose constructor they are for
    :param path: of their file
    """
    legal = ENTRY_KEYS | set(inspect.signature(algorithm).parameters)
    for key in entry:
        if key not in legal:
            fail(f"{path}: {key!r} is no argument of {algorithm.__name__}.{nearest(key, legal)}")
    policy_kwargs = entry.get("policy_kwargs") or {}
    policy = algorithm.policy_aliases["MlpPolicy"]
    own = {name for kind in policy.__mro__[:2] for name in inspect.signature(kind.__init__).parameters}  # type: ignore[misc]
    for key in policy_kwargs if isinstance(policy_kwargs, dict) else ():
        if key not in own:
            fail(f"{path}: {key!r} is no policy_kwargs of {algorithm.__name__}.{nearest(key, own)}")


def run(command: str, arguments: list[str]) -> None:
    """
    :param command: a key of ``FUNCTIONS`` or ``MODULES``
    :param arguments: RL Zoo's own, on its command line
    """
    sys.argv = [f"sb3-eqr {command}", *arguments]
    if command in MODULES:
        runpy.run_module(MODULES[command], run_name="__main__")
        return
    module, function = FUNCTIONS[command].split(":")
    try:
        getattr(importlib.import_module(module), function)()
    except ModuleNotFoundError as error:
        fail(f'{command} needs {error.name}: pip install "sb3-eqr[zoo]"')


def main() -> None:
    """The command line."""
    commands = [*FUNCTIONS, *MODULES]
    usage = f"usage: sb3-eqr {{{','.join(commands)}}} ...\n\nEvery command takes RL Zoo's arguments: sb3-eqr train --help"
    if len(sys.argv) < 2 or sys.argv[1] in ("-h", "--help"):
        print(usage)
        return
    command, arguments = sys.argv[1], sys.argv[2:]
    if command not in commands:
        fail(f"expected one of {', '.join(commands)}, found {command!r}.{nearest(command, commands)}")
    register()
    # Only what is looked at here; RL Zoo parses everything once more.
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--algo", default="ppo")
    parser.add_argument("--env", default="CartPole-v1")
    parser.add_argument("-conf", "--conf-file")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--track", action="store_true")
    parser.add_argument("--gym-packages", nargs="+", default=[])
    args, _ = parser.parse_known_args(arguments)
    if command in ("train", "enjoy", *MODULES) and not {"-h", "--help"} & set(arguments):
        check_algo(args.algo)
    if command == "train" and not {"-h", "--help"} & set(arguments):
        path = find_hyperparameters(args.algo, args.conf_file)
        check_environment(args.env, args.gym_packages)
        check_machine(args.device, args.track)
        if path is not None and args.algo in AGENTS:
            check_file(path, args.env, AGENTS[args.algo])
        if path is not None and path != args.conf_file:
            arguments = [*arguments, "--conf-file", path]  # the last one counts
    run(command, arguments)


if __name__ == "__main__":
    main()
