"""
Convert Python values to JSON and back without executing code: numbers, strings, containers, arrays, spaces, schedules, and
classes of the packages that agents use. Any other value is pickled, and unpickled only if the file is trusted.
"""

import base64
import enum
import importlib
import sys
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping
from types import FunctionType
from typing import Any

import cloudpickle
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.policies import BasePolicy
from torch import nn

KIND = ":kind:"  # marks values that JSON cannot represent
PACKAGES = ("torch", "stable_baselines3", "sb3_contrib", "sb3_eqr")  # whose classes are looked up by name
# A file may import modules of these packages, which contain only definitions. Modules of other packages must already be
# imported, because some of torch's modules are programs.
DEFINING = ("stable_baselines3.", "sb3_contrib.")
CLASSES = (nn.Module, th.optim.Optimizer, ReplayBuffer, BasePolicy)  # base classes of the legal classes
# Classes whose objects consist only of their attributes.
OBJECTS = {
    "stable_baselines3.common.utils": ("FloatSchedule", "LinearSchedule", "ConstantSchedule"),
    "stable_baselines3.common.type_aliases": ("TrainFreq", "TrainFrequencyUnit"),
    "rl_zoo3.utils": ("SimpleLinearSchedule",),
    "sb3_eqr.common.resets": ("ResetSchedule", "Resets"),
    "sb3_eqr.common.groups.matrix": ("GL", "SE", "SO", "T", "NoGroup", "MatrixLieGroup"),
    "sb3_eqr.common.groups.product": ("ProductGroup",),
}
SPACES = {"Box": ("low", "high", "shape", "dtype"), "Discrete": ("n", "start", "dtype")}
SPACES["MultiDiscrete"] = ("nvec", "start", "dtype")
SPACES |= {"MultiBinary": ("n",), "Dict": ("spaces",), "Tuple": ("spaces",)}


class UntrustedError(ValueError):
    """A file contains pickles, and unpickling runs the functions they name."""


def encode(value: Any) -> Any:
    """Convert a value to JSON; values of types that this module does not list are embedded as pickles."""
    if value is None or type(value) in (bool, int, float, str):
        return value
    for encoder in (_encode_container, _encode_array, _encode_space, _encode_known):
        found = encoder(value)
        if found is not None:
            return found
    kind = value if isinstance(value, (type, FunctionType)) else type(value)
    name = f"{kind.__module__}.{kind.__qualname__}"
    return {KIND: "pickle", "type": name, "pickle": base64.b64encode(cloudpickle.dumps(value)).decode()}


def _encode_container(value: Any) -> Any:
    if type(value) is list:
        return [encode(item) for item in value]
    if type(value) in (dict, OrderedDict):
        if all(isinstance(key, str) for key in value) and KIND not in value:
            return {key: encode(item) for key, item in value.items()}
        return {KIND: "dict", "items": [[encode(key), encode(item)] for key, item in value.items()]}
    if type(value) is tuple:
        return {KIND: "tuple", "items": [encode(item) for item in value]}
    if type(value) is deque:
        return {KIND: "deque", "items": [encode(item) for item in value], "maxlen": value.maxlen}
    return None


def _encode_array(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic)) and value.dtype.kind in "biufcSUMm":
        data = base64.b64encode(value.tobytes()).decode()
        return {
            KIND: "scalar" if value.ndim == 0 else "array",
            "dtype": value.dtype.str,
            "shape": list(value.shape),
            "data": data,
        }
    if isinstance(value, th.dtype):
        return {KIND: "dtype", "name": str(value).removeprefix("torch.")}
    if isinstance(value, th.device):
        return {KIND: "device", "name": str(value)}
    if type(value) is th.Tensor:
        return {KIND: "tensor", "array": encode(value.detach().cpu().numpy())}
    return None


def _encode_space(space: Any) -> Any:
    name = type(space).__name__
    if name not in SPACES or type(space) is not getattr(spaces, name):
        return None
    arguments = {key: getattr(space, key) for key in SPACES[name]}
    if name == "Dict":
        arguments["spaces"] = dict(arguments["spaces"])
    if "dtype" in arguments:
        arguments["dtype"] = np.dtype(arguments["dtype"]).str
    if name == "Discrete" and space.dtype == np.int64:
        del arguments["dtype"]  # older versions of Gymnasium, where it is always int64, have no such argument
    return {KIND: "space", "name": name, "arguments": encode(arguments)}


def _encode_known(value: Any) -> Any:
    if isinstance(value, (type, FunctionType)):
        name = {"module": value.__module__, "name": value.__qualname__}
        return {KIND: "class", **name} if _is_legal(value) else None
    kind = type(value)
    if kind.__name__ not in OBJECTS.get(kind.__module__, ()):
        return None
    name = {"module": kind.__module__, "name": kind.__name__}
    if isinstance(value, enum.Enum):
        return {KIND: "enum", **name, "value": encode(value.value)}
    if isinstance(value, tuple):
        return {KIND: "named tuple", **name, "items": [encode(item) for item in value]}
    return {KIND: "object", **name, "attributes": {key: encode(item) for key, item in vars(value).items()}}


