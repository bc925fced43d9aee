"""Checkpoints: everything that training needs to continue exactly, as one folder that is complete or absent."""

import errno
import hashlib
import json
import pathlib
import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_eqr.common.arguments import ALGORITHM, check, integer
from sb3_eqr.common.env_state import CLASS, capture, restore
from sb3_eqr.common.files import atomic_folder, checksum, remove_leftovers
from sb3_eqr.common.plain_data import KIND, decode, encode
from sb3_eqr.common.random_state import get_rng_state, set_rng_state

PREFIX = "checkpoint-"  # and the step
MANIFEST, MODEL, BUFFER, ENVIRONMENT = "manifest.json", "model.zip", "replay_buffer.pkl", "environment.json"


def write_checkpoint(
    folder: pathlib.Path, model: BaseAlgorithm, notes: Any = None, keep: int = 1, with_buffer: bool = True
) -> pathlib.Path:
    """
    Call it between two rollouts: a callback's ``_on_rollout_start``. One of the same step stays as it is.

    :param folder: of checkpoints
    :param model: an off-policy agent
    :param notes: anything else to keep, as plain data
    :param keep: how many of the last checkpoints stay, this one included
    :param with_buffer: whether the replay buffer is needed any more
    :return: the checkpoint
    """
    env = model.get_env()
    assert env is not None
    checkpoint = folder / f"{PREFIX}{model.num_timesteps:012d}"
    remove_leftovers(folder, f"{PREFIX}*")  # of other steps, too: nobody may come there again
    with _last_named(folder), atomic_folder(checkpoint) as partial:
        model.save(partial / MODEL)
        if with_buffer and isinstance(model, OffPolicyAlgorithm) and model.replay_buffer is not None:
            model.save_replay_buffer(partial / BUFFER)
        state, hidden = capture(env)
        (partial / ENVIRONMENT).write_text(json.dumps(state), encoding="utf-8")
        manifest = {
            "algorithm": type(model).__name__,
            "num_timesteps": model.num_timesteps,
            "settings": settings_of(model),
            "hidden": hidden,  # what of the environment cannot be restored
            "rng": encode(get_rng_state(model.action_space)),
            "notes": encode(notes),
            "sha256": {path.name: checksum_of(path) for path in sorted(partial.iterdir())},
        }
        (partial / MANIFEST).write_text(json.dumps({**manifest, "digest": digest(manifest)}), encoding="utf-8")
    for old in find_checkpoints(folder)[:-keep]:
        shutil.rmtree(old, ignore_errors=True)
    return checkpoint


def settings_of(model: BaseAlgorithm) -> dict[str, Any]:
    """The arguments of an agent that are plain values, by which its run is distinguished from another one."""
    found = {name: getattr(model, name, None) for name in ALGORITHM if name not in ("verbose", "tensorboard_log")}
    return {name: value for name, value in found.items() if isinstance(value, (bool, int, float, str))}


@contextmanager
def _last_named(folder: pathlib.Path) -> Iterator[None]:
    """Where the disk is full, say which checkpoint is left."""
    try:
        yield
    except OSError as error:
        if error.errno != errno.ENOSPC or not (left := find_checkpoints(folder)):
            raise
        raise OSError(errno.ENOSPC, f"{error.strerror}. The last checkpoint, {left[-1].name}, is whole") from error


def checksum_of(path: pathlib.Path) -> str:
    """SHA-256 of a file, as hexadecimal digits."""
    with open(path, "rb") as file:
        return checksum(file, path.stat().st_size)


def digest(manifest: dict[str, Any]) -> str:
    """SHA-256 of what stands in a manifest beside it."""
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()


def find_checkpoints(folder: pathlib.Path) -> list[pathlib.Path]:
    """Complete checkpoints of a folder, the last one last."""
    return sorted(path for path in folder.glob(f"{PREFIX}*") if (path / MANIFEST).is_file())


