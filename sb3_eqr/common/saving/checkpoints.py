"""Checkpoints: everything needed to resume training exactly, in one folder that is complete or absent."""

import errno
import hashlib
import json
import math
import pathlib
import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_eqr.common.checks.arguments import ALGORITHM, check, integer
from sb3_eqr.common.saving.callbacks import progress_of
from sb3_eqr.common.saving.env_state import capture, restore
from sb3_eqr.common.saving.files import atomic_folder, checksum, remove_leftovers
from sb3_eqr.common.saving.plain_data import decode, encode, without_pickles
from sb3_eqr.common.saving.random_state import get_rng_state, set_rng_state

PREFIX = "checkpoint-"  # followed by the step
MANIFEST, MODEL, BUFFER = "manifest.json", "model.zip", "replay_buffer.pkl"
LARGEST_MANIFEST = 100 << 20  # bytes; Monitor keeps three numbers for each episode, 60 MB for a million


def write_checkpoint(
    folder: pathlib.Path,
    model: BaseAlgorithm,
    notes: Any = None,
    keep: int = 1,
    with_buffer: bool = True,
    callback: BaseCallback | None = None,
) -> pathlib.Path:
    """
    Write a checkpoint and return its path. Call this between two rollouts, in a callback's ``_on_rollout_start``. A checkpoint
    of the same step is not overwritten, unless it is damaged.

    :param folder: folder of the checkpoints
    :param notes: additional plain data to store
    :param keep: number of checkpoints to keep, including this one
    :param with_buffer: whether to include the replay buffer
    :param callback: the one of ``learn``, whose progress is stored
    """
    env = model.get_env()
    assert env is not None
    checkpoint = folder / f"{PREFIX}{model.num_timesteps:012d}"
    remove_leftovers(folder, f"{PREFIX}*")  # also of other steps, which may never be written again
    if (checkpoint / MANIFEST).is_file():
        try:
            read_manifest(checkpoint)
        except ValueError:
            discard(checkpoint)
    elif checkpoint.exists():
        raise ValueError(f"{checkpoint} must be a checkpoint, got one without {MANIFEST}. Move it to another place.")
    with _last_named(folder), atomic_folder(checkpoint) as partial:
        model.save(partial / MODEL)
        if with_buffer and isinstance(model, OffPolicyAlgorithm) and model.replay_buffer is not None:
            model.save_replay_buffer(partial / BUFFER)
        state, unknown = capture(env)
        manifest = {
            "algorithm": type(model).__name__,
            "num_timesteps": model.num_timesteps,
            "settings": settings_of(model),
            "environment": state,
            "unknown": unknown,  # classes of the environment whose state cannot be restored
            "rng": encode(get_rng_state(model.action_space)),
            "notes": encode(notes),
            "callbacks": {} if callback is None else without_pickles(encode(progress_of(callback))),
            "sha256": {path.name: checksum_of(path) for path in sorted(partial.iterdir())},
        }
        (partial / MANIFEST).write_text(json.dumps({**manifest, "digest": digest(manifest)}), encoding="utf-8")
    others = [path for path in find_checkpoints(folder) if path != checkpoint]
    for old in others[: max(len(others) + 1 - keep, 0)]:
        discard(old)
    return checkpoint


def discard(checkpoint: pathlib.Path) -> None:
    """Remove a checkpoint. If the process is killed meanwhile, the next call of ``write_checkpoint`` removes the rest."""
    leftover = checkpoint.with_name(f".{checkpoint.name}.old.partial")
    with suppress(OSError):
        shutil.rmtree(checkpoint.rename(leftover), ignore_errors=True)


def settings_of(model: BaseAlgorithm) -> dict[str, Any]:
    """The arguments of an agent, its spaces and its environment as plain data, to distinguish its run from others."""
    of_sac = ("ent_coef", "target_entropy", "use_sde", "sde_sample_freq", "use_sde_at_warmup")  # which have no rule
    names = [name for name in (*getattr(model, "rules", ALGORITHM), *of_sac) if name not in ("verbose", "tensorboard_log")]
    values = {name: getattr(model, name) for name in names if hasattr(model, name)}
    # TQC's target_entropy is a NumPy number at first, and a float after the model was loaded
    found = {k: without_pickles(encode(v.item() if isinstance(v, np.generic) else v)) for k, v in values.items()}
    spaces = {"observation_space": repr(model.observation_space), "action_space": repr(model.action_space)}
    return {**found, "resets": encode(getattr(model, "resets", None)), **spaces, "environment": environment_of(model)}


