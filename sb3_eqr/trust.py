"""Check the files that RL Zoo writes next to a model, before any code that they name can run."""

import ast
import importlib
import pathlib
import pickle
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import yaml
from stable_baselines3.common.vec_env import VecEnvWrapper

PASS_TRUST = "If you know where the file comes from, pass --trust."
# A file may name the wrappers of these modules, except those that write files.
WRAPPERS: tuple[str, ...] = ("sb3_eqr.envs.", "stable_baselines3.common.atari_wrappers.", "stable_baselines3.common.vec_env.")
WRAPPERS += ("sb3_contrib.common.wrappers.", "gymnasium.wrappers.", "rl_zoo3.wrappers.", "rl_zoo3.gym_patches.")
EVALUATED = ("normalize", "policy_kwargs", "replay_buffer_kwargs", "monitor_kwargs")  # strings that RL Zoo evaluates
IMPORTED = ("policy", "replay_buffer_class", "callback")  # names that it imports
# The syntax of plain values, and calls, of which only those of dict are allowed.
PLAIN: tuple[type[ast.AST], ...] = (ast.Expression, ast.Call, ast.Name, ast.Load, ast.keyword, ast.Dict, ast.List, ast.Tuple)
PLAIN += (ast.Constant, ast.UnaryOp, ast.USub)
WRITING = ("Monitor", "Record", "Video")  # parts of names
# The only names in the statistics of VecNormalize. NumPy has moved its private modules from core to _core.
STATISTICS = {
    "stable_baselines3.common.vec_env.vec_normalize": ("VecNormalize",),
    "stable_baselines3.common.running_mean_std": ("RunningMeanStd",),
    "gymnasium.spaces.box": ("Box",),
    "gymnasium.spaces.discrete": ("Discrete",),
    "gymnasium.spaces.dict": ("Dict",),
    "numpy": ("ndarray", "dtype", "bool_"),
    "numpy.random._pickle": ("__generator_ctor", "__bit_generator_ctor"),
    "numpy.random._pcg64": ("PCG64",),
    "numpy.random._generator": ("Generator",),
    "numpy.random.bit_generator": ("__pyx_unpickle_SeedSequence", "SeedSequence"),
    "collections": ("OrderedDict",),
    **{f"{core}.multiarray": ("_reconstruct", "scalar") for core in ("numpy.core", "numpy._core")},
    **{f"{core}.numeric": ("_frombuffer",) for core in ("numpy.core", "numpy._core")},
}


class _PlainLoader(yaml.SafeLoader):
    """Loads plain values, and the ordered dictionaries and tuples that RL Zoo writes."""


def _ordered(loader: yaml.SafeLoader, node: yaml.Node) -> Any:
    pairs = loader.construct_sequence(node, deep=True)  # type: ignore[arg-type]
    return OrderedDict(pairs[0]) if pairs else OrderedDict()


_PlainLoader.add_constructor("tag:yaml.org,2002:python/object/apply:collections.OrderedDict", _ordered)
_PlainLoader.add_constructor("tag:yaml.org,2002:python/tuple", lambda loader, node: tuple(loader.construct_sequence(node)))


class _Statistics(pickle.Unpickler):
    """Creates only objects that ``STATISTICS`` names."""

    def find_class(self, module: str, name: str) -> Any:
        if name not in STATISTICS.get(module, ()):
            raise ValueError(f"it names {module}.{name}")
        return super().find_class(module, name)


def read_plain(path: pathlib.Path) -> dict[str, Any]:
    """
    :param path: a YAML file of RL Zoo
    :return: its contents
    :raises ValueError: if it names Python objects, or is not a mapping
    """
    try:
        found = yaml.load(path.read_text(encoding="utf-8"), Loader=_PlainLoader)
    except (yaml.YAMLError, TypeError, ValueError) as error:
        raise ValueError(f"{path} must contain plain values, got: {' '.join(str(error).split())}. {PASS_TRUST}") from error
    if not isinstance(found, dict):
        raise ValueError(f"{path} must be a mapping, got {found!r:.60}.")
    return found


