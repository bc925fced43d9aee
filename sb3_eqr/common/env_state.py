"""
Capturing the state of environments as plain data, and restoring it into environments that were built alike. Restoring creates
no objects but arrays and containers, and executes no code of the file; it sets attributes and the states of random generators.
"""

import copyreg
import enum
import io
import logging
import random
import types
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import VecEnv

from sb3_eqr.common.plain_data import KIND, decode, encode

# Values that are not captured: definitions, and handles to the outside such as files and loggers.
FIXED: tuple[type, ...] = (type, types.ModuleType, types.FunctionType, types.BuiltinFunctionType, types.MethodType)
FIXED += (spaces.Space, np.dtype, io.IOBase, logging.Logger, ResultsWriter)
SKIPPED = ("spec", "_cached_spec", "metadata", "class_attributes")
CLASS = ":class:"  # key of the name of an object's class
NUMBER = ":number:"  # key of the number of an object, in the order in which objects are encountered
PLAIN = (bool, int, float, str, bytes)
WRAPPED = ("env", "venv", "envs")  # attributes that hold the environment that a wrapper wraps


class MissingObjectError(ValueError):
    """An environment created an object during the run, which a new one does not have. ``path``: where it was."""

    def __init__(self, path: str):
        super().__init__(f"{path} must be an object, got nothing: the original environment created one during its run.")
        self.path = path


def capture(root: Any) -> tuple[Any, list[str]]:
    """
    :param root: an environment, vectorised or not, with all its wrappers
    :return: its state as JSON, and the paths of objects whose state is not accessible from Python, such as a physics engine;
        empty if the state is complete
    """
    hidden: list[str] = []
    return _capture(root, "", {}, hidden), hidden


def restore(root: Any, state: Any) -> None:
    """
    :param root: an environment built like the captured one
    :param state: state returned by :func:`capture`
    :raises ValueError: if the environment was built differently
    :raises MissingObjectError: if it was built in the same way, but later created an object; the state is restored in part
    """
    _restored(root, state, type(root).__name__, {})


def _capture(value: Any, path: str, seen: dict[int, int], hidden: list[str]) -> Any:
    if value is None or type(value) in PLAIN or isinstance(value, np.generic):
        return {KIND: "plain", "value": encode(value.hex()) if isinstance(value, bytes) else encode(value)}
    if isinstance(value, enum.Enum):
        return {KIND: "member", "name": value.name}
    if isinstance(value, FIXED):
        return None
    if id(value) in seen:  # an object is captured where it is first encountered
        return {KIND: "same", NUMBER: seen[id(value)]}
    seen[id(value)] = len(seen)
    found = _captured_once(value, path, seen, hidden)
    return None if found is None else {**found, NUMBER: seen[id(value)]}


def _captured_once(value: Any, path: str, seen: dict[int, int], hidden: list[str]) -> Any:
    if isinstance(value, np.ndarray) and value.dtype != object:
        return {KIND: "plain", "value": encode(value)}
    if isinstance(value, th.Tensor):
        return {KIND: "tensor", "value": encode(value.detach().cpu().numpy())}
    if type(value) is random.Random:
        return {KIND: "generator", "value": encode(value.getstate())}
    if isinstance(value, (np.random.Generator, np.random.RandomState)):
        state: Any = value.bit_generator.state if isinstance(value, np.random.Generator) else value.get_state()
        return {KIND: "generator", "value": encode(state)}
    if hasattr(value, "cloneSystemState"):
        return {KIND: "emulator", "value": value.cloneSystemState().serialize().hex()}
    if isinstance(value, (list, tuple, deque)):
        return {KIND: "items", "items": [_capture(item, f"{path}[{i}]", seen, hidden) for i, item in enumerate(value)]}
    if isinstance(value, dict) and all(map(_is_plain_key, value)):
        items = [_capture(item, f"{path}[{key!r}]", seen, hidden) for key, item in value.items()]
        return {KIND: "keys", "keys": [encode(key) for key in value], "items": items}
    if not hasattr(value, "__dict__") or not _is_made_of_attributes(type(value)):
        hidden.append(path)
        return None
    children = {name: child for name, child in vars(value).items() if name not in SKIPPED}
    kind = {CLASS: type(value).__name__} if isinstance(value, VecEnv) else {}  # gymnasium's wrappers may be substituted
    found = {name: _capture(child, f"{path}.{name}", seen, hidden) for name, child in children.items()}
    return {KIND: "attributes", **kind, **found}


def _is_plain_key(key: Any) -> bool:
    return key is None or type(key) in (bool, int, str) or (type(key) is tuple and all(map(_is_plain_key, key)))


