"""Checkpoints of a run: everything that training goes on from, in a folder that appears whole or not at all."""

import io
import pathlib
import pickle
import shutil
from typing import Any

import cloudpickle
from gymnasium.utils import EzPickle
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper

from sb3_eqr.common.files import atomic_folder
from sb3_eqr.common.save_util import get_rng_state, set_rng_state

PREFIX = "checkpoint-"  # and the step


def environment_chain(env: VecEnv) -> list[VecEnv]:
    """
    :return: the vectorised environment, from the outermost wrapper to the environments themselves
    """
    chain = [env]
    while isinstance(env, VecEnvWrapper):
        env = env.venv
        chain.append(env)
    return chain


class StatePickler(cloudpickle.Pickler):
    """
    Pickles environments in the state that they are in. Some would come back as new ones (``EzPickle``): ALE's are given their
    state, others cannot be pickled.
    """

    def reducer_override(self, obj: Any) -> Any:
        """As ``pickle.Pickler``'s."""
        if not isinstance(obj, EzPickle):
            return super().reducer_override(obj)
        if not hasattr(obj, "ale"):
            raise pickle.PicklingError(f"{type(obj).__name__} has no way to save its state")
        rest = {name: value for name, value in vars(obj).items() if name != "ale"}
        made_by = type(obj), obj._ezpickle_args, obj._ezpickle_kwargs
        return restore_game, (*made_by, obj.ale.cloneSystemState(), rest)


def restore_game(game_class: Any, args: Any, kwargs: Any, state: Any, rest: dict[str, Any]) -> Any:
    """
    :param game_class: of ALE's environment
    :param args: that it was made with
    :param kwargs: that it was made with
    :param state: of the emulator
    :param rest: all other attributes
    """
    game = game_class(*args, **kwargs)
    game.ale.restoreSystemState(state)
    vars(game).update(rest)
    return game


def pickle_environment(env: VecEnv) -> list[bytes | None]:
    """
    :return: the state of each link of the chain; ``None`` for what cannot be pickled in its state, as Box2D
    """
    states: list[bytes | None] = []
    for link in environment_chain(env):
        buffer = io.BytesIO()
        try:
            if not isinstance(link, (DummyVecEnv, VecEnvWrapper)):
                raise pickle.PicklingError("environments in other processes")
            StatePickler(buffer).dump({k: v for k, v in vars(link).items() if k not in ("venv", "class_attributes")})
            states.append(buffer.getvalue())
        except (TypeError, ValueError, AttributeError, RuntimeError, pickle.PicklingError):
            states.append(None)
    return states


def restore_environment(env: VecEnv, states: list[bytes | None]) -> None:
    """
    :param env: built as the one before
    :param states: of :func:`pickle_environment`
    """
    for link, state in zip(environment_chain(env), states, strict=True):
        if state is not None:
            vars(link).update(cloudpickle.loads(state))


def write_checkpoint(folder: pathlib.Path, model: BaseAlgorithm, record: dict[str, Any], is_final: bool = False) -> None:
    """
    Call it between two rollouts. The checkpoint before stays until this one is whole.

    :param folder: of the run
    :param model: the agent
    :param record: what was measured so far
    :param is_final: training is over: no replay buffer is needed any more
    """
    env = model.get_env()
    assert env is not None
    old = find_checkpoints(folder)
    checkpoint = folder / f"{PREFIX}{model.num_timesteps:012d}"
    with atomic_folder(checkpoint) as partial:  # one of the same step stays: nothing has happened since
        model.save(partial / "model.zip")
        if isinstance(model, OffPolicyAlgorithm) and not is_final:
            model.save_replay_buffer(partial / "replay_buffer.pkl")
        state = {"record": record, "rng": get_rng_state(model.action_space), "environment": pickle_environment(env)}
        (partial / "state.pkl").write_bytes(cloudpickle.dumps(state))
    for path in old:
        if path != checkpoint:
            shutil.rmtree(path, ignore_errors=True)


def find_checkpoints(folder: pathlib.Path) -> list[pathlib.Path]:
    """
    :return: whole checkpoints, the last one last
    """
    return sorted(folder.glob(f"{PREFIX}*"))


def load_checkpoint(checkpoint: pathlib.Path, model: BaseAlgorithm) -> tuple[BaseAlgorithm, dict[str, Any], bool]:
    """
    :param checkpoint: of :func:`write_checkpoint`
    :param model: newly built, whose class, device and environment are used
    :return: the agent that goes on, what was measured so far, and whether it goes on bit for bit; if not, from a fresh episode
    """
    state = cloudpickle.loads((checkpoint / "state.pkl").read_bytes())
    is_exact = None not in state["environment"] and not hasattr(model, "_last_lstm_states")  # which SB3 does not save
    env = model.get_env()
    assert env is not None
    model = type(model).load(checkpoint / "model.zip", env=env, device=model.device, force_reset=not is_exact)
    if isinstance(model, OffPolicyAlgorithm) and (checkpoint / "replay_buffer.pkl").is_file():
        model.load_replay_buffer(checkpoint / "replay_buffer.pkl")
        buffer = model.replay_buffer
        if not is_exact and hasattr(buffer, "timeouts"):  # no n-step return across the gap
            buffer.timeouts[buffer.pos - 1] = True  # type: ignore[union-attr]
    env = model.get_env()
    assert env is not None
    restore_environment(env, state["environment"] if is_exact else [*state["environment"][:-1], None])
    if not is_exact:
        env.seed((model.seed or 0) + model.num_timesteps)  # other episodes than at the start
    set_rng_state(state["rng"], model.action_space)
    return model, state["record"], is_exact


def remove_checkpoints(folder: pathlib.Path) -> None:
    """Those of a finished run, and what a killed one has left of them."""
    for checkpoint in [*find_checkpoints(folder), *folder.glob(f".{PREFIX}*")]:
        shutil.rmtree(checkpoint, ignore_errors=True)
