"""
The state of environments as plain data: only the attributes that the table names, each of its type. A file holds values for
them and names nothing; parameters of an environment, such as its time limit, belong to the one that the user passes.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper

from sb3_eqr.common.saving.plain_data import decode, encode, without_pickles

# Classes of one module, and their attributes, each with its type. "?" allows None; a "part" is a generator, an emulator, or an
# object with a line of its own, and is updated in place. np_random of an environment is always restored.
TABLE = """
stable_baselines3.common.monitor.Monitor rewards:list needs_reset:bool episode_returns:list episode_lengths:list \
    episode_times:list total_steps:int t_start:real
stable_baselines3.common.atari_wrappers.NoopResetEnv,FireResetEnv,ClipRewardEnv,WarpFrame,AtariWrapper
stable_baselines3.common.atari_wrappers.StickyActionEnv _sticky_action:int
stable_baselines3.common.atari_wrappers.EpisodicLifeEnv lives:int was_real_done:bool
stable_baselines3.common.atari_wrappers.MaxAndSkipEnv _obs_buffer:array
stable_baselines3.common.vec_env.vec_normalize.VecNormalize obs_rms:part ret_rms:part returns:array
stable_baselines3.common.running_mean_std.RunningMeanStd mean:array/real var:array/real count:real
stable_baselines3.common.vec_env.vec_frame_stack.VecFrameStack stacked_obs:part
stable_baselines3.common.vec_env.stacked_observations.StackedObservations stacked_obs:array sub_stacked_observations:part
stable_baselines3.common.vec_env.vec_monitor.VecMonitor episode_count:int t_start:real episode_returns:array \
    episode_lengths:array
stable_baselines3.common.vec_env.vec_transpose.VecTransposeImage
stable_baselines3.common.vec_env.vec_check_nan.VecCheckNan
stable_baselines3.common.vec_env.vec_extract_dict_obs.VecExtractDictObs
gymnasium.wrappers.common.PassiveEnvChecker,OrderEnforcing
gymnasium.wrappers.common.TimeLimit _elapsed_steps:int?
gymnasium.wrappers.common.RecordEpisodeStatistics episode_count:int episode_returns:real episode_lengths:int
gymnasium.wrappers.stateful_observation.TimeAwareObservation timesteps:int
gymnasium.wrappers.stateful_observation.MaxAndSkipObservation _obs_buffer:array
gymnasium.wrappers.atari_preprocessing.AtariPreprocessing lives:int game_over:bool obs_buffer:list
gymnasium.wrappers.transform_observation.FlattenObservation,GrayscaleObservation,ResizeObservation
gymnasium.wrappers.transform_observation.RescaleObservation,DtypeObservation
gymnasium.wrappers.transform_action.ClipAction,RescaleAction
gymnasium.wrappers.transform_reward.ClipReward
gymnasium.envs.classic_control.cartpole.CartPoleEnv state:array? steps_beyond_terminated:int?
gymnasium.envs.classic_control.mountain_car.MountainCarEnv state:array/tuple
gymnasium.envs.classic_control.continuous_mountain_car.Continuous_MountainCarEnv state:array
gymnasium.envs.classic_control.acrobot.AcrobotEnv state:array/list?
gymnasium.envs.classic_control.pendulum.PendulumEnv state:array? last_u:array/real?
gymnasium.envs.toy_text.frozen_lake.FrozenLakeEnv s:int lastaction:int?
gymnasium.envs.toy_text.cliffwalking.CliffWalkingEnv s:int lastaction:int?
gymnasium.envs.toy_text.taxi.TaxiEnv s:int lastaction:int? fickle_step:bool
gymnasium.envs.mujoco.half_cheetah_v5.HalfCheetahEnv,hopper_v5.HopperEnv,walker2d_v5.Walker2dEnv,ant_v5.AntEnv,\
humanoid_v5.HumanoidEnv,humanoidstandup_v5.HumanoidStandupEnv,swimmer_v5.SwimmerEnv,pusher_v5.PusherEnv,\
inverted_pendulum_v5.InvertedPendulumEnv,inverted_double_pendulum_v5.InvertedDoublePendulumEnv data:part
gymnasium.envs.mujoco.reacher_v5.ReacherEnv data:part goal:array
ale_py.env.AtariEnv ale:part
minatar.gym.BaseEnv game:part
minatar.environment.Environment random:part env:part last_action:int
minatar.environments.asterix.Env random:part player_x:int player_y:int entities:list shot_timer:int spawn_speed:int \
    spawn_timer:int move_speed:int move_timer:int ramp_timer:int ramp_index:int terminal:bool