def _is_made_of_attributes(cls: type) -> bool:
    """Whether instances have no state outside ``__dict__``, as those of classes that derive from one written in C have."""
    of_c = next(base for base in cls.__mro__ if not base.__flags__ & copyreg._HEAPTYPE)  # type: ignore[attr-defined]
    return of_c is object and not any(vars(base).get("__slots__") for base in cls.__mro__)


def _restored(current: Any, state: Any, path: str, objects: dict[int, Any]) -> Any:
    """
    The restored value for ``current``; objects and arrays are updated in place where possible.

    :param objects: number -> restored object
    """
    if state is None:
        return current
    if state[KIND] == "same":
        return objects.get(state[NUMBER], current)
    if NUMBER in state:
        objects[state[NUMBER]] = current  # containers may contain themselves
    found = HANDLERS[state[KIND]](current, state, path, objects)
    if NUMBER in state:
        objects[state[NUMBER]] = found
    return found


def _restored_member(current: Any, state: Any, path: str, objects: dict[int, Any]) -> Any:
    if not isinstance(current, enum.Enum):
        raise MissingObjectError(path)
    return type(current)[state["name"]]


def _restored_tensor(current: Any, state: Any, path: str, objects: dict[int, Any]) -> Any:
    found = th.from_numpy(decode(state["value"]))
    if isinstance(current, th.Tensor) and (current.shape, current.dtype) == (found.shape, found.dtype):
        with th.no_grad():
            return current.copy_(found)
    return found


def _restored_plain(current: Any, state: Any, path: str, objects: dict[int, Any]) -> Any:
    found = decode(state["value"])
    if isinstance(current, bytes):
        return bytes.fromhex(found)
    if isinstance(found, np.ndarray) and isinstance(current, np.ndarray) and current.flags.writeable:
        if (found.shape, found.dtype) == (current.shape, current.dtype):
            current[...] = found  # other objects may share this memory
            return current
    return found


def _restored_generator(current: Any, state: Any, path: str, objects: dict[int, Any]) -> Any:
    if current is None:
        raise MissingObjectError(path)
    if isinstance(current, random.Random):
        current.setstate(decode(state["value"]))
    elif isinstance(current, np.random.RandomState):
        current.set_state(decode(state["value"]))
    else:
        current.bit_generator.state = decode(state["value"])
    return current


def _restored_emulator(current: Any, state: Any, path: str, objects: dict[int, Any]) -> Any:
    kind = type(current.cloneSystemState())
    current.restoreSystemState(kind(bytes.fromhex(state["value"])))
    return current


def _restored_attributes(current: Any, state: Any, path: str, objects: dict[int, Any]) -> Any:
    found, expected = type(current).__name__, state.get(CLASS)
    if current is None and expected is None and path.rpartition(".")[2].partition("[")[0] not in WRAPPED:
        raise MissingObjectError(path)
    if current is None or (expected is not None and found != expected):
        raise ValueError(
            f"{path} must be {'an object' if expected is None else f'a {expected}'}, "
            f"got {'nothing' if current is None else found}: the environment is not built as in the original run. "
            "Pass one with the same wrappers, including VecNormalize."
        )
    for name, child in state.items():
        if name not in (KIND, CLASS, NUMBER):
            old = getattr(current, name, None)
            vars(current)[name] = _restored(old, child, f"{path}.{name}", objects)  # some objects refuse setattr
    return current


def _restored_keys(current: Any, state: Any, path: str, objects: dict[int, Any]) -> Any:
    old = dict(current) if isinstance(current, dict) else {}
    items = zip([decode(key) for key in state["keys"]], state["items"], strict=True)
    found = {key: _restored(old.get(key), child, f"{path}[{key!r}]", objects) for key, child in items}
    if not isinstance(current, dict):
        return found
    current.clear()
    current.update(found)
    return current


def _restored_items(current: Any, state: Any, path: str, objects: dict[int, Any]) -> Any:
    items = state["items"]
    old = list(current) if isinstance(current, (list, tuple, deque)) else []
    old += [None] * (len(items) - len(old))
    found = [_restored(a, b, f"{path}[{i}]", objects) for i, (a, b) in enumerate(zip(old, items, strict=False))]
    if isinstance(current, tuple):
        return type(current)(*found) if hasattr(current, "_fields") else tuple(found)
    if not isinstance(current, (list, deque)):
        return found
    current.clear()
    current.extend(found)
    return current


HANDLERS: dict[str, Callable[[Any, Any, str, dict[int, Any]], Any]] = {
    "plain": _restored_plain,
    "member": _restored_member,
    "tensor": _restored_tensor,
    "generator": _restored_generator,
    "emulator": _restored_emulator,
    "items": _restored_items,
    "keys": _restored_keys,
    "attributes": _restored_attributes,
}
