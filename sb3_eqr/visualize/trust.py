"""What RL Zoo writes beside a model, looked at before anything in it can run."""

import ast
import pathlib
import pickle
from collections import OrderedDict
from typing import Any

import yaml

PASS_TRUST = "If you know where the file comes from, pass --trust."
# Modules whose classes and functions a file may name.
WRAPPERS = ("sb3_eqr.", "stable_baselines3.", "sb3_contrib.", "gymnasium.wrappers.", "rl_zoo3.wrappers.")
# Of these alone the statistics of VecNormalize are made. numpy has moved its private modules from core to _core.
STATISTICS = {
    "stable_baselines3.common.vec_env.vec_normalize": ("VecNormalize",),
    "stable_baselines3.common.running_mean_std": ("RunningMeanStd",),
    "gymnasium.spaces.box": ("Box",),
    "gymnasium.spaces.discrete": ("Discrete",),
    "gymnasium.spaces.dict": ("Dict",),
    "numpy": ("ndarray", "dtype", "bool_"),
    "collections": ("OrderedDict",),
}
for core in ("numpy.core", "numpy._core"):
    STATISTICS[f"{core}.multiarray"] = ("_reconstruct", "scalar")
    STATISTICS[f"{core}.numeric"] = ("_frombuffer",)
STATISTICS["numpy.random._pickle"] = ("__generator_ctor", "__bit_generator_ctor")
STATISTICS["numpy.random._pcg64"] = ("PCG64",)
STATISTICS["numpy.random._generator"] = ("Generator",)
STATISTICS["numpy.random.bit_generator"] = ("__pyx_unpickle_SeedSequence", "SeedSequence")


class _PlainLoader(yaml.SafeLoader):
    """YAML of plain values, and the ordered dictionaries and tuples that RL Zoo writes."""


def _ordered(loader: yaml.SafeLoader, node: yaml.Node) -> Any:
    pairs = loader.construct_sequence(node, deep=True)  # type: ignore[arg-type]
    return OrderedDict(pairs[0]) if pairs else OrderedDict()


_PlainLoader.add_constructor("tag:yaml.org,2002:python/object/apply:collections.OrderedDict", _ordered)
_PlainLoader.add_constructor("tag:yaml.org,2002:python/tuple", lambda loader, node: tuple(loader.construct_sequence(node)))


class _Statistics(pickle.Unpickler):
    """Makes what ``STATISTICS`` names and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        if name not in STATISTICS.get(module, ()):
            raise ValueError(f"it names {module}.{name}")
        return super().find_class(module, name)


def read_plain(path: pathlib.Path) -> dict[str, Any]:
    """
    :param path: a YAML file of RL Zoo
    :return: its contents
    :raises ValueError: if it names Python objects, or is something else
    """
    try:
        found = yaml.load(path.read_text(encoding="utf-8"), Loader=_PlainLoader)
    except (yaml.YAMLError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: it must hold plain values, got: {' '.join(str(error).split())}. {PASS_TRUST}") from error
    if not isinstance(found, dict):
        raise ValueError(f"{path}: it must hold names and values, got {found!r:.60}.")
    return found


def check_zoo_folder(folder: pathlib.Path) -> None:
    """
    :param folder: with args.yml and config.yml of RL Zoo
    :raises ValueError: if making the environment by them would import or evaluate what is not of the packages of ``WRAPPERS``
    """
    arguments, config = read_plain(folder / "args.yml"), read_plain(folder / "config.yml")
    named = [*(arguments.get("gym_packages") or []), *([arguments["env"]] if ":" in str(arguments.get("env")) else [])]
    for key in ("env_wrapper", "vec_env_wrapper"):
        named += [name for name in _names(config.get(key)) if not name.startswith(WRAPPERS)]
    normalize = config.get("normalize")
    if isinstance(normalize, str):
        try:
            ast.literal_eval(normalize)
        except (ValueError, SyntaxError):
            named.append(normalize)
    if named:
        raise ValueError(
            f"{folder}: it must name nothing but wrappers of {WRAPPERS}, got {', '.join(map(str, named))}. {PASS_TRUST}"
        )
    check_statistics(folder / "vecnormalize.pkl")


def check_statistics(path: pathlib.Path) -> None:
    """
    :param path: what VecNormalize's ``save`` wrote, or nothing
    :raises ValueError: if it holds anything but numbers and spaces
    """
    if not path.is_file():
        return
    try:
        with open(path, "rb") as file:
            _Statistics(file).load()
    except Exception as error:  # of a damaged pickle, any
        raise ValueError(f"{path}: it must hold the statistics of VecNormalize alone, got: {error}. {PASS_TRUST}") from error


def _names(wrappers: Any) -> list[str]:
    """The names in RL Zoo's notation: a name, a dictionary with one key, or a list of these."""
    if wrappers is None:
        return []
    if isinstance(wrappers, (list, tuple)):
        return [name for wrapper in wrappers for name in _names(wrapper)]
    return [str(name) for name in wrappers] if isinstance(wrappers, dict) else [str(wrappers)]