def read_trusted(path: pathlib.Path) -> dict[str, Any]:
    """As :func:`read_plain`, with all Python objects that the file names, which runs their code."""
    return dict(yaml.unsafe_load(path.read_text(encoding="utf-8")))


def check_zoo_folder(folder: pathlib.Path, packages: Sequence[str] = ()) -> None:
    """
    :param folder: folder with RL Zoo's args.yml and config.yml
    :param packages: packages that the user has named, whose code may run
    :raises ValueError: if creating the environment from them would import or evaluate code outside ``WRAPPERS`` and
        ``packages``
    """
    files = (folder / "args.yml", folder / "config.yml")
    arguments, config = (read_plain(file) if file.is_file() else {} for file in files)  # RL Zoo reads what is there
    inside = tuple(f"{package}." for package in packages)
    package, colon, _ = str(arguments.get("env")).partition(":")
    named = [*map(str, arguments.get("gym_packages") or []), *([package] if colon else [])]
    for key in ("env_wrapper", "vec_env_wrapper"):
        named += [name for name in wrapper_names(config.get(key)) if not _is_harmless(name)]
    named = [name for name in named if name not in packages and not _is_of(name, inside)]
    named += [f"{key}: {config[key]}" for key in EVALUATED if isinstance(config.get(key), str) and not is_plain(config[key])]
    imported = [(key, name) for key in IMPORTED for name in wrapper_names(config.get(key)) if key != "policy" or "." in name]
    named += [f"{key}: {name}" for key, name in imported if not _is_of(name, inside)]
    if named:
        raise ValueError(
            f"{folder} must name only packages given with --gym-packages, and wrappers of {', '.join(WRAPPERS)} that write no "
            f"files, got {', '.join(named)}. {PASS_TRUST}"
        )
    check_statistics(folder / "vecnormalize.pkl")


def _is_of(name: str, packages: tuple[str, ...]) -> bool:
    """Whether a text is a name in one of the packages, and no other expression, which RL Zoo may evaluate."""
    return name.startswith(packages) and all(part.isidentifier() for part in name.split("."))


def is_plain(expression: str) -> bool:
    """Whether evaluating a string gives a value made of numbers, strings and containers, and calls nothing but ``dict``."""
    try:
        nodes = list(ast.walk(ast.parse(expression, mode="eval")))
    except (SyntaxError, ValueError, RecursionError, MemoryError):  # from null bytes and from depth
        return False
    calls = [node.func for node in nodes if isinstance(node, ast.Call)]
    names = [node.id for node in nodes if isinstance(node, ast.Name)]
    return all(isinstance(node, PLAIN) for node in nodes) and names == ["dict"] * len(calls)


def check_statistics(path: pathlib.Path) -> None:
    """
    :param path: file written by VecNormalize's ``save``; may not exist
    :raises ValueError: if it contains anything but numbers and spaces
    """
    if not path.is_file():
        return
    try:
        with open(path, "rb") as file:
            _Statistics(file).load()
    except Exception as error:  # a damaged pickle may raise anything
        raise ValueError(f"{path} must contain only statistics of VecNormalize, got: {error}. {PASS_TRUST}") from error


def _is_harmless(name: str) -> bool:
    """Whether this is a wrapper that one of the modules defines, and not another function or class that it imports."""
    if not name.startswith(WRAPPERS):
        return False
    module, _, attribute = name.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), attribute, None)
    except ImportError:
        return False
    if not (isinstance(found, type) and issubclass(found, (gym.Wrapper, VecEnvWrapper))):
        return False
    return f"{found.__module__}.".startswith(WRAPPERS) and not any(part in found.__name__ for part in WRITING)


def wrapper_names(wrappers: Any) -> list[str]:
    """:return: the names in RL Zoo's notation: a name, a dictionary with one key, or a list of these"""
    if wrappers is None:
        return []
    if isinstance(wrappers, (list, tuple)):
        return [name for wrapper in wrappers for name in wrapper_names(wrapper)]
    return [*map(str, wrappers)] if isinstance(wrappers, dict) else [str(wrappers)]
