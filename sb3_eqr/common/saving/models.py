"""Atomic saving for any off-policy algorithm, including the state of the random generators."""

import inspect
import io
import json
import pathlib
import pickle
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any, Self

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_pkl, recursive_getattr, save_to_zip_file
from stable_baselines3.common.type_aliases import GymEnv
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_eqr.common.checks.arguments import parameters_of
from sb3_eqr.common.checks.validation import check_names
from sb3_eqr.common.saving.buffers import read_buffer, write_buffer
from sb3_eqr.common.saving.checkpoints import BUFFER, MODEL, read_manifest, restore_run, warn_of_unknown
from sb3_eqr.common.saving.files import atomic_write, is_unbroken, seal, stored_members
from sb3_eqr.common.saving.plain_data import UntrustedError, decode, encode
from sb3_eqr.common.saving.random_state import get_rng_state, set_rng_state

LARGEST_DATA = 100 << 20  # bytes of a model's attributes
MEMORY_PER_BYTE = 8  # of a file: both target copies, and what their initialisation needs

FileOrPath = str | pathlib.Path | io.BufferedIOBase


@contextmanager
def _reading(path: FileOrPath, suffix: str) -> Iterator[Any]:
    """A file-like object itself, or an open file, whose extension may be left out."""
    if not isinstance(path, (str, pathlib.Path)):
        yield path
        return
    place = pathlib.Path(path)
    found = next((one for one in (place, place.parent / f"{place.name}.{suffix}") if one.is_file()), None)
    if found is None and place.is_dir():
        raise ValueError(f"{path} must be a file, got a folder. Use resume for a folder of checkpoints.")
    if found is None and place.exists():
        raise ValueError(f"{path} must be a regular file, got a pipe or a device.")
    with open(found or place, "rb") as file:
        yield file


@contextmanager
def _writing(path: FileOrPath, suffix: str) -> Iterator[Any]:
    """A file-like object itself, or a file that appears under its name once it is complete and sealed."""
    if not isinstance(path, (str, pathlib.Path)):
        yield path
        return
    with atomic_write(path, suffix) as file:
        yield file
        seal(file)


def read_model(path: FileOrPath) -> bytes:
    """
    Read a model's file once, so that what is checked is what is loaded. The components of a model are zip files themselves,
    so a truncated file may still look like a zip file.

    :param path: a file; its extension may be left out; the position of a file-like object is restored
    :return: its content, an unchanged zip file with everything that SB3's ``save`` writes, none of it compressed
    :raises ValueError: if it is anything else
    """
    with _reading(path, "zip") as file:
        place = file.tell()
        content = file.read()
        file.seek(place)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            names = stored_members(archive)
            for name in names:
                if name.endswith(".pth") and zipfile.is_zipfile(member := archive.open(name)):
                    stored_members(zipfile.ZipFile(member))
            is_model = {"data", "policy.pth", "system_info.txt"} <= set(names) and archive.testzip() is None
            is_model &= is_unbroken(io.BytesIO(content)) and archive.getinfo("data").file_size < LARGEST_DATA
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError, ValueError, KeyError):
        is_model = False
    if not is_model:
        raise ValueError(
            f"{path} must be a complete file written by an agent's save, got a truncated or damaged file, or another kind of "
            "file. Load an earlier checkpoint."
        )
    return content


def data_of(content: bytes) -> dict[str, Any]:
    """The attributes of a saved model as JSON, without executing code in the file."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        try:
            return json.loads(archive.read("data"))
        except RecursionError as error:
            raise ValueError("data must be the attributes of an agent, got JSON that is too deep.") from error


class LimitedMemory(TorchDispatchMode):
    """Raises ValueError when new tensors take more than ``n_bytes``: a file holds the parameters of the agent it describes."""

    def __init__(self, n_bytes: int):
        super().__init__()
        self.left = n_bytes

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Count the memory of new tensors before anything is written to it."""
        found = func(*args, **(kwargs or {}))
        if func._overloadpacket is th.ops.aten.empty:
            self.left -= found.nbytes
            if self.left < 0:
                raise ValueError("the agent that policy_kwargs describe is much larger than the file.")
        return found


