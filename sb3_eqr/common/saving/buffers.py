"""Replay buffer files: plain data, and arrays as members of the same zip file. Reading one runs no code of it."""

import json
import math
import zipfile
from typing import Any, BinaryIO

import numpy as np

from sb3_eqr.common.checks.arguments import BUFFER, check, check_arguments, integer
from sb3_eqr.common.replay.frame_store import FrameStore
from sb3_eqr.common.replay.sum_tree import SumTree
from sb3_eqr.common.saving.files import stored_members
from sb3_eqr.common.saving.plain_data import decode, encode

DATA = "data"  # the zip member that holds everything except the arrays
USED = ("_frames", "_references", "_free")  # arrays of a FrameStore, of which only used slots are saved


def write_buffer(file: BinaryIO, buffer: Any, notes: dict[str, Any]) -> None:
    """Write a replay buffer of this package, or of a derived class, with ``notes``, which are JSON, to an open file."""
    arrays: dict[str, np.ndarray] = {}
    state = {name: _packed(value, name, arrays) for name, value in vars(buffer).items()}
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(DATA, json.dumps({"class": type(buffer).__name__, "notes": notes, "state": state}))
        for name, array in arrays.items():
            with archive.open(name, "w", force_zip64=True) as member:
                member.write(np.ascontiguousarray(array).data.cast("B") if array.size else b"")


def read_buffer(file: BinaryIO, like: Any, trust: bool = False) -> tuple[Any, dict[str, Any]]:
    """
    Read the buffer and the notes from a file of :func:`write_buffer`, open for reading.

    :param like: a buffer of the same class, for the same spaces and number of environments
    :param trust: whether to load pickles in it, such as a space of a class of one's own
    :raises ValueError: if the file is truncated, modified, or of another kind
    """
    try:
        with zipfile.ZipFile(file) as archive:
            members = stored_members(archive)
            if DATA not in members or "policy.pth" in members:
                raise ValueError("it is a model or another zip file, not a replay buffer")
            data = json.loads(archive.read(DATA))
            state, expected = data["state"], vars(like)
            if data["class"] != type(like).__name__:
                raise ValueError(f"it must be a {type(like).__name__}, got a {data['class']}")
            if state.keys() != expected.keys():
                raise ValueError(
                    f"it was saved by another version, attributes differ: {sorted(state.keys() ^ expected.keys())}"
                )
            if (n_envs := decode(state["n_envs"])) != like.n_envs:
                raise ValueError(f"n_envs must be {like.n_envs}, the agent's number of environments, got {n_envs}")
            n = decode(state["buffer_size"])
            check("buffer_size", n, integer(1))
            resized = {like.buffer_size: n}
            buffer = object.__new__(type(like))
            for name, value in state.items():
                vars(buffer)[name] = _unpacked(value, expected[name], name, archive, resized, trust)
    except (zipfile.BadZipFile, KeyError, EOFError, OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error
    check_arguments({name: value for name, value in vars(buffer).items() if name in BUFFER}, BUFFER)
    check("pos", buffer.pos, integer(0, buffer.buffer_size - 1))
    return buffer, data["notes"]


def _packed(value: Any, name: str, arrays: dict[str, np.ndarray]) -> Any:
    if isinstance(value, np.ndarray):
        arrays[name] = value
        return {"dtype": value.dtype.str, "shape": value.shape}
    if isinstance(value, (FrameStore, SumTree)):
        value = value.__getstate__()  # of a FrameStore, only the slots that are used
    if type(value) is dict and all(isinstance(key, str) for key in value):
        return {key: _packed(item, f"{name}.{key}", arrays) for key, item in value.items()}
    return encode(value)


def _unpacked(value: Any, like: Any, name: str, archive: zipfile.ZipFile, resized: dict[int, int], trust: bool) -> Any:
    """What :func:`_packed` was given. Its kind is that of the same attribute of a new buffer, ``like``."""
    if isinstance(like, np.ndarray):
        shape = like.shape if like.ndim < 2 else (resized.get(like.shape[0], like.shape[0]), *like.shape[1:])
        return _array(value, like.dtype, shape, name, archive)
    if isinstance(like, FrameStore):
        return _store(value, like, name, archive, resized)
    if isinstance(like, SumTree):
        capacity = decode(value["capacity"])
        check("capacity", capacity, integer(1))
        tree = SumTree(min(capacity, 2 * math.prod(value["_leaves"]["shape"])))  # no more than the file holds
        for key in ("_leaves", "_sums"):
            found = _array(value[key], np.dtype(float), getattr(tree, key).shape, f"{name}.{key}", archive)
            if not (np.isfinite(found).all() and (found >= 0).all()):
                raise ValueError(f"{name} must hold priorities >= 0")
            setattr(tree, key, found)
        return tree
    if type(like) is dict and all(isinstance(key, str) for key in like):
        if value.keys() != like.keys():
            raise ValueError(f"{name} must have the keys {sorted(like)}, got {sorted(value)}")
        return {key: _unpacked(value[key], item, f"{name}.{key}", archive, resized, trust) for key, item in like.items()}
    return decode(value, trust)


def _store(value: Any, like: FrameStore, name: str, archive: zipfile.ZipFile, resized: dict[int, int]) -> FrameStore:
    n_used, n_free = decode(value["_n_used"]), decode(value["_n_free"])
    check("_n_used", n_used, integer(1))
    check("_n_free", n_free, integer(0, n_used))
    n, n_envs, length = like._ids.shape
    n = resized.get(n, n)
    shapes = {"_ids": (n, n_envs, length), **{key: (n_used, *getattr(like, key).shape[1:]) for key in USED}}
    dtypes = {key: like.dtype if key == "_frames" else np.dtype(np.int32) for key in shapes}
    arrays = {key: _array(value[key], dtypes[key], shape, f"{name}.{key}", archive) for key, shape in shapes.items()}
    for slots in (arrays["_ids"], arrays["_free"][:n_free]):
        if slots.size and not 0 <= slots.min() <= slots.max() < n_used:
            raise ValueError(f"{name} must refer to slots below {n_used}")
    store = object.__new__(FrameStore)
    store.__setstate__({**vars(like), **arrays, "_n_used": n_used, "_n_free": n_free})
    return store


def _array(value: Any, dtype: np.dtype, shape: tuple[int, ...], name: str, archive: zipfile.ZipFile) -> np.ndarray:
    """A member as an array, whose shape and dtype must be the expected ones, and its size that of the member."""
    if (value["dtype"], tuple(value["shape"])) != (dtype.str, shape):
        raise ValueError(f"{name} must have dtype {dtype.str} and shape {shape}, got {value['dtype']} and {value['shape']}")
    size = archive.getinfo(name).file_size
    if size != math.prod(shape) * dtype.itemsize:
        raise ValueError(f"{name} must have {math.prod(shape) * dtype.itemsize} bytes, got {size}")
    content = bytearray(size)
    with archive.open(name) as member:  # which checks the member's checksum at its end
        member.readinto(content)  # type: ignore[attr-defined]
        member.read(1)
    return np.frombuffer(content, dtype).reshape(shape)