def environment_of(model: BaseAlgorithm) -> dict[str, Any]:
    """The first environment's id or class, and gymnasium's arguments; empty in other processes, which would pickle them."""
    innermost = None if model.env is None else model.env.unwrapped
    if not isinstance(innermost, DummyVecEnv):
        return {}
    env, spec = innermost.envs[0].unwrapped, innermost.envs[0].spec
    if spec is None:
        return {"id": type(env).__name__}
    kwargs = {name: value for name, value in spec.kwargs.items() if name != "render_mode"}  # SB3 sets it in what it makes
    return {"id": spec.id, "max_episode_steps": spec.max_episode_steps, "kwargs": without_pickles(encode(kwargs))}


@contextmanager
def _last_named(folder: pathlib.Path) -> Iterator[None]:
    """If the disk is full, add the last complete checkpoint to the error message."""
    try:
        yield
    except OSError as error:
        if error.errno != errno.ENOSPC or not (left := find_checkpoints(folder)):
            raise
        raise OSError(errno.ENOSPC, f"{error.strerror}. The last checkpoint, {left[-1].name}, is complete") from error


def checksum_of(path: pathlib.Path) -> str:
    """SHA-256 of a file, as hexadecimal digits; raises FileNotFoundError if it is not a regular one, such as a pipe."""
    if not path.is_file():
        raise FileNotFoundError(f"{path.name} is not a file")
    with open(path, "rb") as file:
        return checksum(file, path.stat().st_size)


def digest(manifest: dict[str, Any]) -> str:
    """SHA-256 of a manifest without its digest."""
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()


def find_checkpoints(folder: pathlib.Path) -> list[pathlib.Path]:
    """Complete checkpoints in a folder, in order of steps."""
    return sorted(path for path in folder.glob(f"{PREFIX}*") if (path / MANIFEST).is_file())


def read_manifest(path: pathlib.Path) -> tuple[pathlib.Path, dict[str, Any]]:
    """
    :param path: a checkpoint, or a folder of checkpoints, whose last one is used
    :return: the checkpoint and the contents of its manifest
    :raises ValueError: if there is no checkpoint, or one of its files has changed
    """
    remove_leftovers(path, f"{PREFIX}*")
    found = path if (path / MANIFEST).is_file() else next(reversed(find_checkpoints(path)), None)
    if found is None:
        raise ValueError(
            f"{path} must be a checkpoint or a folder with checkpoints, got {'neither' if path.exists() else 'nothing'}."
        )
    try:
        if (found / MANIFEST).stat().st_size > LARGEST_MANIFEST:
            raise ValueError(f"a manifest above {LARGEST_MANIFEST} bytes")
        manifest = json.loads((found / MANIFEST).read_text(encoding="utf-8"))
        changed = [MANIFEST] if manifest.pop("digest") != digest(manifest) else []
        changed += [name for name, expected in manifest["sha256"].items() if checksum_of(found / name) != expected]
    except (ValueError, KeyError, TypeError, AttributeError, FileNotFoundError, RecursionError) as error:
        raise ValueError(f"{found} must be a complete checkpoint, got {error!r}. Use an earlier one.") from error
    if changed:
        raise ValueError(f"{found} must be unchanged, got changes in {', '.join(changed)}. Use an earlier checkpoint.")
    return found, manifest


def warn_of_unknown(classes: list[str]) -> None:
    """Warn, at the start of a run and when it is resumed, that its environments' state is not stored."""
    warnings.warn(
        f"The state of {', '.join(classes[:3])} is not known, so training resumes with new episodes, and does not continue "
        "bit for bit. Give the class state_dict and load_state_dict; in other processes, make the environments with "
        "wrapper_class=sb3_eqr.envs.ResumableWrapper."
    )


def drawn_anew(model: BaseAlgorithm) -> list[str]:
    """The noise of an agent's actions that SB3 draws anew when training resumes."""
    noise = getattr(model, "action_noise", None)
    kept = NormalActionNoise, type(None)  # has no state
    names = ["use_sde=True"] if model.use_sde else []
    return names + ([type(noise).__name__] if not isinstance(getattr(noise, "base_noise", noise), kept) else [])


def warn_of_noise(model: BaseAlgorithm) -> None:
    """Warn, at the start of a run, that the noise of its actions is drawn anew when it is resumed."""
    if names := drawn_anew(model):
        warnings.warn(
            f"{' and '.join(names)}: SB3 draws this noise anew when training resumes, so it does not continue bit for bit. "
            "Use NormalActionNoise, or none."
        )


