"""Saving that never leaves half a file and keeps the random generators, for any off-policy algorithm."""

import io
import json
import os
import pathlib
import pickle
import random
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, BinaryIO, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv

SelfSafeFiles = TypeVar("SelfSafeFiles", bound="SafeFiles")


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


def read_description(path: str | pathlib.Path | io.BufferedIOBase) -> dict[str, str]:
    """
    What the parameters in a model's file are of, which their shapes do not say. Nothing in the file is executed for it.

    :param path: of a file, its ending may be left out, or a file-like, which is left where it was
    :return: ``EqRPolicy.description`` of the model that was saved; empty for a file of another algorithm
    """
    place = path if isinstance(path, (str, pathlib.Path)) else path.tell()
    found = find_file(path) if isinstance(path, (str, pathlib.Path)) else path
    if found is None or not zipfile.is_zipfile(found):
        return {}  # SB3 says what is wrong
    with zipfile.ZipFile(found) as archive:  # type: ignore[arg-type]
        description = json.loads(archive.read("data")).get("policy_description", {})
    if not isinstance(path, (str, pathlib.Path)):
        path.seek(place)  # type: ignore[arg-type]
    return description


def find_file(path: str | pathlib.Path) -> pathlib.Path | None:
    """
    :param path: of a model's file, its ending may be left out
    """
    return next((p for p in (pathlib.Path(path), pathlib.Path(f"{path}.zip")) if p.is_file()), None)


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


class SafeFiles(OffPolicyAlgorithm):
    """SB3's ``save``, ``load``, ``save_replay_buffer`` and ``load_replay_buffer`` with whole files only."""

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        As SB3's ``save``, with the state of the random generators, and never by half: the file is written beside and renamed.

        :param path: path to the file, or a file-like
        :param exclude: names of attributes to leave out beside the default ones
        :param include: names of attributes to save although they are left out by default
        """
        self._before_saving()
        self.rng_state = get_rng_state(self.action_space)
        if not isinstance(path, (str, pathlib.Path)):
            super().save(path, exclude, include)
            return
        with atomic_write(path, "zip") as file:
            super().save(file, exclude, include)  # type: ignore[arg-type]

    def _before_saving(self) -> None:
        """Called before a model is written; an exception keeps the old file."""

    @classmethod
    def load(
        cls: type[SelfSafeFiles],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfSafeFiles:
        """
        As SB3's ``load``, with the same parameters. Where the model has a seed (and no other is given here), the random
        generators are put back to where they were at saving: a run that was saved after ``learn``, or between two
        rollouts, goes on as if it had not stopped (pass ``force_reset=False`` and an environment in the same state).
        SB3's CheckpointCallback saves in the middle of a step: its files go on from a fresh episode.

        :raises ValueError: if the file is cut off, or was saved by another class
        """
        if isinstance(path, (str, pathlib.Path)):
            found = find_file(path)
            if found is not None and not is_whole_model(found):
                raise ValueError(
                    f"{found}: expected a whole file of {cls.__name__}.save, found one that is cut off or something else. "
                    "Load an earlier checkpoint."
                )
        model = super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        reseeded = "seed" in kwargs or "seed" in (custom_objects or {})
        if model.seed is not None and not reseeded and getattr(model, "rng_state", None) is not None:
            set_rng_state(model.rng_state, model.action_space)
        return model

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """
        As SB3's, but never by half: the file is written beside and renamed.

        :param path: path to the file, or a file-like
        """
        if not isinstance(path, (str, pathlib.Path)):
            super().save_replay_buffer(path)
            return
        with atomic_write(path, "pkl") as file:
            super().save_replay_buffer(file)  # type: ignore[arg-type]

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        As SB3's.

        :param path: path to the file, or a file-like
        :param truncate_last_traj: has no effect here
        :raises ValueError: if the file is cut off, or holds a buffer of another kind, or for other spaces or environments;
            the model then keeps the buffer it had
        """
        before = self.replay_buffer
        assert before is not None
        try:
            super().load_replay_buffer(path, truncate_last_traj)
        except (EOFError, pickle.UnpicklingError, AssertionError) as error:
            self.replay_buffer = before
            raise ValueError(
                f"{path}: expected a whole replay buffer saved by {type(self).__name__}.save_replay_buffer, "
                f"found one that is cut off or something else ({error}). Load an earlier one."
            ) from error
        loaded, self.replay_buffer = self.replay_buffer, before
        expected, found = _describe(before), _describe(loaded)
        if expected != found:
            raise ValueError(f"{path}: expected a replay buffer of {expected}, found {found}. Load the one of this model.")
        self.replay_buffer = loaded


def _describe(buffer: ReplayBuffer | None) -> dict[str, Any]:
    names = ("observation_space", "action_space", "n_envs", "alpha")  # α is in every stored priority
    return {"class": type(buffer).__name__, **{name: getattr(buffer, name) for name in names if hasattr(buffer, name)}}
