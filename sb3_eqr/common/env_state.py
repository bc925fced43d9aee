"""
Capturing the state of environments as plain data, and restoring it into environments that were built alike. Restoring creates
no objects and executes no code; it only sets numbers, arrays and the states of random generators.
"""

import io
import logging
import types
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import VecEnv

from sb3_eqr.common.plain_data import KIND, decode, encode

# Values that are not captured: definitions, and handles to the outside such as files and loggers.
FIXED: tuple[type, ...] = (type, types.ModuleType, types.FunctionType, types.BuiltinFunctionType, types.MethodType)
FIXED += (spaces.Space, np.dtype, io.IOBase, logging.Logger, ResultsWriter)
SKIPPED = ("spec", "_cached_spec", "metadata", "class_attributes")
CLASS = ":class:"  # key of the name of an object's class
PLAIN = (bool, int, float, str, bytes, np.generic)


def capture(root: Any) -> tuple[Any, list[str]]:
    """
    :param root: an environment, vectorised or not, with all its wrappers
    :return: its state as JSON, and the paths of objects whose state is not accessible from Python, such as a physics engine;
        empty if the state is complete
    """
    hidden: list[str] = []
    return _capture(root, "", set(), hidden), hidden


def restore(root: Any, state: Any) -> None:
    """
    :param root: an environment built like the captured one
    :param state: state returned by :func:`capture`
    :raises ValueError: if the environment was built differently
    """
    _restored(root, state, type(root).__name__)


def _capture(value: Any, path: str, seen: set[int], hidden: list[str]) -> Any:
    if value is None or (isinstance(value, np.ndarray) and value.dtype != object) or isinstance(value, PLAIN):
        return {KIND: "plain", "value": encode(value.hex()) if isinstance(value, bytes) else encode(value)}
    if isinstance(value, FIXED) or id(value) in seen:  # an object is captured where it is first encountered
        return None
    seen.add(id(value))
    if isinstance(value, (np.random.Generator, np.random.RandomState)):
        state: Any = value.bit_generator.state if isinstance(value, np.random.Generator) else value.get_state()
        return {KIND: "generator", "value": encode(state)}
    if hasattr(value, "cloneSystemState"):
        return {KIND: "emulator", "value": value.cloneSystemState().serialize().hex()}
    if isinstance(value, (list, tuple, deque)):
        return {KIND: "items", "items": [_capture(item, f"{path}[{i}]", seen, hidden) for i, item in enumerate(value)]}
    if isinstance(value, dict) and all(isinstance(key, (str, int, tuple)) for key in value):
        items = [_capture(item, f"{path}[{key!r}]", seen, hidden) for key, item in value.items()]
        return {KIND: "keys", "keys": [encode(key) for key in value], "items": items}
    if not hasattr(value, "__dict__"):
        hidden.append(path)
        return None
    children = {name: child for name, child in vars(value).items() if name not in SKIPPED}
    kind = {CLASS: type(value).__name__} if isinstance(value, VecEnv) else {}  # gymnasium's wrappers may be substituted
    found = {name: _capture(child, f"{path}.{name}", seen, hidden) for name, child in children.items()}
    return {KIND: "attributes", **kind, **found}


def _restored(current: Any, state: Any, path: str) -> Any:
    """The restored value for ``current``; objects and arrays are updated in place where possible."""
    return current if state is None else HANDLERS[state[KIND]](current, state, path)


def _restored_plain(current: Any, state: Any, path: str) -> Any:
    found = decode(state["value"])
    if isinstance(current, bytes):
        return bytes.fromhex(found)
    if isinstance(found, np.ndarray) and isinstance(current, np.ndarray) and current.flags.writeable:
        if (found.shape, found.dtype) == (current.shape, current.dtype):
            current[...] = found  # other objects may share this memory
            return current
    return found


def _restored_generator(current: Any, state: Any, path: str) -> Any:
    if isinstance(current, np.random.RandomState):
        current.set_state(decode(state["value"]))
    else:
        current.bit_generator.state = decode(state["value"])
    return current


def _restored_emulator(current: Any, state: Any, path: str) -> Any:
    kind = type(current.cloneSystemState())
    current.restoreSystemState(kind(bytes.fromhex(state["value"])))
    return current


def _restored_attributes(current: Any, state: Any, path: str) -> Any:
    found, expected = type(current).__name__, state.get(CLASS)
    if current is None or (expected is not None and found != expected):
        raise ValueError(
            f"{path} must be {'an object' if expected is None else f'a {expected}'}, "
            f"got {'nothing' if current is None else found}: the environment is not built as in the original run. "
            "Pass one with the same wrappers, including VecNormalize."
        )
    for name, child in state.items():
        if name not in (KIND, CLASS):
            setattr(current, name, _restored(getattr(current, name, None), child, f"{path}.{name}"))
    return current


def _restored_keys(current: Any, state: Any, path: str) -> Any:
    old = dict(current) if isinstance(current, dict) else {}
    keys = [decode(key) for key in state["keys"]]
    found = {key: _restored(old.get(key), child, f"{path}[{key!r}]") for key, child in zip(keys, state["items"], strict=True)}
    if not isinstance(current, dict):
        return found
    current.clear()
    current.update(found)
    return current


def _restored_items(current: Any, state: Any, path: str) -> Any:
    items = state["items"]
    old = list(current) if isinstance(current, (list, tuple, deque)) else []
    old += [None] * (len(items) - len(old))
    found = [_restored(a, b, f"{path}[{i}]") for i, (a, b) in enumerate(zip(old, items, strict=False))]
    if isinstance(current, tuple):
        return type(current)(*found) if hasattr(current, "_fields") else tuple(found)
    if not isinstance(current, (list, deque)):
        return found
    current.clear()
    current.extend(found)
    return current


HANDLERS: dict[str, Callable[[Any, Any, str], Any]] = {
    "plain": _restored_plain,
    "generator": _restored_generator,
    "emulator": _restored_emulator,
    "items": _restored_items,
    "keys": _restored_keys,
    "attributes": _restored_attributes,
}