def _decoded(path: Any, data: dict[str, Any], trust: bool) -> dict[str, Any]:
    """Decode the attributes of a model; a ValueError names all that are pickled if ``trust`` is ``False``."""
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


class SafeFiles(OffPolicyAlgorithm):
    """SB3's ``save``, ``load``, ``save_replay_buffer`` and ``load_replay_buffer`` with atomic writes; pickling and copying."""

    _make_replay_buffer: Callable[[], ReplayBuffer]  # an empty one
    _before_saving: Callable[[], None]  # if it raises an exception, the old file is kept
    callback_progress: dict[str, Any] = {}  # of a run that was resumed; learn passes it to the callbacks

    def __getstate__(self) -> dict[str, Any]:
        """For ``pickle`` and ``copy``: replace the logger, which holds open files, by one without output until ``learn``."""
        return {**self.__dict__, "_logger": Logger(None, []), "_custom_logger": False}

    def save(self, path: FileOrPath, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None) -> None:
        """
        As SB3's ``save``, with the state of the random generators; the file is written under a temporary name and renamed.
        Attributes are saved as plain data (:mod:`~sb3_eqr.common.saving.plain_data`), except that custom classes in
        ``policy_kwargs`` and functions are pickled, and need ``trust`` to be loaded.
        """
        self._before_saving()
        self.rng_state = get_rng_state(self.action_space)
        names, variable_names = self._get_torch_save_params()
        excluded = {*(exclude or []), *self._excluded_save_params()} - {*(include or [])}
        excluded |= {name.split(".")[0] for name in [*names, *variable_names]}
        data = {name: encode(value) for name, value in vars(self).items() if name not in excluded}
        variables = {name: recursive_getattr(self, name) for name in variable_names}
        with _writing(path, "zip") as file:
            save_to_zip_file(file, data, self.get_parameters(), variables)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "lr_schedule", "exploration_schedule", "callback_progress"]

    @classmethod
    def load(
        cls,
        path: FileOrPath,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        trust: bool = False,
        **kwargs: Any,
    ) -> Self:
        """
        As SB3's ``load``, with the same parameters, and ``trust``. If the model has a seed (and no other is given), the random
        generators are restored, so a run that was saved after ``learn``, or between two rollouts, can be resumed exactly (pass
        ``force_reset=False`` and an environment in the same state). SB3's CheckpointCallback saves in the middle of a step.

        :param trust: whether to load pickled Python objects in the file, which runs any code they name, and agents much larger
            than their file; needed for files with custom classes in ``policy_kwargs``, or functions
        :raises ValueError: if the file is truncated, was saved by another class, or needs ``trust``
        :raises TypeError: if a keyword is not an argument of the agent
        """
        legal = {*inspect.signature(cls.load).parameters, *parameters_of(cls)} - {"policy", "kwargs"}
        check_names(f"{cls.__name__}.load", kwargs, sorted(legal))
        content = read_model(path)
        given = {"env": None, **(custom_objects or {})}  # SB3 would make the environment that a file names
        data = {name: value for name, value in data_of(content).items() if name not in given}
        saved = data.get("policy_class") or {}
        module = str(saved.get("module", saved.get("__module__", ""))) if isinstance(saved, dict) else ""
        if module.startswith(("stable_baselines3.", "sb3_contrib.")):
            raise ValueError(
                f"{path} must be a file written by {cls.__name__}.save, got an agent with a policy of {module}. "
                "Load it with the class that saved it."
            )
        objects = {**_decoded(path, data, trust), **given}  # instead of SB3's unpickling
        with nullcontext() if trust else LimitedMemory(MEMORY_PER_BYTE * len(content) + LARGEST_DATA):
            file: Any = io.BytesIO(content)
            model = super().load(file, env, device, objects, print_system_info, force_reset, **kwargs)
        is_reseeded = "seed" in kwargs or "seed" in given
        if model.seed is not None and not is_reseeded and getattr(model, "rng_state", None) is not None:
            set_rng_state(model.rng_state, model.action_space)
        return model

    @classmethod
    def resume(cls, path: str | pathlib.Path, env: GymEnv, device: th.device | str = "auto", trust: bool = False) -> Self:
        """
        Resume from a checkpoint of :class:`~sb3_eqr.common.saving.checkpoints.ExactCheckpointCallback`, bit for bit as if
        the run had not stopped. Then call ``model.learn(total_timesteps - model.num_timesteps, reset_num_timesteps=False)``.

        :param path: the checkpoint, or a folder of checkpoints, whose last one is used
        :param env: environment built as in the original run, including VecNormalize
        :param device: as in ``load``
        :param trust: as in ``load``
        :raises ValueError: if there is no complete checkpoint, or one of its files has changed
        """
        if env is None:
            raise ValueError("env must be an environment, built as in the original run, got None.")
        checkpoint, manifest = read_manifest(pathlib.Path(path))
        is_exact = not manifest["unknown"]
        model = cls.load(checkpoint / MODEL, env, device, force_reset=not is_exact, trust=trust)
        if (checkpoint / BUFFER).is_file():
            model.load_replay_buffer(checkpoint / BUFFER, trust=trust)
        restore_run(model, manifest, is_exact)
        model.callback_progress = decode(manifest.get("callbacks", {}))
        if not is_exact:
            warn_of_unknown(manifest["unknown"])
        return model

    def save_replay_buffer(self, path: FileOrPath) -> None:
        """As SB3's ``save_replay_buffer``, but writes arrays and plain data, under a temporary name that is then renamed."""
        assert self.replay_buffer is not None
        notes = {"algorithm": type(self).__name__, "num_timesteps": self.num_timesteps}
        with _writing(path, "pkl") as file:  # SB3's extension, which scripts expect
            write_buffer(file, self.replay_buffer, notes)

    def load_replay_buffer(self, path: FileOrPath, truncate_last_traj: bool = True, trust: bool = False) -> None:
        """
        As SB3's ``load_replay_buffer``; ``truncate_last_traj`` has no effect here.

        :param trust: whether to load a pickle of such a buffer, as SB3's ``save_to_pkl`` writes it, which runs any code it
            names
        :raises ValueError: if the file is truncated or modified, needs ``trust``, or holds a buffer of another class, for
            other spaces or environments, or with priorities of another algorithm; the model then keeps its current buffer
        """
        if self.replay_buffer is None:
            self.replay_buffer = self._make_replay_buffer()
        before = self.replay_buffer
        loaded, notes = self._read_replay_buffer(path, trust)
        algorithm, expected = type(self).__name__, _describe(before)
        found = {"algorithm": algorithm, **notes, **_describe(loaded)}
        if hasattr(before, "alpha"):  # priorities are losses of an algorithm; all else that is stored is the environment's
            expected["algorithm"] = algorithm
        steps = found.pop("num_timesteps", self.num_timesteps)
        if names := [name for name in expected if expected[name] != found.get(name)]:
            differs = ", ".join(f"{name} = {expected[name]}, got {found.get(name)}" for name in names)
            raise ValueError(
                f"{path} must be a replay buffer with {differs}. Load the one saved with this model, into a model with as "
                "many environments and the same spaces as then."
            )
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

    def _read_replay_buffer(self, path: FileOrPath, trust: bool) -> tuple[Any, dict[str, Any]]:
        with _reading(path, "pkl") as file:
            try:
                is_ours = zipfile.is_zipfile(file)
                if is_ours and not is_unbroken(file):
                    raise ValueError("it has changed since it was saved")
                file.seek(0)
                if is_ours:
                    return read_buffer(file, self.replay_buffer, trust)
                if not trust:
                    raise ValueError(
                        "it is truncated, or a pickle, and loading a pickle runs the code that it names: "
                        "pass trust=True if you trust the file"
                    )
                found = load_from_pkl(file)
                assert isinstance(found, ReplayBuffer), "The replay buffer must inherit from ReplayBuffer class"
                return found, {}
            except (ValueError, EOFError, pickle.UnpicklingError, AssertionError) as error:
                raise ValueError(
                    f"{path} must be a complete replay buffer written by {type(self).__name__}.save_replay_buffer, "
                    f"got something else ({error}). Load another one."
                ) from error


def _describe(buffer: ReplayBuffer | None) -> dict[str, Any]:
    names = ("observation_space", "action_space", "n_envs", "alpha")  # stored priorities depend on α
    return {"class": type(buffer).__name__, **{name: getattr(buffer, name) for name in names if hasattr(buffer, name)}}