def without_pickles(value: Any) -> Any:
    """Encoded data with the types of pickled objects in place of their pickles, which differ from process to process."""
    if isinstance(value, list):
        return [without_pickles(item) for item in value]
    if not isinstance(value, dict):
        return value
    return value["type"] if value.get(KIND) == "pickle" else {key: without_pickles(item) for key, item in value.items()}


def decode(value: Any, trust: bool = False) -> Any:
    """
    Convert JSON back to a value.

    :param value: JSON returned by :func:`encode`
    :param trust: whether to load pickles in it, which runs the functions they name
    :return: the value
    :raises UntrustedError: if there is a pickle and ``trust`` is ``False``
    :raises ValueError: if :func:`encode` cannot have written the JSON
    """
    if isinstance(value, list):
        return [decode(item, trust) for item in value]
    if not isinstance(value, Mapping):
        return value
    if ":serialized:" in value:  # SB3's own format
        return _decode_pickle({"pickle": value[":serialized:"], "type": value.get(":type:")}, trust)
    if KIND not in value:
        return {key: decode(item, trust) for key, item in value.items()}
    if value[KIND] not in DECODERS:
        raise ValueError(f"data must be written by save(), got {KIND} {value[KIND]!r}.")
    return DECODERS[value[KIND]](value, trust)


def _decode_array(value: Mapping[str, Any], trust: bool) -> Any:
    content = bytearray(base64.b64decode(value["data"]))  # writeable; and no larger than the file, whatever it declares
    array = np.frombuffer(content, np.dtype(str(value["dtype"]))).reshape(value["shape"])
    return array[()] if value[KIND] == "scalar" else array


def _decode_dtype(value: Mapping[str, Any], trust: bool) -> th.dtype:
    found = getattr(th, value["name"])
    if not isinstance(found, th.dtype):
        raise ValueError(f"data must name a dtype of torch, got {value['name']!r}.")
    return found


def _decode_space(value: Mapping[str, Any], trust: bool) -> spaces.Space:
    if value["name"] not in SPACES:
        raise ValueError(f"data must name one of the spaces {list(SPACES)}, got {value['name']!r}.")
    arguments = decode(value["arguments"], trust)
    if value["name"] == "Dict":  # which sorts the keys of a plain dict, but features extractors concatenate in their order
        arguments["spaces"] = OrderedDict(arguments["spaces"])
    return getattr(spaces, value["name"])(**arguments)


def _decode_class(value: Mapping[str, Any], trust: bool) -> Any:
    found = _find(value["module"], value["name"])
    if not _is_legal(found):
        raise ValueError(f"data must name a class that agents use, got {value['module']}.{value['name']}.")
    return found


def _decode_object(value: Mapping[str, Any], trust: bool) -> Any:
    if value["name"] not in OBJECTS.get(value["module"], ()):
        raise ValueError(f"data must be objects of {sorted(OBJECTS)}, got {value['module']}.{value['name']}.")
    found: Any = _find(value["module"], value["name"])
    if value[KIND] == "enum":
        return found(decode(value["value"], trust))
    if value[KIND] == "named tuple":
        return found(*[decode(item, trust) for item in value["items"]])
    attributes = decode(value["attributes"], trust)
    made = object.__new__(found)
    vars(made).update(attributes)
    check = getattr(found, "__post_init__", None)
    if check is not None:
        check(made)
    return made


def _decode_pickle(value: Mapping[str, Any], trust: bool) -> Any:
    if not trust:
        raise UntrustedError(f"a pickle of {value.get('type')}")
    return cloudpickle.loads(base64.b64decode(value["pickle"]))


DECODERS: dict[str, Callable[[Mapping[str, Any], bool], Any]] = {
    "dict": lambda value, trust: {decode(key, trust): decode(item, trust) for key, item in value["items"]},
    "tuple": lambda value, trust: tuple(decode(value["items"], trust)),
    "deque": lambda value, trust: deque(decode(value["items"], trust), value["maxlen"]),
    "array": _decode_array,
    "scalar": _decode_array,
    "dtype": _decode_dtype,
    "device": lambda value, trust: th.device(value["name"]),
    "tensor": lambda value, trust: th.from_numpy(np.ascontiguousarray(decode(value["array"], trust))),
    "space": _decode_space,
    "class": _decode_class,
    "object": _decode_object,
    "named tuple": _decode_object,
    "enum": _decode_object,
    "pickle": _decode_pickle,
}


def _find(module: str, name: str) -> Any:
    if module.split(".")[0] not in PACKAGES and module not in OBJECTS:
        raise ValueError(f"data must name classes of {', '.join(PACKAGES)}, got {module}.{name}.")
    may_import = module in OBJECTS or module.startswith(DEFINING)
    found: Any = importlib.import_module(module) if may_import else sys.modules.get(module)
    if found is None:
        raise ValueError(f"data must name a class that agents use, got {module}.{name}.")
    for part in name.split("."):
        found = getattr(found, part)
    return found


def _is_legal(value: Any) -> bool:
    """Whether this is a class that agents use, or a function of the groups package, defined at the top level of a module."""
    if isinstance(value, type):
        legal = issubclass(value, CLASSES) and str(value.__module__).split(".")[0] in PACKAGES
    else:
        legal = isinstance(value, FunctionType) and str(value.__module__).startswith("sb3_eqr.common.groups.")
    return legal and "<locals>" not in value.__qualname__ and "<lambda>" not in value.__qualname__
