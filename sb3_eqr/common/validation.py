"""Checks, as pure functions: each raises with what was expected, what was found and what to do, or does nothing."""

import inspect
import pathlib
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from functools import wraps
from typing import Any, ParamSpec

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_eqr.common.arguments import POLICY, check, integer, number

P = ParamSpec("P")
LARGEST = float(np.finfo(np.float32).max)


def check_number(name: str, value: Any, low: float, high: float = np.inf, whole: bool = False) -> None:
    """
    :param name: of the argument
    :param value: what was given
    :param low: smallest legal value
    :param high: largest legal value
    :param whole: whether it must be an integer
    :raises ValueError: if it is no finite number in that range
    """
    check(name, value, integer(low, high) if whole else number(low, high))


# The code that takes what an environment returns.
CONSUMERS = ("stable_baselines3/common/vec_env/", "stable_baselines3/common/monitor", "/gymnasium/")


@contextmanager
def environment_errors(step: int) -> Iterator[None]:
    """
    An environment that breaks the interface of gymnasium makes errors in the code that takes what it returns. They get its
    name; errors of the environment's own code stay as they are.

    :raises ValueError: in place of such an error
    """
    try:
        yield
    except (TypeError, ValueError, AttributeError, IndexError) as error:
        innermost = pathlib.Path(traceback.extract_tb(error.__traceback__)[-1].filename).as_posix()
        if not any(name in innermost for name in CONSUMERS):
            raise
        raise ValueError(
            f"step {step}: the environment must follow the interface of gymnasium, got {type(error).__name__}: {error}. "
            "stable_baselines3.common.env_checker.check_env(env) says where it does not."
        ) from error


def check_finite(what: str, values: np.ndarray | dict[str, np.ndarray] | None, step: int) -> None:
    """Refuse values (``what`` they are) of the environment, after so many steps, of which one is NaN or infinite."""
    found = find_infinite(values)
    if found is not None:
        raise ValueError(
            f"step {step}: expected finite {what}s from the environment, found {found} in the {what}. "
            "It was not stored and the model is as before. SB3's VecCheckNan shows which action led there."
        )


def find_infinite(values: np.ndarray | dict[str, np.ndarray] | None) -> str | None:
    """
    The first NaN or infinity of an array, or with its key of a dictionary of arrays; ``None`` if there is none. Numbers that
    float32, in which they are stored, does not hold count as infinite.
    """
    for key, array in values.items() if isinstance(values, dict) else [("", values)]:
        array = np.asarray(array)
        if np.issubdtype(array.dtype, np.floating) and not (is_held := np.abs(array) <= LARGEST).all():
            return f"{array[~is_held].flat[0]}{f' of {key!r}' if key else ''}"
    return None


def check_transition(action_space: spaces.Space, obs: Any, next_obs: Any, action: np.ndarray, reward: np.ndarray) -> None:
    """Refuse a transition with an action that there is not, or with a number that is not finite."""
    for what, values in (("obs", obs), ("next_obs", next_obs), ("reward", reward)):
        if (found := find_infinite(values)) is not None:
            raise ValueError(f"{what} must be finite, got {found}. Nothing was stored.")
    actions, n_actions = np.asarray(action), int(getattr(action_space, "n", 0))
    if n_actions and not ((actions >= 0) & (actions < n_actions)).all():  # NaN is neither
        raise ValueError(f"action must be integers in [0, {n_actions - 1}], got {actions.tolist()}. Nothing was stored.")


def check_names(owner: str, given: Iterable[str], legal: Iterable[str], **elsewhere: type) -> None:
    """
    Refuse an argument of ``owner`` that is not legal (TypeError): say which keyword takes it (``elsewhere``: its classes), or
    which legal one is the nearest, or all of them.
    """
    legal = list(legal)
    for name in given:
        if name not in legal:
            places = [place for place, taker in elsewhere.items() if name in inspect.signature(taker).parameters]
            places += ["policy_kwargs"] if "policy_kwargs" in elsewhere and name in POLICY else []  # of one of the agents
            near = ["symmetry_coef"] if name == "get_coef" else get_close_matches(name, legal, n=1)
            advice = f"It takes {', '.join(one for one in legal if not one.startswith('_'))}."
            advice = f"Pass {places[0]}=dict({name}=...)." if places else f"Did you mean {near[0]!r}?" if near else advice
            raise TypeError(f"{owner} got an unexpected argument {name!r}. {advice}")


def answers_misspelt(**elsewhere: type) -> Callable[[Callable[P, None]], Callable[P, None]]:
    """
    Decorator of a constructor: :func:`check_names` in the name of the class that was called. Python would name the class that
    has defined the constructor, and nothing else.
    """

    def decorator(init: Callable[P, None]) -> Callable[P, None]:
        legal = list(inspect.signature(init).parameters)[1:]

        @wraps(init)
        def checked(*args: P.args, **kwargs: P.kwargs) -> None:
            check_names(type(args[0]).__name__, kwargs, legal, **elsewhere)
            init(*args, **kwargs)

        return checked

    return decorator


def check_env(env: Any) -> None:
    """Refuse what is no environment, such as its class."""
    if not isinstance(env, (gym.Env, VecEnv)):
        raise ValueError(
            f"env must be an environment or a VecEnv, got {env!r}. make_vec_env(...) makes one of a name or a class."
        )


