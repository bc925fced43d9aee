"""Checkpoints of a run: those of the package, for every agent of Stable-Baselines3, with what was measured so far."""

import pathlib
import shutil
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_eqr.common import checkpoints
from sb3_eqr.common.checkpoints import PREFIX, find_checkpoints
from sb3_eqr.common.plain_data import decode


def write_checkpoint(folder: pathlib.Path, model: BaseAlgorithm, record: dict[str, Any], is_final: bool = False) -> None:
    """
    Call it between two rollouts. The checkpoint before stays until this one is complete.

    :param folder: of the run
    :param model: the agent
    :param record: what was measured so far
    :param is_final: training is over: no replay buffer is needed any more
    """
    checkpoints.write_checkpoint(folder, model, record, with_buffer=not is_final)


def load_checkpoint(checkpoint: pathlib.Path, model: BaseAlgorithm) -> tuple[BaseAlgorithm, dict[str, Any], bool]:
    """
    :param checkpoint: of :func:`write_checkpoint`
    :param model: newly built, whose class, device and environment are used
    :return: the agent that continues, what was measured so far, and whether it does so bit for bit; if not, with a new episode
    """
    checkpoint, manifest = checkpoints.read_manifest(checkpoint)
    is_exact = not manifest["hidden"] and not hasattr(model, "_last_lstm_states")  # which SB3 does not save
    env = model.get_env()
    assert env is not None
    model = type(model).load(checkpoint / checkpoints.MODEL, env=env, device=model.device, force_reset=not is_exact)
    if isinstance(model, OffPolicyAlgorithm) and (checkpoint / checkpoints.BUFFER).is_file():
        model.load_replay_buffer(checkpoint / checkpoints.BUFFER)
        buffer = model.replay_buffer
        if not is_exact and hasattr(buffer, "timeouts"):  # no n-step return across the gap
            buffer.timeouts[buffer.pos - 1] = True  # type: ignore[union-attr]
    env = model.get_env()
    assert env is not None
    checkpoints.restore_environment(env, checkpoint, wrappers_only=not is_exact)
    if not is_exact:
        env.seed((model.seed or 0) + model.num_timesteps)  # other episodes than at the start
    checkpoints.restore_generators(model, manifest)
    return model, decode(manifest["notes"]), is_exact


def remove_checkpoints(folder: pathlib.Path) -> None:
    """Those of a finished run, and what a killed one has left of them."""
    for checkpoint in [*find_checkpoints(folder), *folder.glob(f".{PREFIX}*")]:
        shutil.rmtree(checkpoint, ignore_errors=True)
