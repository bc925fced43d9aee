"""Checks as pure functions: each does nothing, or raises an error that states what is legal, what was given and what to do."""

import copy
import inspect
import pathlib
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any, ParamSpec

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_eqr.common.checks.arguments import ALGORITHM, POLICY, nearest

P = ParamSpec("P")
LARGEST = float(np.finfo(np.float32).max)
CALLBACKS = "stable_baselines3/common/callbacks.py"  # which calls those of users
# Code that processes the values that an environment returns.
CONSUMERS = ("stable_baselines3/common/vec_env/", "stable_baselines3/common/monitor", "/gymnasium/")
MOMENTS = ("exp_avg", "exp_avg_sq", "max_exp_avg_sq", "momentum_buffer", "sum")  # of PyTorch's fused optimisers
OF_ENV = ("observation_space", "action_space", "n_envs")  # arguments of replay buffers


@contextmanager
def environment_errors(step: int) -> Iterator[None]:
    """
    An environment that violates gymnasium's interface causes errors in the code that processes the values it returns. Replace
    them by a ValueError that names the environment as the cause; errors of its own code, and of
    callbacks, are unchanged.
    """
    try:
        yield
    except (TypeError, ValueError, AttributeError, IndexError) as error:
        files = [pathlib.Path(frame.filename).as_posix() for frame in traceback.extract_tb(error.__traceback__)]
        if any(name.endswith(CALLBACKS) for name in files) or not any(name in files[-1] for name in CONSUMERS):
            raise
        raise ValueError(
            f"step {step}: the environment must follow gymnasium's interface, got {type(error).__name__}: {error}. "
            "stable_baselines3.common.env_checker.check_env(env) reports where it does not."
        ) from error


def find_infinite(values: np.ndarray | dict[str, np.ndarray] | None) -> str | None:
    """
    Return the first NaN or infinity of an array, or of a dictionary of arrays, with its key and its index, or ``None``.
    Numbers beyond the range of float32, in which they are stored, count as infinite.
    """
    for key, array in values.items() if isinstance(values, dict) else [("", values)]:
        array = np.asarray(array)
        if np.issubdtype(array.dtype, np.floating):
            is_held = np.isfinite(array) if array.dtype.itemsize <= 4 else np.abs(array) <= LARGEST
            if not is_held.all():
                where = tuple(np.argwhere(~is_held)[0].tolist())
                return f"{array[where]}{f' of {key!r}' if key else ''}{f' at {list(where)}' if where else ''}"
    return None


def check_transition(action_space: spaces.Space, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any) -> None:
    """Raise ValueError if a transition has an invalid action, a number that is not finite, or an unclear end."""
    for what, values in (("obs", obs), ("next_obs", next_obs), ("reward", reward)):
        if (found := find_infinite(values)) is not None:
            raise ValueError(
                f"{what} must be finite, got {found}. Nothing was stored. SB3's VecCheckNan shows which action caused it."
            )
    actions, n_actions = np.asarray(action), int(getattr(action_space, "n", 0))
    if isinstance(action_space, spaces.Box) and not np.isfinite(actions).all():
        raise ValueError(f"action must be finite, got {actions.tolist()}. Nothing was stored.")
    if n_actions and not ((actions >= 0) & (actions < n_actions)).all():  # NaN is neither
        raise ValueError(f"action must be integers in [0, {n_actions - 1}], got {actions.tolist()}. Nothing was stored.")
    dones = np.asarray(done)
    if dones.dtype != bool and not (np.issubdtype(dones.dtype, np.number) and np.isin(dones, (0, 1)).all()):
        raise ValueError(f"done must be True or False, got {dones.tolist()}. Nothing was stored.")


def check_names(owner: str, given: Iterable[str], legal: Iterable[str], **elsewhere: type) -> None:
    """
    Raise TypeError if ``owner`` does not take an argument. The message states which keyword takes it (``elsewhere``: the
    classes of these keywords), or the legal argument with the nearest name, or all legal arguments.
    """
    legal = list(legal)
    for name in given:
        if name not in legal:
            places = [place for place, taker in elsewhere.items() if name in inspect.signature(taker).parameters]
            places += ["policy_kwargs"] if "policy_kwargs" in elsewhere and name in POLICY else []  # maybe of the other agent
            near = " Did you mean 'symmetry_coef'?" if name == "get_coef" else nearest(name, legal)
            near = " Only EqRQRDQN and EqRRainbow take it." if "policy_kwargs" in elsewhere and name in ALGORITHM else near
            advice = near or f" It takes {', '.join(one for one in legal if not one.startswith('_'))}."
            advice = f" Pass {places[0]}=dict({name}=...)." if places else advice
            raise TypeError(f"{owner} got an unexpected argument {name!r}.{advice}")