def check_action_space(action_space: spaces.Space) -> None:
    """Refuse actions that are not Discrete and counted from 0, with SB3's type of error for it."""
    if not isinstance(action_space, spaces.Discrete):
        raise AssertionError(
            f"The algorithm only supports {spaces.Discrete} as action space, because the Q head has one output per "
            f"action, but {action_space} was provided. Wrap the environment with discrete actions, "
            "or use an algorithm for that space (SAC, TQC, PPO)."
        )
    if action_space.start != 0:
        raise AssertionError(
            f"The algorithm only supports actions that count from 0, but {action_space} was provided. "
            "Wrap the environment with gymnasium.wrappers.TransformAction."
        )


def check_device(device: Any) -> None:
    """Refuse what is no device of PyTorch; warn of a GPU that is not there, in whose place SB3 takes the CPU."""
    try:
        wanted = th.device("cpu" if device == "auto" else device)
    except (RuntimeError, TypeError):
        raise ValueError(f"device must be 'auto' or a device of PyTorch such as 'cpu' or 'cuda:0', got {device!r}.") from None
    if wanted.type == "cuda" and not th.cuda.is_available():
        warnings.warn(f"device: PyTorch finds no GPU, {device} was asked for. The CPU is used.")


def check_policy(owner: str, policy: Any, aliases: dict[str, type], observation_space: spaces.Space) -> None:
    """Refuse a policy class that is not derived from those of the algorithm, or that does not fit the observations."""
    base = aliases["MlpPolicy"]
    if not (isinstance(policy, type) and issubclass(policy, base)):
        raise ValueError(
            f"{owner}: expected a policy derived from {base.__name__}, found {policy}. "
            f"Use one of {list(aliases)}; a file is loaded by the class that saved it."
        )
    if issubclass(policy, aliases["MultiInputPolicy"]) and not isinstance(observation_space, spaces.Dict):
        raise ValueError(
            f"MultiInputPolicy: expected a Dict observation space, found {observation_space}. "
            "Use MlpPolicy for vectors, CnnPolicy for images."
        )


def check_normalization(normalize: VecNormalize | None, observation_space: spaces.Space) -> None:
    """Refuse a wrapper around VecNormalize that changes observations: their originals could not be stored."""
    if normalize is not None and normalize.observation_space != observation_space:
        raise ValueError(
            f"VecNormalize: expected it outside every wrapper that changes observations, so that it can hand out their "
            f"originals; found {normalize.observation_space} there, {observation_space} outside. "
            "Use VecNormalize(VecTransposeImage(env)), for images."
        )


def check_replay(owner: str, chosen: Any, base: type, kwargs: dict[str, Any], set_by_owner: Iterable[str]) -> None:
    """Refuse a ``replay_buffer_class`` not derived from ``base``, and ``replay_buffer_kwargs`` that the algorithm sets."""
    if chosen is not None and not (isinstance(chosen, type) and issubclass(chosen, base)):
        raise ValueError(
            f"replay_buffer_class: expected {base.__name__} or a class derived from it, found {chosen}. "
            "Leave it out to get the one that prioritized_replay asks for."
        )
    for name in set_by_owner:
        if name in kwargs:
            raise ValueError(
                f"replay_buffer_kwargs: expected arguments that {owner} does not set itself, found "
                f"{name!r}. Pass {name}={kwargs[name]!r} to {owner}."
            )


def check_losses(td_coef: float, depth: int, batch_size: int, gamma: float, initial_gamma: float | None) -> None:
    """Refuse an objective without a loss, a batch that batch norm cannot take, and γ = 1 where γ is annealed."""
    if td_coef == 0 and depth == 0:
        raise ValueError(
            "td_coef: expected a weight above 0 where no auxiliary loss is on, found 0. "
            "Pass prediction_depth >= 1 and one of aet_coef, symmetry_coef, reward_coef above 0."
        )
    if depth > 0 and batch_size < 2:
        raise ValueError(
            f"batch_size: the latent model's batch norm needs at least 2 samples, found {batch_size}. "
            "Pass a larger batch_size or prediction_depth=0."
        )
    if initial_gamma is not None and max(initial_gamma, gamma) == 1:
        raise ValueError(
            f"resets: initial_gamma: expected it and gamma below 1, since 1 - γ is annealed by a factor, found "
            f"{initial_gamma} and {gamma}. Pass initial_gamma=None for a constant γ."
        )


def warn_of_idle_training(last_step: int, learning_starts: int, n_updates: int, buffer: Any) -> None:
    """Warn of a call of ``learn`` that makes no update, and of a trained agent without its replay buffer."""
    if learning_starts >= last_step > 0:
        warnings.warn(
            f"learning_starts={learning_starts} is not below the last step, {last_step}: no update will be made. "
            "Pass a smaller learning_starts, or learn for more steps."
        )
    if n_updates > 0 and buffer is not None and buffer.size() == 0:
        warnings.warn(
            f"The replay buffer is empty, but this agent has made {n_updates} updates: it learns from new transitions alone. "
            "To continue a run, call load_replay_buffer with the file that was saved beside the model, or resume."
        )


def check_same_parameters(expected: dict[str, str], found: dict[str, str]) -> None:
    """Refuse parameters of another ``EqRPolicy.description``: SE(2) with 4 blocks and T(2) with 18 have equal shapes."""
    for name in expected:
        if found.get(name, expected[name]) != expected[name]:
            raise ValueError(
                f"{name}: expected parameters for {expected[name]!r}, found parameters for {found[name]!r}. "
                "Build the model with the policy_kwargs of the file, or use load(), which does."
            )