def restore_run(model: BaseAlgorithm, manifest: dict[str, Any], is_exact: bool) -> None:
    """
    Restore the state of the environments and of the random generators. If that of the environments is not known completely,
    only that of the vectorised wrappers is restored, such as the statistics of VecNormalize, and the agent begins a new
    episode. Its seed depends on the step, so that the run's first episodes are not played again.

    :param model: the loaded agent, with its environments
    :param manifest: from :func:`read_manifest`
    :param is_exact: whether to restore everything
    :raises ValueError: if the environments are built differently
    """
    env = model.get_env()
    assert env is not None
    theirs, ours = manifest["settings"]["environment"], environment_of(model)
    differs = [name for name in theirs if name in ours and theirs[name] != ours[name]]
    named = ", ".join(f"{name} = {theirs[name]!r} there, {ours[name]!r} here" for name in differs)
    if "id" in differs:
        raise ValueError(f"env must be the environment of the original run, got another one ({named}).")
    if differs:
        warnings.warn(f"The run continues in an environment with other arguments than before: {named}.")
    env.reset()  # some environments create their attributes only here
    restore(env, manifest["environment"], wrappers_only=not is_exact)
    if not is_exact:
        model._last_obs = None  # so that learn resets the environment
        env.seed(None if model.seed is None else model.seed + model.num_timesteps)
    set_rng_state(decode(manifest["rng"]), model.action_space)


class ExactCheckpointCallback(BaseCallback):
    """
    Saves checkpoints from which ``resume`` continues bit for bit: model, replay buffer, VecNormalize, the states of the
    environments and random generators, and the progress of SB3's callbacks, in one folder ``checkpoint-<step>`` that is
    complete or absent. A checkpoint is written at the start of the first rollout after every ``save_freq`` steps, so never at
    the very end of training, and with ``train_freq=128`` only at multiples of 128.

    :param save_freq: steps of all environments between two checkpoints, ≥ 1
    :param save_path: folder for the checkpoints
    :param keep: number of latest checkpoints to keep, ≥ 1
    :param verbose: 1 prints the path of each checkpoint
    :raises ValueError: if an argument is out of range, or, at the start of ``learn``, if the folder holds checkpoints of
        another run
    """

    def __init__(self, save_freq: int, save_path: str | pathlib.Path, keep: int = 2, verbose: int = 0):
        super().__init__(verbose)
        check("save_freq", save_freq, integer(1))
        check("keep", keep, integer(1))
        self.save_freq = save_freq
        self.save_path = pathlib.Path(save_path)
        self.keep = keep
        self._last = math.inf  # multiples of save_freq that are written or were passed before
        self._is_called = False  # at the start of rollouts

    def _on_training_start(self) -> None:
        if not hasattr(self.model, "resume"):
            raise ValueError(
                "ExactCheckpointCallback: the agent must be one of this package, which can resume, got "
                f"{type(self.model).__name__}. Use SB3's CheckpointCallback."
            )
        env = self.model.get_env()
        assert env is not None
        if unknown := capture(env)[1]:
            warn_of_unknown(unknown)
        warn_of_noise(self.model)
        manifest = self._last_manifest()
        theirs, ours = manifest.get("settings", {}), settings_of(self.model)
        step, last = self.model.num_timesteps, manifest.get("num_timesteps", 0)
        if step > 0 and theirs:  # resume has warned of other arguments of the environment
            theirs, ours = ({**found, "environment": found["environment"].get("id")} for found in (theirs, ours))
        other = [name for name in theirs if theirs[name] != ours.get(name)]
        # An earlier call of learn with this callback may have ended where a checkpoint was due.
        self._last = last // self.save_freq if 0 < last <= step else min(self._last, step // self.save_freq)
        if other:
            why = f"{other[0]} = {decode(theirs[other[0]])!r} there, {decode(ours.get(other[0]))!r} here"
        elif last > step == 0:  # resume would choose theirs, which has more steps
            why = f"it is at step {last}, this run begins"
        elif last > step and self.model.seed is None:
            why = "this run has no seed"
        else:
            return
        raise ValueError(
            f"{self.save_path} must be empty or hold checkpoints of this run, got those of another run ({why}). "
            "Pass another folder, or resume that run."
        )

    def _last_manifest(self) -> dict[str, Any]:
        """That of the last checkpoint in the folder that is not damaged; empty without one."""
        for checkpoint in reversed(find_checkpoints(self.save_path)):
            with suppress(ValueError):
                return json.loads((checkpoint / MANIFEST).read_text(encoding="utf-8"))
        return {}

    def _on_rollout_start(self) -> None:
        self._is_called = True
        if (multiple := self.model.num_timesteps // self.save_freq) > self._last:
            self._last = multiple
            checkpoint = write_checkpoint(self.save_path, self.model, keep=self.keep, callback=self.locals["callback"])
            if self.verbose:
                print(f"Saving a checkpoint to {checkpoint}")

    def _on_step(self) -> bool:
        if not self._is_called:
            raise ValueError(
                "ExactCheckpointCallback must be given to learn itself, alone or in a list, got it inside another callback, "
                "which calls it in the middle of a step. Choose save_freq instead."
            )
        return True
