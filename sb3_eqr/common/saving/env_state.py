"""
Capturing the state of environments as plain data, and restoring it into environments that were built alike. Restoring creates
arrays and containers, but no other objects, and executes no code of the file. What cannot be captured is named.
"""

import enum
import functools
import inspect
import io
import logging
import random
import types
from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import VecEnv

from sb3_eqr.common.saving.plain_data import KIND, decode, encode

# Values that are not captured: definitions, and handles to the outside such as loggers.
FIXED: tuple[type, ...] = (type, types.ModuleType, types.FunctionType, types.BuiltinFunctionType, types.MethodType)
FIXED += (functools.partial, np.ufunc, np.dtype, logging.Logger, ResultsWriter)
SKIPPED = ("spec", "_cached_spec", "metadata", "class_attributes")
PLAIN = (bool, int, float, str, bytes)
UNCHANGING: dict[str, Any] = {"tuple": tuple, "frozenset": frozenset, "set": set}  # or not able to contain themselves
DICTS: dict[str, Any] = {"dict": dict, "OrderedDict": OrderedDict, "Counter": Counter}
CLASS = ":class:"  # key of the name of an object's class
NUMBER = ":number:"  # key of the number of an object, in the order in which objects are encountered
WRAPPED = ("env", "venv", "envs")  # attributes that hold the environment that a wrapper wraps
STATELESS = type("Stateless", (), {})  # the size of its instances is that of objects that consist of their attributes


class MissingObjectError(ValueError):
    """An environment created an object during the run, which a new one does not have. ``path``: where it was."""

    def __init__(self, path: str):
        super().__init__(f"{path} must be the original object, got another or none: the run created it, or moved it there.")
        self.path = path


def capture(root: Any) -> tuple[Any, list[str]]:
    """
    :param root: an environment, vectorised or not, with all its wrappers
    :return: its state as JSON, and the paths of objects whose state is not accessible from Python, such as a physics engine;
        empty if the state is complete
    """
    search = _Capture()
    return search.captured(root, ""), search.hidden


def restore(root: Any, state: Any) -> None:
    """
    :param root: an environment built like the captured one
    :param state: state returned by :func:`capture`
    :raises ValueError: if the environment was built differently
    :raises MissingObjectError: if it was built in the same way, but later created an object; the state is restored in part
    """
    if NUMBER not in state:
        raise ValueError("The checkpoint must be one of this version of the package, got an earlier one. Start the run again.")
    _Restoring().restored(root, state, type(root).__name__)


class _Capture:
    """``hidden``: paths of what cannot be captured."""

    def __init__(self) -> None:
        self.hidden: list[str] = []
        self._seen: dict[int, int] = {}  # id of an object -> its number
        self._memory: dict[int, dict[str, Any]] = {}  # id of the owner of an array's memory -> state of the first such array

    def captured(self, value: Any, path: str) -> Any:
        if value is None or type(value) in PLAIN or isinstance(value, np.generic):
            is_bytes = isinstance(value, bytes)
            return {KIND: "bytes", "value": value.hex()} if is_bytes else {KIND: "plain", "value": encode(value)}
        if isinstance(value, enum.Enum):
            return {KIND: "member", "name": value.name}
        if isinstance(value, FIXED):
            return None
        if id(value) in self._seen:  # an object is captured where it is first encountered
            return {KIND: "same", NUMBER: self._seen[id(value)]}
        number = self._seen[id(value)] = len(self._seen)
        found = self._captured_object(value, path)
        if found is not None:
            found[NUMBER] = number
        return found

    def _captured_object(self, value: Any, path: str) -> Any:
        kind = type(value)
        if kind is np.ndarray and value.dtype != object:
            return self._captured_array(value)
        if isinstance(value, th.Tensor):
            return {KIND: "tensor", "value": encode(value.detach().cpu().numpy())}
        if kind is random.Random:
            return {KIND: "generator", "value": encode(value.getstate())}
        if isinstance(value, (np.random.Generator, np.random.RandomState)):
            state: Any = value.bit_generator.state if isinstance(value, np.random.Generator) else value.get_state()
            return {KIND: "generator", "value": encode(state)}
        if isinstance(value, spaces.Space):  # samples are drawn with their own generators
            drawn = [space._np_random for space in _parts(value)]
            return {KIND: "space", "value": encode([None if rng is None else rng.bit_generator.state for rng in drawn])}
        if hasattr(value, "cloneSystemState"):
            return {KIND: "emulator", "value": value.cloneSystemState().serialize().hex()}
        if isinstance(value, io.IOBase) and (value.closed or not value.readable()):
            return None
        return self._captured_container(value, path) or self._captured_attributes(value, path)

    def _captured_array(self, value: np.ndarray) -> dict[str, Any]:
        state = {KIND: "array", "value": encode(value), "is_shared": False}
        owner: Any = value
        while isinstance(owner, np.ndarray) and owner.base is not None:
            owner = owner.base
        first = self._memory.setdefault(id(owner), state)
        if first is not state:  # the new environment's arrays share memory in the same way
            first["is_shared"] = state["is_shared"] = True
        return state

    def _captured_container(self, value: Any, path: str) -> Any:
        kind = type(value)
        if kind in (set, frozenset) and all(map(_is_plain_key, value)):
            return {KIND: "list", CLASS: kind.__name__, "items": [self.captured(item, path) for item in value]}
        if kind in (list, tuple, deque) or (isinstance(value, tuple) and hasattr(value, "_fields")):
            items = [self.captured(item, f"{path}[{i}]") for i, item in enumerate(value)]
            maxlen = {"maxlen": value.maxlen} if kind is deque else {}
            return {KIND: "list", CLASS: kind.__name__, "items": items, **maxlen}
        if kind in (*DICTS.values(), defaultdict) and all(map(_is_plain_key, value)):
            items = [self.captured(item, f"{path}[{key!r}]") for key, item in value.items()]
            return {KIND: "dict", CLASS: kind.__name__, "keys": [encode(key) for key in value], "items": items}
        return None

    def _captured_attributes(self, value: Any, path: str) -> Any:
        kind = type(value)
        is_larger = kind.__basicsize__ > STATELESS.__basicsize__ or kind.__itemsize__ > 0
        if not hasattr(value, "__dict__") or is_larger or any(vars(base).get("__slots__") for base in kind.__mro__):
            self.hidden.append(path)  # it has state that is not in its attributes
            return None
        children = {name: child for name, child in vars(value).items() if name not in SKIPPED}
        named = {CLASS: kind.__name__} if isinstance(value, VecEnv) else {}  # gymnasium's wrappers may be substituted
        found = {name: self.captured(child, f"{path}.{name}") for name, child in children.items()}
        return {KIND: "attributes", **named, **found}


