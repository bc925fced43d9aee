"""Replay buffers as arrays and plain data in one file, which is read without executing anything."""

import json
import zipfile
from typing import Any, BinaryIO

import numpy as np

from sb3_eqr.common.plain_data import KIND, decode, encode
from sb3_eqr.common.replay.frame_store import FrameStore
from sb3_eqr.common.replay.sum_tree import SumTree

PARTS = {kind.__name__: kind for kind in (FrameStore, SumTree)}  # of a buffer, with arrays of their own
DATA = "data"  # the member that holds all but the arrays


def write_buffer(file: BinaryIO, buffer: Any, notes: dict[str, Any]) -> None:
    """
    :param file: open for writing
    :param buffer: a replay buffer of this package, or one derived from it
    :param notes: what else to keep, as JSON
    """
    arrays: dict[str, np.ndarray] = {}
    data = {"class": type(buffer).__name__, "notes": notes, "state": _packed(vars(buffer), "", arrays)}
    np.savez(file, **{DATA: np.frombuffer(json.dumps(data).encode(), dtype=np.uint8)}, **arrays)  # type: ignore[arg-type]


def read_buffer(file: BinaryIO, like: Any) -> tuple[Any, dict[str, Any]]:
    """
    :param file: of :func:`write_buffer`, open for reading
    :param like: a buffer of the same class
    :return: the buffer, and the notes
    :raises ValueError: if the file is truncated, changed, or something else
    """
    try:
        with np.load(file, allow_pickle=False) as members:  # the zip format checks a sum of each member
            if not isinstance(members[DATA], np.ndarray):
                raise ValueError("it is a model or another zip file, no replay buffer")
            data = json.loads(members[DATA].tobytes())
            state = _unpacked(data["state"], members)
    except (zipfile.BadZipFile, KeyError, EOFError, OSError, ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error
    if data["class"] != type(like).__name__:
        raise ValueError(f"a {type(like).__name__} is needed, this is a {data['class']}")
    if state.keys() != vars(like).keys():
        raise ValueError(f"it was saved by another version, with other attributes: {sorted(state.keys() ^ vars(like).keys())}")
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
