"""Replay buffer files: arrays and plain data in one file. Reading it executes no code."""

import json
import zipfile
from typing import Any, BinaryIO

import numpy as np

from sb3_eqr.common.replay.frame_store import FrameStore
from sb3_eqr.common.replay.sum_tree import SumTree
from sb3_eqr.common.saving.plain_data import KIND, decode, encode

PARTS = {kind.__name__: kind for kind in (FrameStore, SumTree)}  # components of a buffer that hold arrays
DATA = "data"  # the zip member that holds everything except the arrays


def write_buffer(file: BinaryIO, buffer: Any, notes: dict[str, Any]) -> None:
    """
    :param file: open for writing
    :param buffer: a replay buffer of this package, or of a derived class
    :param notes: additional data to store, as JSON
    """
    arrays: dict[str, np.ndarray] = {}
    data = {"class": type(buffer).__name__, "notes": notes, "state": _packed(vars(buffer), "", arrays)}
    np.savez(file, **{DATA: np.frombuffer(json.dumps(data).encode(), dtype=np.uint8)}, **arrays)  # type: ignore[arg-type]


def read_buffer(file: BinaryIO, like: Any) -> tuple[Any, dict[str, Any]]:
    """
    :param file: file written by :func:`write_buffer`, open for reading
    :param like: a buffer of the same class
    :return: the buffer and the notes
    :raises ValueError: if the file is truncated, modified, or of another kind
    """
    try:
        with np.load(file, allow_pickle=False) as members:  # verifies the zip checksum of each member
            if not isinstance(members[DATA], np.ndarray):
                raise ValueError("it is a model or another zip file, not a replay buffer")
            data = json.loads(members[DATA].tobytes())
            state = _unpacked(data["state"], members)
    except (zipfile.BadZipFile, KeyError, EOFError, OSError, ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error
    if data["class"] != type(like).__name__:
        raise ValueError(f"it must be a {type(like).__name__}, got a {data['class']}")
    if state.keys() != vars(like).keys():
        raise ValueError(f"it was saved by another version, attributes differ: {sorted(state.keys() ^ vars(like).keys())}")
    buffer = object.__new__(type(like))
    vars(buffer).update(state)
    return buffer, data["notes"]


def _packed(value: Any, name: str, arrays: dict[str, np.ndarray]) -> Any:
    if isinstance(value, np.ndarray):
        key = name.strip("/") or "array"
        arrays[key] = value
        return {KIND: "member", "name": key}
    if type(value).__name__ in PARTS and type(value) is PARTS[type(value).__name__]:
        state = value.__getstate__() if isinstance(value, FrameStore) else vars(value)
        return {KIND: "part", "name": type(value).__name__, "state": _packed(state, name, arrays)}
    if type(value) is dict and all(isinstance(key, str) for key in value):
        return {key: _packed(item, f"{name}/{key}", arrays) for key, item in value.items()}
    return encode(value)


def _unpacked(value: Any, members: Any) -> Any:
    kind = value.get(KIND) if isinstance(value, dict) else None
    if kind == "member":
        return members[value["name"]]
    if kind == "part":
        part = object.__new__(PARTS[value["name"]])
        state = _unpacked(value["state"], members)
        if isinstance(part, FrameStore):
            part.__setstate__(state)
        else:
            vars(part).update(state)
        return part
    if isinstance(value, dict) and kind is None:
        return {key: _unpacked(item, members) for key, item in value.items()}
    return decode(value)