minatar.environments.breakout.Env random:part ball_y:int ball_x:int ball_dir:int pos:int brick_map:array strike:bool \
    last_x:int last_y:int terminal:bool
minatar.environments.freeway.Env random:part cars:list pos:int move_timer:int terminate_timer:int terminal:bool
minatar.environments.seaquest.Env random:part oxygen:int diver_count:int sub_x:int sub_y:int sub_or:bool f_bullets:list \
    e_bullets:list e_fish:list e_subs:list divers:list e_spawn_speed:int e_spawn_timer:int d_spawn_timer:int move_speed:int \
    ramp_index:int shot_timer:int surface:bool terminal:bool
minatar.environments.space_invaders.Env random:part pos:int f_bullet_map:array e_bullet_map:array alien_map:array \
    alien_dir:int enemy_move_interval:int alien_move_timer:int alien_shot_timer:int ramp_index:int shot_timer:int terminal:bool
sb3_eqr.envs.atari.Atari100kWrapper
sb3_eqr.envs.minatar.ChannelsFirstImage
sb3_eqr.envs.blind_cliffwalk.BlindCliffwalk state:int
sb3_eqr.envs.sliding_ball.SlidingBall _start:array _moved:array _distractors:array
sb3_eqr.envs.planar_body.PlanarBody position:array angle:real
sb3_eqr.envs.pixel_pendulum.PixelPendulum angle:real velocity:real
sb3_eqr.envs.star_field.StarField rotation:array translation:array
"""
TYPES: dict[str, tuple[type, ...]] = {
    "int": (int, np.integer),
    "real": (int, float, np.integer, np.floating),
    "bool": (bool, np.bool_),
    "array": (np.ndarray,),
    "list": (list,),
    "tuple": (tuple,),
    "part": (),
}
ATTRIBUTES = {
    f"{first.rsplit('.', 1 + name.count('.'))[0]}.{name}": dict(entry.split(":") for entry in entries)
    for names, *entries in map(str.split, TABLE.strip().split("\n"))
    for first, *others in [names.split(",")]
    for name in [first.rpartition(".")[2], *others]
}


class ResumableWrapper(gym.Wrapper, RecordConstructorArgs):
    """
    Lets a run in other processes be resumed bit for bit, as the outermost wrapper of each environment:
    ``make_vec_env(..., vec_env_cls=SubprocVecEnv, wrapper_class=ResumableWrapper)``.
    """

    def __init__(self, env: gym.Env):
        RecordConstructorArgs.__init__(self)
        super().__init__(env)

    def captured(self) -> list[Any]:
        """:return: the state of this environment"""
        return _captured(_layers(self))

    def restore(self, state: list[Any]) -> None:
        """:param state: returned by :meth:`captured`"""
        _restore_layers(_layers(self), state)


def capture(env: VecEnv) -> tuple[dict[str, Any], list[str]]:
    """
    :param env: environments with all their wrappers
    :return: their state as JSON, and the names of the classes whose state is not known; empty if the state is complete
    """
    *wrappers, innermost = _layers(env)
    parts = _captured(wrappers)
    if isinstance(innermost, DummyVecEnv):
        envs = [_captured(_layers(one)) for one in innermost.envs]
    elif isinstance(innermost, SubprocVecEnv) and all(innermost.env_is_wrapped(ResumableWrapper)):
        envs = innermost.env_method("captured")
    else:
        envs = [[[_name(innermost), None]]]
    unknown = [name for name, state in [*parts, *(part for one in envs for part in one)] if state is None]
    return {"wrappers": parts, "innermost": _name(innermost), "envs": envs}, list(dict.fromkeys(unknown))


def restore(env: VecEnv, state: dict[str, Any], wrappers_only: bool) -> None:
    """
    :param env: environments built like the captured ones, after a reset
    :param state: returned by :func:`capture`
    :param wrappers_only: whether to restore the state of the vectorised wrappers only, such as the statistics of VecNormalize
    :raises ValueError: if the environments are built differently, or a value has not the type or shape of the one it replaces
    """
    *wrappers, innermost = _layers(env)
    try:
        now, _ = capture(env)
        _check_built([*state["wrappers"], [state["innermost"], None]], [*now["wrappers"], [now["innermost"], None]])
        if not wrappers_only:
            for there, here in zip(state["envs"], now["envs"], strict=False):
                _check_built(there, here)
        _restore_layers(wrappers, state["wrappers"])
        if wrappers_only:
            return
        if len(state["envs"]) != innermost.num_envs:
            raise ValueError(f"n_envs must be {len(state['envs'])}, as in the original run, got {innermost.num_envs}.")
        for i, found in enumerate(state["envs"]):
            if isinstance(innermost, DummyVecEnv):
                _restore_layers(_layers(innermost.envs[i]), found)
            else:
                innermost.env_method("restore", found, indices=i)
    except (KeyError, TypeError, AttributeError, OverflowError, RuntimeError, SystemError, EOFError) as error:
        raise ValueError(f"The environment's state must be one written by a checkpoint, got {error!r}.") from error


def _layers(env: Any) -> list[Any]:
    """The wrappers of an environment, or of vectorised ones, from the outside, and what is innermost."""
    layers = [env]
    while isinstance(layers[-1], (VecEnvWrapper, gym.Wrapper)):
        layers.append(layers[-1].venv if isinstance(layers[-1], VecEnvWrapper) else layers[-1].env)
    return [layer for layer in layers if not isinstance(layer, ResumableWrapper)]


def _captured(layers: list[Any]) -> list[Any]:
    return [[_name(layer), _state_of(layer)] for layer in layers]


def _restore_layers(layers: list[Any], state: list[Any]) -> None:
    for layer, (_, found) in zip(layers, state, strict=True):
        _restore(layer, found)


def _check_built(expected: list[Any], found: list[Any]) -> None:
    """Compare the classes of captured layers."""
    theirs, ours = ([name for name, _ in layers] for layers in (expected, found))
    if theirs != ours:
        first, other = (" in ".join(name.rpartition(".")[2] for name in names) for names in (theirs, ours))
        raise ValueError(
            f"env must be {first}, got {other}: the environment is not built as in the original run. "
            "Pass one with the same wrappers, including VecNormalize."
        )


def _name(part: Any) -> str:
    name = f"{type(part).__module__}.{type(part).__qualname__}"
    return name.replace("rl_zoo3.gym_patches.PatchedTimeLimit", "gymnasium.wrappers.common.TimeLimit")  # RL Zoo substitutes it


def _row(part: Any) -> dict[str, str] | None:
    row = ATTRIBUTES.get(_name(part))
    return {**row, "np_random": "part"} if row is not None and _is_env(part) else row


def _is_env(part: Any) -> bool:
    return isinstance(part, gym.Env) and not isinstance(part, gym.Wrapper)


def _arrays_of(simulation: Any) -> dict[str, np.ndarray]:
    """
    All arrays of a MuJoCo simulation with a constant size, also those that follow from others: an observation may hold what
    the last step computed on its way. Those of contacts, which a new simulation has not, are computed anew by each step.
    """
    new = type(simulation)(simulation.model)
    names = [name for name in dir(new) if not name.startswith("_") and isinstance(getattr(new, name), np.ndarray)]
    return {name: getattr(simulation, name) for name in names if getattr(new, name).size}


def _state_of(part: Any) -> Any:
    """The state of a wrapper, an environment or a part of it as JSON; ``None`` if it is not known."""
    if isinstance(part, np.random.Generator):
        return encode(part.bit_generator.state)
    if isinstance(part, np.random.RandomState):
        return encode(part.get_state(legacy=False))
    if type(part).__name__ == "ALEInterface":
        return part.cloneSystemState().serialize().hex()
    if type(part).__name__ == "MjData":
        return {"time": part.time, **{name: encode(value) for name, value in _arrays_of(part).items()}}
    if isinstance(part, dict):
        return {key: _state_of(item) for key, item in part.items()}
    if (row := _row(part)) is not None:
        values = {name: getattr(part, name) for name in row if hasattr(part, name)}
        return {name: _state_of(value) if row[name] == "part" else encode(value) for name, value in values.items()}
    if callable(getattr(part, "state_dict", None)) and callable(getattr(part, "load_state_dict", None)):
        state = encode(part.state_dict())
        if without_pickles(state) != state:
            raise ValueError(f"{_name(part)}.state_dict must return numbers, strings, arrays and containers of these.")
        generator = getattr(part, "np_random", None) if _is_env(part) else None
        return {"state": state, "np_random": _state_of(generator) if isinstance(generator, np.random.Generator) else None}
    return None


def _restore(part: Any, state: Any) -> None:
    """Restore a state in place. What is done with it depends on the object alone, never on the file."""
    if isinstance(part, np.random.Generator):
        part.bit_generator.state = decode(state)
    elif isinstance(part, np.random.RandomState):
        found = decode(state)
        if not 0 <= found["state"]["pos"] <= 624:  # NumPy does not check it, and reads beyond its array
            raise ValueError(f"pos of a generator must be in 0 to 624, got {found['state']['pos']}.")
        part.set_state(found)
    elif type(part).__name__ == "ALEInterface":
        part.restoreSystemState(type(part.cloneSystemState())(bytes.fromhex(state)))
    elif type(part).__name__ == "MjData":
        part.time = _checked("MjData.time", state["time"], "real", part.time)
        for name, array in _arrays_of(part).items():
            array[...] = _checked(f"MjData.{name}", decode(state[name]), "array", array)
    elif isinstance(part, dict):
        for key in part:
            _restore(part[key], state[key])
    elif (row := _row(part)) is None:
        _load_own(part, state)
    else:
        _restore_attributes(part, state, row)


def _load_own(part: Any, state: Any) -> None:
    """The ``load_state_dict`` of a user's class, whose mistakes are not the checkpoint's."""
    if state["np_random"] is not None:
        _restore(part.np_random, state["np_random"])
    found = decode(state["state"])
    try:
        part.load_state_dict(found)
    except Exception as error:
        raise ValueError(f"{_name(part)}.load_state_dict must load what its state_dict returned, got {error!r}.") from error


def _restore_attributes(part: Any, state: dict[str, Any], row: dict[str, str]) -> None:
    if unknown := set(state) - set(row):
        raise ValueError(f"{_name(part)} must be restored from {sorted(row)}, got {sorted(unknown)}.")
    for name, value in state.items():
        if row[name] == "part":
            _restore(getattr(part, name), value)
        else:
            setattr(part, name, _checked(f"{_name(part)}.{name}", decode(value), row[name], getattr(part, name)))


def _checked(path: str, value: Any, kinds: str, current: Any) -> Any:
    """A decoded value of a declared type; an array has shape and dtype of the current one, floats in any precision."""
    legal = [kind for name in kinds.removesuffix("?").split("/") for kind in TYPES[name]] + [type(None)] * kinds.endswith("?")
    is_legal = isinstance(value, tuple(legal))
    if isinstance(value, np.ndarray) and isinstance(current, np.ndarray):
        floats = all(np.issubdtype(array.dtype, np.floating) for array in (value, current))
        is_legal &= value.shape == current.shape and (floats or value.dtype == current.dtype)
    if not is_legal:
        raise ValueError(f"{path} must be like the current {type(current).__name__}, got {value!r:.80}.")
    return value
