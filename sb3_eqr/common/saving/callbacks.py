"""
What SB3's callbacks have counted and measured so far, and the environments that they evaluate in, which SB3 does not save: a
resumed run continues from there.
"""

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    EvalCallback,
    EventCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
)

from sb3_eqr.common.saving.env_state import capture, restore

PROGRESS = {
    BaseCallback: ("n_calls",),
    EvalCallback: (
        "best_mean_reward",
        "last_mean_reward",
        *(f"evaluations_{name}" for name in ("timesteps", "results", "length", "successes")),
    ),
    EveryNTimesteps: ("last_time_trigger",),
    StopTrainingOnMaxEpisodes: ("n_episodes",),
    StopTrainingOnNoModelImprovement: ("last_best_mean_reward", "no_improvement_evals"),
}


def each(callback: BaseCallback) -> Iterator[BaseCallback]:
    """A callback and all that it calls."""
    yield callback
    called: list[BaseCallback | None] = []
    if isinstance(callback, CallbackList):
        called += callback.callbacks
    elif isinstance(callback, EventCallback):
        called += [callback.callback, getattr(callback, "callback_on_new_best", None)]
    for one in called:
        if one is not None:
            yield from each(one)


def names_of(callback: BaseCallback) -> list[str]:
    """Names of the attributes that are saved."""
    return [name for kind, names in PROGRESS.items() if isinstance(callback, kind) for name in names]


def progress_of(callback: BaseCallback) -> dict[str, list[dict[str, Any]]]:
    """
    :param callback: the one of ``learn``, with all that it calls
    :return: the attributes of each callback, in order, by the name of its class; "eval_env" is the state of its environments
    """
    found: dict[str, list[dict[str, Any]]] = {}
    for one in each(callback):
        state = {name: getattr(one, name) for name in names_of(one)}
        if isinstance(one, EvalCallback):
            environments, unknown = capture(one.eval_env)
            state |= {} if unknown else {"eval_env": environments}
        found.setdefault(type(one).__name__, []).append(state)
    return found


def restore_progress(callback: BaseCallback, progress: dict[str, list[dict[str, Any]]]) -> None:
    """
    Restore what :func:`progress_of` returned. Of several callbacks of a class, the first continues the first, and so on. New
    ones begin.
    """
    left = {name: iter(states) for name, states in progress.items()}
    for one in each(callback):
        state = next(left.get(type(one).__name__, iter(())), {})
        for name in names_of(one):
            if isinstance(state.get(name), type(getattr(one, name))):
                setattr(one, name, state[name])
        if isinstance(one, EvalCallback) and "eval_env" in state:
            one.eval_env.reset()  # some environments create their attributes only here
            with suppress(ValueError):  # others than before begin anew
                restore(one.eval_env, state["eval_env"], wrappers_only=False)
