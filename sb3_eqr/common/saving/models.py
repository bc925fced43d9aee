"""Atomic saving for any off-policy algorithm, including the state of the random generators."""

import inspect
import io
import json
import pathlib
import pickle
import warnings
import zipfile
import zlib
from collections.abc import Iterable
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import open_path, recursive_getattr, save_to_zip_file
from stable_baselines3.common.type_aliases import GymEnv

from sb3_eqr.common.checks.validation import check_names
from sb3_eqr.common.saving.buffers import read_buffer, write_buffer
from sb3_eqr.common.saving.checkpoints import (
    BUFFER,
    MODEL,
    read_manifest,
    restore_environment,
    restore_generators,
    warn_of_hidden,
)
from sb3_eqr.common.saving.files import atomic_write, is_unbroken, seal
from sb3_eqr.common.saving.plain_data import UntrustedError, decode, encode, names_in
from sb3_eqr.common.saving.random_state import get_rng_state, set_rng_state

SelfSafeFiles = TypeVar("SelfSafeFiles", bound="SafeFiles")


def is_whole_model(source: pathlib.Path | bytes) -> bool:
    """
    :param source: an existing file, or its content
    :return: whether it is an unchanged zip file with everything that SB3's ``save`` writes. The components of a model are zip
        files themselves, so a truncated file may still look like a zip file.
    """
    try:
        opened: Any = io.BytesIO(source) if isinstance(source, bytes) else open(source, "rb")
        with opened as file, zipfile.ZipFile(file) as archive:
            is_model = {"data", "policy.pth", "system_info.txt"} <= set(archive.namelist())
            return is_model and is_unbroken(file) and archive.testzip() is None
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError):  # from damaged headers
        return False


def read_data(path: str | pathlib.Path | io.BufferedIOBase) -> dict[str, Any]:
    """
    Read the attributes of a saved model as JSON, without executing code in the file; empty if the file is not a model. The
    position of a file-like object is restored.
    """
    place = path if isinstance(path, (str, pathlib.Path)) else path.tell()
    found = find_file(path) if isinstance(path, (str, pathlib.Path)) else path
    if found is None or not zipfile.is_zipfile(found):
        return {}  # SB3 raises an error later
    with zipfile.ZipFile(found) as archive:  # type: ignore[arg-type]
        data = json.loads(archive.read("data"))
    if not isinstance(path, (str, pathlib.Path)):
        path.seek(place)  # type: ignore[arg-type]
    return data


def decode_data(path: Any, data: dict[str, Any], trust: bool) -> dict[str, Any]:
    """
    Decode attributes from JSON.

    :param path: path for error messages
    :param data: the JSON of each attribute, by name
    :param trust: whether to load pickled attributes
    :return: the attributes by name
    :raises ValueError: if an attribute is pickled and ``trust`` is ``False``
    """
    found, refused = {}, {}
    for name, value in data.items():
        try:
            found[name] = decode(value, trust)
        except UntrustedError as error:
            refused[name] = str(error)
    if refused:
        named = "; ".join(f"{name}: {names}" for name, names in refused.items())
        raise ValueError(
            f"{path} must hold plain data, got pickled Python objects, whose loading runs the code that they name ({named}). "
            f"If you trust the file, pass trust=True, or pass custom_objects for {', '.join(refused)}."
        )
    return found


def refuse_folder(path: Any) -> None:
    """Raise ValueError if the path is a folder instead of a file."""
    if isinstance(path, (str, pathlib.Path)) and (place := pathlib.Path(path)).is_dir():
        if not any(place.with_name(f"{place.name}.{suffix}").is_file() for suffix in ("zip", "pkl")):
            raise ValueError(f"{path} must be a file, got a folder. Use resume for a folder of checkpoints.")


def find_file(path: str | pathlib.Path) -> pathlib.Path | None:
    """Find a model's file; the path may omit the extension. Raises ValueError for a folder."""
    refuse_folder(path)
    place = pathlib.Path(path)
    return next((p for p in (place, place.with_name(f"{place.name}.zip")) if p.is_file()), None)


