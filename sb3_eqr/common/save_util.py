"""Saving that never leaves half a file, and the state of every random generator."""

import os
import pathlib
import random
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, BinaryIO

import numpy as np
import torch as th
from gymnasium import spaces


@contextmanager
def atomic_write(path: str | pathlib.Path, suffix: str) -> Iterator[BinaryIO]:
    """
    A file opened beside ``path`` that takes its place only once it is written whole.

    :param path: destination; ``suffix`` is appended where it has none, and its folder is made, as SB3 does
    :param suffix: without the dot
    """
    path = pathlib.Path(path)
    if path.suffix == "":
        path = path.with_suffix(f".{suffix}")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with open(partial, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def is_whole_model(path: pathlib.Path) -> bool:
    """
    :param path: an existing file
    :return: whether it is a zip file with everything that SB3's ``save`` puts in. The parts of a model are zip files
        themselves, so one that was cut off may still look like a zip file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return {"data", "policy.pth", "system_info.txt"} <= set(archive.namelist())
    except zipfile.BadZipFile:
        return False


def get_rng_state(action_space: spaces.Space) -> dict[str, Any]:
    """
    :param action_space: SB3 draws random actions from its generator
    :return: the state of all generators that training draws from
    """
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if th.cuda.is_available() else [],
        "action_space": action_space.np_random.bit_generator.state,
    }


def set_rng_state(state: dict[str, Any], action_space: spaces.Space) -> None:
    """
    :param state: from :func:`get_rng_state`
    :param action_space: whose generator to set
    """
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])
    th.set_rng_state(state["torch"])
    if len(state["cuda"]) == th.cuda.device_count():
        th.cuda.set_rng_state_all(state["cuda"])
    action_space.np_random.bit_generator.state = state["action_space"]