def answers_misspelt(**elsewhere: type) -> Callable[[Callable[P, None]], Callable[P, None]]:
    """
    Decorator that applies :func:`check_names` to a constructor, with the name of the class that was called. Python's own error
    names only the class that defines the constructor.
    """

    def decorator(init: Callable[P, None]) -> Callable[P, None]:
        legal = list(inspect.signature(init).parameters)[1:]

        @wraps(init)
        def checked(*args: P.args, **kwargs: P.kwargs) -> None:
            check_names(type(args[0]).__name__, kwargs, legal, **elsewhere)
            init(*args, **kwargs)

        return checked

    return decorator


def check_policy_kwargs(policy: Any, base: type, kwargs: Iterable[str]) -> None:
    """Raise TypeError for an argument that neither a policy, nor ``base``, which it derives from, nor SB3's policy takes."""
    if misplaced := sorted(name for name in kwargs if name in ALGORITHM):
        name = misplaced[0]
        raise TypeError(f"policy_kwargs: {name!r} is an argument of the agent. Pass {name}=... beside policy_kwargs.")
    stock = inspect.signature(super(base, policy).__init__).parameters  # type: ignore[misc, arg-type]
    if any(name not in stock for name in kwargs):
        own = [inspect.signature(kind.__init__).parameters for kind in (type(policy), base)]  # type: ignore[misc]
        names = {name for parameters in [*own, stock] for name in list(parameters)[3:]} - {"kwargs"}
        check_names(f"policy_kwargs: {type(policy).__name__}", kwargs, sorted(names))


def check_env(env: Any) -> None:
    """Raise ValueError if this is not an environment, but, for example, its class."""
    if not isinstance(env, (gym.Env, VecEnv)):
        raise ValueError(
            f"env must be an environment or a VecEnv, got {env!r}. make_vec_env(...) creates one from a name or a class."
        )


def check_action_space(action_space: spaces.Space) -> None:
    """Raise AssertionError, as SB3 does, if the action space is not Discrete or does not start at 0."""
    if not isinstance(action_space, spaces.Discrete):
        raise AssertionError(
            f"The algorithm only supports {spaces.Discrete} as action space, because the Q head has one output per "
            f"action, but {action_space} was provided. Wrap the environment with discrete actions, "
            "or, for a Box, use EqRSAC or EqRTQC."
        )
    if action_space.start != 0:
        raise AssertionError(
            f"The algorithm only supports action spaces that start at 0, but {action_space} was provided. "
            "Wrap the environment with gymnasium.wrappers.TransformAction."
        )


def check_continuous_actions(action_space: spaces.Space) -> None:
    """Raise AssertionError, as SB3 does, if the action space is not a Box, ValueError if a component cannot change."""
    if not isinstance(action_space, spaces.Box):
        raise AssertionError(
            f"The algorithm only supports {spaces.Box} as action space, but {action_space} was provided. "
            "Use EqRQRDQN or EqRRainbow for a Discrete one; no agent has MultiDiscrete or MultiBinary actions."
        )
    if not (action_space.low < action_space.high).all() or 0 in action_space.shape:
        raise ValueError(f"action_space must have components with low < high only, got {action_space}. Leave the others out.")


def check_noise(noise: Any, shape: Any) -> None:
    """Raise ValueError if a noise is not one number for each component of an action. Draws from NumPy's global generator."""
    if noise is not None:
        drawn = np.asarray(copy.deepcopy(getattr(noise, "base_noise", noise))())
        if drawn.shape not in ((), (1,), shape) or not np.isfinite(drawn).all():
            raise ValueError(f"action_noise must have the shape of an action, {shape}, and be finite, got {noise!r}.")


