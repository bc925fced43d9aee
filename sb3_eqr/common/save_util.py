"""Saving that never leaves half a file and keeps the random generators, for any off-policy algorithm."""

import io
import json
import pathlib
import pickle
import random
import zipfile
from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv

from sb3_eqr.common.files import atomic_write

SelfSafeFiles = TypeVar("SelfSafeFiles", bound="SafeFiles")


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
    ``EqRPolicy.description`` of the model in a file (or file-like, which is left where it was); empty for one of another
    algorithm. Nothing in the file is executed for it.
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
    """A model's file by its path, whose ending may be left out."""
    return next((p for p in (pathlib.Path(path), pathlib.Path(f"{path}.zip")) if p.is_file()), None)


def get_rng_state(action_space: spaces.Space) -> dict[str, Any]:
    """The state of all generators that training draws from; SB3 draws random actions from that of the action space."""
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if th.cuda.is_available() else [],
        "action_space": action_space.np_random.bit_generator.state,
    }


def set_rng_state(state: dict[str, Any], action_space: spaces.Space) -> None:
    """The way back to a state of :func:`get_rng_state`."""
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])
    th.set_rng_state(state["torch"])
    if len(state["cuda"]) == th.cuda.device_count():
        th.cuda.set_rng_state_all(state["cuda"])
    action_space.np_random.bit_generator.state = state["action_space"]


class SafeFiles(OffPolicyAlgorithm):
    """SB3's ``save``, ``load``, ``save_replay_buffer`` and ``load_replay_buffer`` with complete files only; copies."""

    def __getstate__(self) -> dict[str, Any]:
        """For ``pickle`` and ``copy``: the logger, which holds open files, becomes one without output until ``learn``."""
        return {**self.__dict__, "_logger": Logger(None, []), "_custom_logger": False}

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """As SB3's ``save``, with the state of the random generators; the file is written beside and renamed."""
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
        As SB3's ``load``, with the same parameters. If the model has a seed (and no other is given here), the random
        generators are restored: a run that was saved after ``learn``, or between two rollouts, is resumed exactly (pass
        ``force_reset=False`` and an environment in the same state). SB3's CheckpointCallback saves in the middle of a step.

        :raises ValueError: if the file is truncated, or was saved by another class
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
        """As SB3's ``save_replay_buffer``; the file is written beside and renamed."""
        if not isinstance(path, (str, pathlib.Path)):
            super().save_replay_buffer(path)
            return
        with atomic_write(path, "pkl") as file:
            super().save_replay_buffer(file)  # type: ignore[arg-type]

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        As SB3's ``load_replay_buffer``; ``truncate_last_traj`` has no effect here.

        :raises ValueError: if the file is truncated, or holds a buffer of another kind, or for other spaces or environments;
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
