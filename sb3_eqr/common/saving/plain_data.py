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
    "stable_baselines3.common.noise": ("NormalActionNoise", "OrnsteinUhlenbeckActionNoise", "VectorizedActionNoise"),
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
    kind: Any = type(value)
    if value is None or kind in (bool, int, float, str):
        return value
    if kind in ENCODERS:
        return ENCODERS[kind](value)
    if isinstance(value, (np.ndarray, np.generic)) and value.dtype.kind in "biufcSUMm":
        data = base64.b64encode(value.tobytes()).decode()
        array = "scalar" if value.ndim == 0 else "array"
        return {KIND: array, "dtype": value.dtype.str, "shape": list(value.shape), "data": data}
    if kind.__name__ in SPACES and kind is getattr(spaces, kind.__name__):
        return _encode_space(value)
    if isinstance(value, type) and issubclass(value, np.number):
        return {KIND: "numpy type", "dtype": np.dtype(value).str}
    if isinstance(value, (type, FunctionType)):
        kind = value
        if _is_legal(value):
            return {KIND: "class", "module": value.__module__, "name": value.__qualname__}
    elif kind.__name__ in OBJECTS.get(kind.__module__, ()):
        return _encode_object(value)
    name = f"{kind.__module__}.{kind.__qualname__}"
    return {KIND: "pickle", "type": name, "pickle": base64.b64encode(cloudpickle.dumps(value)).decode()}


def _encode_dict(value: dict[Any, Any]) -> Any:
    if all(isinstance(key, str) for key in value) and KIND not in value:
        return {key: encode(item) for key, item in value.items()}
    return {KIND: "dict", "items": [[encode(key), encode(item)] for key, item in value.items()]}


def _encode_space(space: Any) -> Any:
    name = type(space).__name__
    arguments = {key: getattr(space, key) for key in SPACES[name]}
    if name == "Dict":
        arguments["spaces"] = dict(arguments["spaces"])
    if "dtype" in arguments:
        arguments["dtype"] = np.dtype(arguments["dtype"]).str
    if name == "Discrete" and space.dtype == np.int64:
        del arguments["dtype"]  # older versions of Gymnasium, where it is always int64, have no such argument
    return {KIND: "space", "name": name, "arguments": encode(arguments)}


def _encode_object(value: Any) -> Any:
    name = {"module": type(value).__module__, "name": type(value).__name__}
    if isinstance(value, enum.Enum):
        return {KIND: "enum", **name, "value": encode(value.value)}
    if isinstance(value, tuple):
        return {KIND: "named tuple", **name, "items": encode(list(value))}
    return {KIND: "object", **name, "attributes": {key: encode(item) for key, item in vars(value).items()}}


ENCODERS: dict[type, Callable[[Any], Any]] = {
    list: lambda value: [encode(item) for item in value],
    dict: _encode_dict,
    OrderedDict: _encode_dict,
    tuple: lambda value: {KIND: "tuple", "items": encode(list(value))},
    deque: lambda value: {KIND: "deque", "items": encode(list(value)), "maxlen": value.maxlen},
    th.dtype: lambda value: {KIND: "dtype", "name": str(value).removeprefix("torch.")},
    th.device: lambda value: {KIND: "device", "name": str(value)},
    th.Tensor: lambda value: {KIND: "tensor", "array": encode(value.detach().cpu().numpy())},
}


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
        value = {KIND: "pickle", "pickle": value[":serialized:"], "type": value.get(":type:")}
    if KIND in value and value[KIND] not in DECODERS:
        raise ValueError(f"data must be written by save(), got {KIND} {value[KIND]!r}.")
    if value.get(KIND) == "pickle" and not trust:
        raise UntrustedError(f"a pickle of {value.get('type')}")
    parts = {key: decode(item, trust) for key, item in value.items()}
    return DECODERS[value[KIND]](parts) if KIND in value else parts


def _decode_array(parts: dict[str, Any]) -> Any:
    content = bytearray(base64.b64decode(parts["data"]))  # writeable; and no larger than the file, whatever it declares
    array = np.frombuffer(content, np.dtype(str(parts["dtype"]))).reshape(parts["shape"])
    return array[()] if parts[KIND] == "scalar" else array


def _decode_dtype(parts: dict[str, Any]) -> th.dtype:
    found = getattr(th, parts["name"])
    if not isinstance(found, th.dtype):
        raise ValueError(f"data must name a dtype of torch, got {parts['name']!r}.")
    return found


def _decode_space(parts: dict[str, Any]) -> spaces.Space:
    name, arguments = parts["name"], parts["arguments"]
    if name not in SPACES:
        raise ValueError(f"data must name one of the spaces {list(SPACES)}, got {name!r}.")
    if name == "Dict":  # which sorts the keys of a plain dict, but features extractors concatenate in their order
        arguments["spaces"] = OrderedDict(arguments["spaces"])
    return getattr(spaces, name)(**arguments)


def _decode_class(parts: dict[str, Any]) -> Any:
    found = _find(parts["module"], parts["name"])
    if not _is_legal(found):
        raise ValueError(f"data must name a class that agents use, got {parts['module']}.{parts['name']}.")
    return found


def _decode_object(parts: dict[str, Any]) -> Any:
    if parts["name"] not in OBJECTS.get(parts["module"], ()):
        raise ValueError(f"data must be objects of {sorted(OBJECTS)}, got {parts['module']}.{parts['name']}.")
    kind = _find(parts["module"], parts["name"])
    if parts[KIND] == "enum":
        return kind(parts["value"])
    if parts[KIND] == "named tuple":
        return kind(*parts["items"])
    made = object.__new__(kind)
    vars(made).update(parts["attributes"])
    if hasattr(kind, "__post_init__"):
        kind.__post_init__(made)  # the check of the class: a file may have an attribute of this name
    return made


DECODERS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "dict": lambda parts: dict(parts["items"]),
    "tuple": lambda parts: tuple(parts["items"]),
    "deque": lambda parts: deque(parts["items"], parts["maxlen"]),
    "array": _decode_array,
    "scalar": _decode_array,
    "dtype": _decode_dtype,
    "numpy type": lambda parts: np.dtype(str(parts["dtype"])).type,
    "device": lambda parts: th.device(parts["name"]),
    "tensor": lambda parts: th.from_numpy(np.ascontiguousarray(parts["array"])),
    "space": _decode_space,
    "class": _decode_class,
    **dict.fromkeys(("object", "named tuple", "enum"), _decode_object),
    "pickle": lambda parts: cloudpickle.loads(base64.b64decode(parts["pickle"])),
}


def _find(module: str, name: str) -> Any:
    """The object of this name, or ``None`` if there is none in a module that is imported or that a file may import."""
    if module.split(".")[0] not in PACKAGES and module not in OBJECTS:
        raise ValueError(f"data must name classes of {', '.join(PACKAGES)}, got {module}.{name}.")
    may_import = module in OBJECTS or module.startswith(DEFINING)
    found: Any = importlib.import_module(module) if may_import else sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return found


def _is_legal(value: Any) -> bool:
    """Whether this is a class that agents use, or a function of the groups package, defined at the top level of a module."""
    if isinstance(value, type):
        legal = issubclass(value, CLASSES) and str(value.__module__).split(".")[0] in PACKAGES
    else:
        legal = isinstance(value, FunctionType) and str(value.__module__).startswith("sb3_eqr.common.groups.")
    return legal and "<locals>" not in value.__qualname__ and "<lambda>" not in value.__qualname__