def _own_value(current: Any, name: str, path: str, state: Any) -> Any:
    """
    The value of an attribute that a file names. Only what the object itself holds is looked up: from its methods, a file could
    reach every module of the process. Nothing that would shadow a method or a property is restored.

    :raises ValueError: if the file names anything else
    """
    of_class = inspect.getattr_static(type(current), name, None)
    is_defined = callable(of_class) or hasattr(of_class, "__get__")
    found = vars(current).get(name, None if is_defined else of_class)
    shadows = name not in vars(current) and is_defined
    if name in SKIPPED or (name.startswith("__") and name.endswith("__")) or shadows or (isinstance(found, FIXED) and state):
        raise ValueError(f"{path} must be state of an environment, got a method, a function or a module. Nothing was run.")
    return found


def _is_plain_key(key: Any) -> bool:
    return key is None or type(key) in (bool, int, float, str) or (type(key) is tuple and all(map(_is_plain_key, key)))


def _parts(space: spaces.Space) -> Iterator[spaces.Space]:
    """A space, and the spaces that it consists of."""
    yield space
    inside = getattr(space, "spaces", ())
    for part in inside.values() if isinstance(inside, dict) else inside:
        yield from _parts(part)


class _Restoring:
    def __init__(self) -> None:
        self._objects: dict[int, Any] = {}  # number -> restored object
        self._updated: dict[int, Any] = {}  # id -> object that was updated in place

    def restored(self, current: Any, state: Any, path: str) -> Any:
        """The restored value for ``current``; objects that consist of attributes are updated in place."""
        if state is None:
            return current
        if state[KIND] == "same":
            return self._objects.get(state[NUMBER], current)
        found = HANDLERS[state[KIND]](self, current, state, path)
        if NUMBER in state:
            self._objects[state[NUMBER]] = found
        return found

    def _claimed(self, current: Any, path: str) -> Any:
        """An object to update, which must not be one that was already updated with the state of another object."""
        if current is None or isinstance(current, FIXED) or id(current) in self._updated:
            raise MissingObjectError(path)
        self._updated[id(current)] = current
        return current

    def _plain(self, current: Any, state: Any, path: str) -> Any:
        return decode(state["value"])

    def _bytes(self, current: Any, state: Any, path: str) -> bytes:
        return bytes.fromhex(state["value"])

    def _member(self, current: Any, state: Any, path: str) -> enum.Enum:
        if not isinstance(current, enum.Enum) or state["name"] not in type(current).__members__:
            raise MissingObjectError(path)
        return type(current)[state["name"]]

    def _array(self, current: Any, state: Any, path: str) -> np.ndarray:
        found = decode(state["value"])
        if not state["is_shared"]:
            return found  # the current one may be a constant
        if not isinstance(current, np.ndarray) or (current.shape, current.dtype) != (found.shape, found.dtype):
            raise MissingObjectError(path)
        if current.flags.writeable:
            current[...] = found
        return current

    def _tensor(self, current: Any, state: Any, path: str) -> th.Tensor:
        found = th.from_numpy(decode(state["value"]))
        if not isinstance(current, th.nn.Parameter):
            return found.to(current.device) if isinstance(current, th.Tensor) else found
        with th.no_grad():
            return current.copy_(found)

    def _generator(self, current: Any, state: Any, path: str) -> Any:
        self._claimed(current, path)
        if isinstance(current, random.Random):
            current.setstate(decode(state["value"]))
        elif isinstance(current, np.random.RandomState):
            current.set_state(decode(state["value"]))
        else:
            current.bit_generator.state = decode(state["value"])
        return current

    def _space(self, current: Any, state: Any, path: str) -> Any:
        if not isinstance(current, spaces.Space):
            raise MissingObjectError(path)
        for space, rng in zip(_parts(current), decode(state["value"]), strict=False):
            if rng is not None:
                space.np_random.bit_generator.state = rng
        return current

    def _emulator(self, current: Any, state: Any, path: str) -> Any:
        if type(current).__name__ != "ALEInterface" or not type(current).__module__.startswith("ale_py"):
            raise ValueError(f"{path} must be an emulator of ale-py, got {type(current).__name__}. Nothing was run.")
        kind = type(self._claimed(current, path).cloneSystemState())
        current.restoreSystemState(kind(bytes.fromhex(state["value"])))
        return current

    def _attributes(self, current: Any, state: Any, path: str) -> Any:
        found, expected = type(current).__name__, state.get(CLASS)
        is_wrapper = expected is not None or path.rpartition(".")[2].partition("[")[0] in WRAPPED
        if is_wrapper and (current is None or (expected is not None and found != expected)):
            raise ValueError(
                f"{path} must be {'an object' if expected is None else f'a {expected}'}, "
                f"got {'nothing' if current is None else found}: the environment is not built as in the original run. "
                "Pass one with the same wrappers, including VecNormalize."
            )
        self._objects[state[NUMBER]] = self._claimed(current, path)  # its attributes may refer to it
        for name, child in state.items():
            if name in (KIND, CLASS, NUMBER) or (child is None and name not in vars(current)):
                continue
            old = _own_value(current, name, f"{path}.{name}", child)
            vars(current)[name] = self.restored(old, child, f"{path}.{name}")  # some objects refuse setattr
        return current

    def _list(self, current: Any, state: Any, path: str) -> Any:
        name, items = state[CLASS], state["items"]
        old = list(current) if isinstance(current, (list, tuple, deque)) else []
        old += [None] * (len(items) - len(old))
        found: list[Any] = []
        if name == "list":
            self._objects[state[NUMBER]] = found  # it may contain itself
        found += [self.restored(a, b, f"{path}[{i}]") for i, (a, b) in enumerate(zip(old, items, strict=False))]
        if name == "list":
            return found
        if name in UNCHANGING:
            return UNCHANGING[name](found)
        if name == "deque":
            return deque(found, state["maxlen"])
        if type(current).__name__ != name or not isinstance(current, tuple) or not hasattr(current, "_fields"):
            raise MissingObjectError(path)
        return type(current)(*found)  # a named tuple

    def _dict(self, current: Any, state: Any, path: str) -> Any:
        name, old = state[CLASS], current if isinstance(current, dict) else {}
        if name == "defaultdict" and not isinstance(current, defaultdict):
            raise MissingObjectError(path)
        found = defaultdict(current.default_factory) if name == "defaultdict" else DICTS[name]()
        self._objects[state[NUMBER]] = found  # it may contain itself
        for key, child in zip(map(decode, state["keys"]), state["items"], strict=True):
            found[key] = self.restored(dict.get(old, key), child, f"{path}[{key!r}]")
        return found


HANDLERS: dict[str, Callable[[_Restoring, Any, Any, str], Any]] = {
    "plain": _Restoring._plain,
    "bytes": _Restoring._bytes,
    "member": _Restoring._member,
    "array": _Restoring._array,
    "tensor": _Restoring._tensor,
    "generator": _Restoring._generator,
    "space": _Restoring._space,
    "emulator": _Restoring._emulator,
    "list": _Restoring._list,
    "dict": _Restoring._dict,
    "attributes": _Restoring._attributes,
}