class SafeFiles(OffPolicyAlgorithm):
    """SB3's ``save``, ``load``, ``save_replay_buffer`` and ``load_replay_buffer`` with atomic writes; pickling and copying."""

    def __getstate__(self) -> dict[str, Any]:
        """For ``pickle`` and ``copy``: replace the logger, which holds open files, by one without output until ``learn``."""
        return {**self.__dict__, "_logger": Logger(None, []), "_custom_logger": False}

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        As SB3's ``save``, with the state of the random generators; the file is written under a temporary name and renamed.
        Attributes are saved as plain data (:mod:`~sb3_eqr.common.saving.plain_data`), except that custom classes in
        ``policy_kwargs`` are pickled, and need ``trust`` to be loaded.
        """
        self._before_saving()
        self.rng_state = get_rng_state(self.action_space)
        names, variable_names = self._get_torch_save_params()
        excluded = {*(exclude or []), *self._excluded_save_params()} - {*(include or [])}
        excluded |= {name.split(".")[0] for name in [*names, *variable_names]}
        data = {name: encode(value) for name, value in vars(self).items() if name not in excluded}
        variables = {name: recursive_getattr(self, name) for name in variable_names}
        if not isinstance(path, (str, pathlib.Path)):
            save_to_zip_file(path, data, self.get_parameters(), variables)
            return
        with atomic_write(path, "zip") as file:
            save_to_zip_file(file, data, self.get_parameters(), variables)  # type: ignore[arg-type]
            seal(file)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "lr_schedule", "exploration_schedule"]  # created by _setup_model

    def _make_replay_buffer(self) -> ReplayBuffer:
        """Create an empty replay buffer from the agent's arguments."""
        raise NotImplementedError

    def _before_saving(self) -> None:
        """Called before a model is written; if it raises an exception, the old file is kept."""

    @classmethod
    def load(
        cls: type[SelfSafeFiles],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        trust: bool = False,
        **kwargs: Any,
    ) -> SelfSafeFiles:
        """
        As SB3's ``load``, with the same parameters, and ``trust``. If the model has a seed (and no other is given), the random
        generators are restored, so a run that was saved after ``learn``, or between two rollouts, can be resumed exactly (pass
        ``force_reset=False`` and an environment in the same state). SB3's CheckpointCallback saves in the middle of a step.

        :param trust: whether to load pickled Python objects in the file, which runs any code they name; needed for files with
            custom classes in ``policy_kwargs``, and for files written by SB3's own ``save``
        :raises ValueError: if the file is truncated, was saved by another class, or needs ``trust``
        :raises TypeError: if a keyword is not an argument of the agent
        """
        check_names(
            f"{cls.__name__}.load",
            kwargs,
            [*inspect.signature(cls.load).parameters][:-1] + [*inspect.signature(cls.__init__).parameters][3:],
        )
        source: Any = path
        if isinstance(path, (str, pathlib.Path)) and (found := find_file(path)) is not None:
            content = found.read_bytes()  # once, so that what is loaded is what was checked
            if not is_whole_model(content):
                raise ValueError(
                    f"{found} must be a complete file written by {cls.__name__}.save, got a truncated or damaged file, or "
                    "another kind of file. Load an earlier checkpoint."
                )
            source = io.BytesIO(content)
        given = {"env": None, **(custom_objects or {})}  # SB3 would make the environment that a file names
        data = {name: value for name, value in read_data(source).items() if name not in given}
        saved = data.get("policy_class") or {}
        module = str(saved.get("module", saved.get("__module__", ""))) if isinstance(saved, dict) else ""
        if module.startswith(("stable_baselines3.", "sb3_contrib.")):
            raise ValueError(
                f"{path} must be a file written by {cls.__name__}.save, got an agent with a policy of {module}. "
                "Load it with the class that saved it."
            )
        objects = {**decode_data(path, data, trust), **given}  # instead of SB3's unpickling
        model = super().load(source, env, device, objects, print_system_info, force_reset, **kwargs)
        reseeded = "seed" in kwargs or "seed" in (custom_objects or {})
        if model.seed is not None and not reseeded and getattr(model, "rng_state", None) is not None:
            set_rng_state(model.rng_state, model.action_space)
        return model

    @classmethod
    def resume(
        cls: type[SelfSafeFiles],
        path: str | pathlib.Path,
        env: GymEnv,
        device: th.device | str = "auto",
        trust: bool = False,
    ) -> SelfSafeFiles:
        """
        Resume from a checkpoint of :class:`~sb3_eqr.common.saving.checkpoints.ExactCheckpointCallback`, bit for bit as if
        the run had not stopped. Then call ``model.learn(total_timesteps - model.num_timesteps, reset_num_timesteps=False)``.

        :param path: the checkpoint, or a folder of checkpoints, whose last one is used
        :param env: environment built as in the original run, including VecNormalize
        :param device: as in ``load``
        :param trust: as in ``load``
        :return: the agent
        :raises ValueError: if there is no complete checkpoint, or one of its files has changed
        """
        if env is None:
            raise ValueError("env must be an environment, built as in the original run, got None.")
        checkpoint, manifest = read_manifest(pathlib.Path(path))
        is_exact = not manifest["hidden"]
        model = cls.load(checkpoint / MODEL, env, device, force_reset=not is_exact, trust=trust)
        if (checkpoint / BUFFER).is_file():
            model.load_replay_buffer(checkpoint / BUFFER, trust=trust)
        if not restore_environment(model, checkpoint, manifest, wrappers_only=not is_exact):
            warn_of_hidden(checkpoint, manifest)
        restore_generators(model, manifest)
        return model

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """As SB3's ``save_replay_buffer``, but writes arrays and plain data, under a temporary name that is then renamed."""
        assert self.replay_buffer is not None
        notes = {"algorithm": type(self).__name__, "num_timesteps": self.num_timesteps}
        if not isinstance(path, (str, pathlib.Path)):
            write_buffer(path, self.replay_buffer, notes)  # type: ignore[arg-type]
            return
        with atomic_write(path, "pkl") as file:  # SB3's extension, which scripts expect
            write_buffer(file, self.replay_buffer, notes)
            seal(file)

    def load_replay_buffer(
        self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True, trust: bool = False
    ) -> None:
        """
        As SB3's ``load_replay_buffer``; ``truncate_last_traj`` has no effect here.

        :param trust: whether to load a pickle, as written by SB3, which runs any code it names
        :raises ValueError: if the file is truncated or modified, needs ``trust``, or holds a buffer of another class, of
            another algorithm, or for other spaces or environments; the model then keeps its current buffer
        """
        if self.replay_buffer is None:
            self.replay_buffer = self._make_replay_buffer()
        before = self.replay_buffer
        loaded, notes = self._read_replay_buffer(path, trust)
        expected = {"algorithm": type(self).__name__, **_describe(before)}
        found = {"algorithm": type(self).__name__, **notes, **_describe(loaded)}
        steps = found.pop("num_timesteps", self.num_timesteps)
        if expected != found:
            raise ValueError(f"{path} must be a replay buffer of {expected}, got {found}. Load the one saved with this model.")
        if steps != self.num_timesteps:
            warnings.warn(
                f"{path}: this replay buffer was saved at step {steps}, but the model is at step {self.num_timesteps}. "
                "Load files that were saved together."
            )
        loaded.device = self.device
        for name in ("initial_beta", "final_beta"):  # arguments of the model; nothing that is stored depends on them
            if hasattr(before, name):
                setattr(loaded, name, getattr(before, name))
        self.replay_buffer = loaded

    def _read_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, trust: bool) -> tuple[Any, dict[str, Any]]:
        before = self.replay_buffer
        refuse_folder(path)
        file = open_path(path, "r", verbose=self.verbose, suffix="pkl")
        try:
            is_ours = zipfile.is_zipfile(file)
            if is_ours and not is_unbroken(file):  # type: ignore[arg-type]
                raise ValueError("it has changed since it was saved")
            file.seek(0)
            if is_ours:
                return read_buffer(file, before)  # type: ignore[arg-type]
            if not trust:
                named = ", ".join(names_in(file.read()))
                raise ValueError(
                    "it is truncated, or a pickle, and loading a pickle runs the code that it names"
                    f"{f' ({named})' if named else ''}: pass trust=True if you trust the file"
                )
            super().load_replay_buffer(file)  # type: ignore[arg-type]
            return self.replay_buffer, {}
        except (ValueError, EOFError, pickle.UnpicklingError, AssertionError) as error:
            raise ValueError(
                f"{path} must be a complete replay buffer written by {type(self).__name__}.save_replay_buffer, "
                f"got something else ({error}). Load an earlier one."
            ) from error
        finally:
            self.replay_buffer = before
            if isinstance(path, (str, pathlib.Path)):
                file.close()


def _describe(buffer: ReplayBuffer | None) -> dict[str, Any]:
    names = ("observation_space", "action_space", "n_envs", "alpha")  # stored priorities depend on α
    return {"class": type(buffer).__name__, **{name: getattr(buffer, name) for name in names if hasattr(buffer, name)}}