def read_manifest(path: pathlib.Path) -> tuple[pathlib.Path, dict[str, Any]]:
    """
    :param path: a checkpoint, or a folder of checkpoints, whose last one is taken
    :return: the checkpoint and what stands in its manifest
    :raises ValueError: if there is none, or a file of it has changed
    """
    remove_leftovers(path, f"{PREFIX}*")
    found = path if (path / MANIFEST).is_file() else next(reversed(find_checkpoints(path)), None)
    if found is None:
        raise ValueError(
            f"{path} must be a checkpoint or a folder with checkpoints, got {'neither' if path.exists() else 'nothing'}."
        )
    try:
        manifest = json.loads((found / MANIFEST).read_text(encoding="utf-8"))
        changed = [MANIFEST] if manifest.pop("digest") != digest(manifest) else []
        changed += [name for name, expected in manifest["sha256"].items() if checksum_of(found / name) != expected]
    except (ValueError, KeyError, TypeError, AttributeError, FileNotFoundError) as error:
        raise ValueError(f"{found} must be a complete checkpoint, got {error!r}. Use an earlier one.") from error
    if changed:
        raise ValueError(f"{found} must be as it was written, got changes in {', '.join(changed)}. Use an earlier checkpoint.")
    return found, manifest


def restore_environment(env: VecEnv, checkpoint: pathlib.Path, wrappers_only: bool) -> None:
    """
    Put an environment, built as the one of the checkpoint, into its state; or its vectorised wrappers alone, such as the
    statistics of VecNormalize.
    """
    env.reset()  # some make their attributes only now
    state = json.loads((checkpoint / ENVIRONMENT).read_text(encoding="utf-8"))
    innermost = state
    while innermost.get("venv") is not None:
        innermost = innermost["venv"]
    if wrappers_only:
        for name in set(innermost) - {KIND, CLASS}:
            del innermost[name]
    restore(env, state)


def restore_generators(model: BaseAlgorithm, manifest: dict[str, Any]) -> None:
    """The random generators, as they were."""
    set_rng_state(decode(manifest["rng"]), model.action_space)


def warn_of_hidden(checkpoint: pathlib.Path, manifest: dict[str, Any]) -> None:
    """Say that a run does not continue exactly."""
    warnings.warn(
        f"{checkpoint}: the environment has a state that cannot be saved ({', '.join(manifest['hidden'][:3])}): "
        "training continues with new episodes, not bit for bit as if it had not stopped."
    )


class ExactCheckpointCallback(BaseCallback):
    """
    Checkpoints from which ``resume`` continues bit for bit: model, replay buffer, VecNormalize, the environments' states and
    the random generators, as one folder ``checkpoint-<step>`` that is complete or absent. They are written before a rollout,
    at the first such moment after every ``save_freq`` steps: none at the very end, and with ``train_freq=128`` at multiples
    of 128.

    :param save_freq: steps of all environments between two checkpoints, ≥ 1
    :param save_path: folder for them
    :param keep: how many of the last ones stay, ≥ 1
    :param verbose: 1 prints where each is written
    :raises ValueError: for an argument out of its range; when ``learn`` begins, for a folder with checkpoints of another run
    """

    def __init__(self, save_freq: int, save_path: str | pathlib.Path, keep: int = 2, verbose: int = 0):
        super().__init__(verbose)
        check("save_freq", save_freq, integer(1))
        check("keep", keep, integer(1))
        self.save_freq = save_freq
        self.save_path = pathlib.Path(save_path)
        self.keep = keep
        self._last = 0

    def _on_training_start(self) -> None:
        self._last = self.num_timesteps // self.save_freq
        if not hasattr(self.model, "resume"):
            raise ValueError(
                "ExactCheckpointCallback: expected an agent of this package, which can resume, found "
                f"{type(self.model).__name__}. Use SB3's CheckpointCallback."
            )
        self._check_folder()

    def _check_folder(self) -> None:
        """Two runs in one folder would take each other's checkpoints for their own."""
        old = find_checkpoints(self.save_path)
        manifest = json.loads((old[-1] / MANIFEST).read_text(encoding="utf-8")) if old else {}
        theirs, ours = manifest.get("settings", {}), settings_of(self.model)
        other = [name for name in theirs if theirs[name] != ours.get(name)]
        is_behind = self.model.seed is None and manifest.get("num_timesteps", 0) > self.model.num_timesteps
        if other or is_behind:
            why = f"{other[0]} = {theirs[other[0]]!r} there, {ours.get(other[0])!r} here" if other else "this one has no seed"
            raise ValueError(
                f"{self.save_path} must be empty or hold checkpoints of this run, got those of another one ({why}). "
                "Pass another folder, or continue that run with resume."
            )

    def _on_rollout_start(self) -> None:
        if self.model.num_timesteps // self.save_freq > self._last:
            self._last = self.model.num_timesteps // self.save_freq
            checkpoint = write_checkpoint(self.save_path, self.model, keep=self.keep)
            if self.verbose:
                print(f"Saving a checkpoint to {checkpoint}")

    def _on_step(self) -> bool:
        return True