def check_observation_space(observation_space: spaces.Space, name: str = "observation_space") -> None:
    """
    Raise ValueError if it, or a space in a dict, is of a kind without a fixed shape, is empty, has no axis, or is
    Discrete or MultiDiscrete and does not start at 0, or MultiDiscrete with several axes.
    """
    if isinstance(observation_space, spaces.Dict) and name == "observation_space":
        for key, space in observation_space.spaces.items():
            check_observation_space(space, f"observation_space[{key!r}]")
    elif not isinstance(observation_space, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
        raise ValueError(
            f"{name} must be a Box, Discrete, MultiDiscrete or MultiBinary, or a Dict of these, got {observation_space}. "
            "Wrap the environment, for example with gymnasium.wrappers.FilterObservation to leave keys of a Dict out, with "
            "FlattenObservation, or, for MiniGrid, with minigrid.wrappers.ImgObsWrapper."
        )
    if isinstance(observation_space, spaces.MultiDiscrete) and observation_space.nvec.ndim > 1:
        raise ValueError(f"{name} must be a MultiDiscrete of one dimension, got {observation_space}. Flatten it.")
    if isinstance(observation_space, (spaces.Discrete, spaces.MultiDiscrete)) and np.any(observation_space.start != 0):
        raise ValueError(
            f"{name} must start at 0, because SB3 encodes it as one-hot, got {observation_space}. "
            "Wrap the environment with gymnasium.wrappers.TransformObservation."
        )
    if 0 in (observation_space.shape or ()) or observation_space == spaces.Dict():
        raise ValueError(f"{name} must not be empty, got {observation_space}.")
    if isinstance(observation_space, spaces.Box) and observation_space.shape == ():
        raise ValueError(
            f"{name} must have at least one axis, got {observation_space}. "
            "Wrap the environment with gymnasium.wrappers.ReshapeObservation and the shape (1,)."
        )


def check_device(device: Any) -> None:
    """Raise ValueError if this is not a device of PyTorch; warn if there is no GPU, because SB3 then uses the CPU."""
    try:
        wanted = th.device("cpu" if device == "auto" else device)
    except (RuntimeError, TypeError):
        raise ValueError(f"device must be 'auto' or a device of PyTorch such as 'cpu' or 'cuda:0', got {device!r}.") from None
    if wanted.type == "cuda" and not th.cuda.is_available():
        warnings.warn(f"device: {device} was requested, but PyTorch finds no GPU. The CPU is used instead.")


def check_policy(owner: str, policy: Any, aliases: dict[str, type], observation_space: spaces.Space) -> None:
    """Raise ValueError if a policy class is not derived from those of the algorithm, or does not match the observations."""
    base = aliases["MlpPolicy"]
    if not (isinstance(policy, type) and issubclass(policy, base)):
        raise ValueError(
            f"{owner}: policy must be derived from {base.__name__}, got {policy}. "
            f"Use one of {list(aliases)}, and load a file with the class that saved it."
        )
    if issubclass(policy, aliases["MultiInputPolicy"]) and not isinstance(observation_space, spaces.Dict):
        raise ValueError(
            f"MultiInputPolicy: observation_space must be a Dict space, got {observation_space}. "
            "Use MlpPolicy for vectors, CnnPolicy for images."
        )


def check_normalization(normalize: VecNormalize | None, observation_space: spaces.Space) -> None:
    """
    Raise ValueError if a wrapper outside VecNormalize changes observations: the originals could not be stored; or if it
    normalises integers, whose terminal observations SB3 would cut to integers after it has scaled them back.
    """
    if normalize is None:
        return
    if normalize.norm_obs:
        inside = normalize.venv.observation_space
        keys = normalize.norm_obs_keys or []
        parts = {key: inside[key] for key in keys} if isinstance(inside, spaces.Dict) else {"": inside}
        if integers := [key for key, space in parts.items() if not np.issubdtype(space.dtype, np.floating)]:  # type: ignore[arg-type]
            of_keys = f" of {', '.join(map(repr, integers))}" if integers != [""] else ""
            raise ValueError(
                f"VecNormalize must normalise floats, got integers{of_keys}. Pass norm_obs=False, or norm_obs_keys with the "
                "other keys of a Dict; or put gymnasium.wrappers.DtypeObservation(env, np.float32) around the environment."
            )
    if normalize.observation_space != observation_space:
        raise ValueError(
            f"VecNormalize must be outside all wrappers that change observations, so that it can return the original ones, "
            f"got {normalize.observation_space} from VecNormalize and {observation_space} outside. "
            "Use VecNormalize(VecTransposeImage(env), norm_obs=False) for images; with RL Zoo, leave out normalize for them."
        )


def check_replay(owner: str, chosen: Any, base: type, kwargs: dict[str, Any], set_by_owner: Iterable[str]) -> None:
    """Raise ValueError if the class is not derived from ``base``, or ``kwargs`` contains arguments that the algorithm sets."""
    if chosen is not None and not (isinstance(chosen, type) and issubclass(chosen, base)):
        raise ValueError(
            f"replay_buffer_class must be {base.__name__} or a class derived from it, got {chosen}. "
            "Leave it out; there is no HER."
        )
    for name in (*set_by_owner, *OF_ENV):
        if name in kwargs:
            remedy = "Leave it out: it follows from env." if name in OF_ENV else f"Pass {name}={kwargs[name]!r} to {owner}."
            raise ValueError(
                f"replay_buffer_kwargs must not contain arguments that {owner} sets itself, got {name!r}. {remedy}"
            )


def check_has_env(algorithm: Any) -> None:
    """Raise ValueError for an algorithm that was made with ``env=None``."""
    if getattr(algorithm, "observation_space", None) is None:
        raise ValueError("env must be an environment or the name of a registered one, got None.")


def check_losses(td_coef: float, depth: int, batch_size: int, whiten: bool, gamma: float, initial_gamma: float | None) -> None:
    """Raise ValueError if there is no loss, if a batch has neither pairs nor a covariance, or if γ = 1 is to be annealed."""
    if td_coef == 0 and depth == 0:
        raise ValueError(
            "td_coef must be > 0 if all auxiliary losses are disabled, got 0. "
            "Pass td_coef > 0, or prediction_depth >= 1 and one of aet_coef, symmetry_coef, reward_coef > 0."
        )
    if batch_size < 2 and (depth > 0 or whiten):
        raise ValueError(
            "batch_size must be an integer >= 2 for the auxiliary losses, which pair samples, and for whiten=True, "
            f"got {batch_size}. Pass a larger batch_size, or prediction_depth=0 and whiten=False."
        )
    if initial_gamma is not None and max(initial_gamma, gamma) == 1:
        raise ValueError(
            f"resets: initial_gamma and gamma must be < 1, because 1 - gamma is annealed geometrically, got "
            f"{initial_gamma} and {gamma}. Pass initial_gamma=None for a constant gamma."
        )


def warn_of_slow_bfloat16(device: th.device) -> None:
    """Warn if a device has no instructions for bfloat16."""
    if device.type == "cuda":
        is_fast = th.cuda.is_bf16_supported(including_emulation=False)
    else:
        capabilities: dict[str, Any] = getattr(th.cpu, "get_capabilities", dict)()
        is_fast = any(bool(there) for name, there in capabilities.items() if name.endswith("bf16"))  # avx512_bf16, amx_bf16
    if not is_fast:
        warnings.warn(
            f"bfloat16_targets=True: PyTorch finds no instructions for bfloat16 on {device.type}, so updates may take longer. "
            "Leave it out."
        )


def warn_of_memory_option(optimize_memory_usage: bool) -> None:
    """Warn if it is asked for."""
    if optimize_memory_usage:
        warnings.warn("optimize_memory_usage=True has no effect: the replay buffer always stores each observation only once.")


def warn_of_idle_training(last_step: int, learning_starts: int | None, n_updates: int, buffer: Any) -> None:
    """Warn if a call of ``learn`` makes no updates, or if a trained agent has no replay buffer."""
    if learning_starts is not None and learning_starts >= last_step > 0:
        warnings.warn(
            f"learning_starts={learning_starts} is not smaller than the last step, {last_step}, so no updates will be made. "
            "Pass a smaller learning_starts, or learn for more steps."
        )
    if n_updates > 0 and buffer is not None and buffer.size() == 0:
        warnings.warn(
            f"The replay buffer is empty, but this agent has made {n_updates} updates: it learns only from new transitions. "
            "To continue a run, call load_replay_buffer with the buffer saved with the model, or use resume."
        )


def check_same_parameters(expected: dict[str, str], found: dict[str, str]) -> None:
    """Raise ValueError if ``EqRPolicy.description`` differs: SE(2) with 4 blocks and T(2) with 18 have equal shapes."""
    for name in expected:
        if found.get(name, expected[name]) != expected[name]:
            raise ValueError(
                f"{name}: parameters must be for {expected[name]!r}, got parameters for {found[name]!r}. "
                "Build the model with the policy_kwargs and observations of the file, or use load(), which does so, "
                "unless the file is of a version with other defaults."
            )


def check_moments(optimizer: th.optim.Optimizer) -> None:
    """Raise ValueError if a loaded moment has not its parameter's shape and kind: a fused kernel would write beyond it."""
    for parameter, state in optimizer.state.items():
        for name, value in [(name, state[name]) for name in MOMENTS if isinstance(state.get(name), th.Tensor)]:
            if value.shape != parameter.shape or value.is_floating_point() != parameter.is_floating_point():
                raise ValueError(
                    f"{name} of the optimiser must have the shape of its parameter, {tuple(parameter.shape)}, got "
                    f"{tuple(value.shape)}, {value.dtype}. Load a file that was saved by the same kind of agent."
                )
