"""The legal values of all arguments, in tables that the constructors, the tests and the documentation use."""

import argparse
import inspect
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import field, fields
from difflib import get_close_matches
from typing import Any, NamedTuple, NoReturn

import numpy as np
import torch as th
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn


class Rule(NamedTuple):
    """
    :param says: description of the legal values for error messages, such as "an integer >= 1"
    :param holds: function that returns whether a value is legal
    """

    says: str
    holds: Callable[[Any], bool]

    def __or__(self, other: "Rule") -> "Rule":
        return Rule(f"{self.says} or {other.says}", lambda value: self.holds(value) or other.holds(value))


def number(low: float = -np.inf, high: float = np.inf, above: bool = False) -> Rule:
    """A finite number in [low, high], or in (low, high] with ``above``. Booleans are not accepted."""
    return _in_range("a finite number", (int, float, np.integer, np.floating), low, high, above)


def integer(low: float = -np.inf, high: float = np.inf) -> Rule:
    """An integer in [low, high]. Floats such as 32.0 and booleans are not accepted."""
    return _in_range("an integer", (int, np.integer), low, high, False)


def _in_range(kind: str, types: tuple[type, ...], low: float, high: float, above: bool) -> Rule:
    bounds = f" in {'(' if above else '['}{low:g}, {high:g}]"
    if high == np.inf:
        bounds = "" if low == -np.inf else f" {'>' if above else '>='} {low:g}"

    def holds(value: Any) -> bool:
        if isinstance(value, bool) or not isinstance(value, types):
            return False
        found: Any = value
        return bool((low < found if above else low <= found) and found <= high and abs(found) < np.inf)

    return Rule(kind + bounds, holds)


def one_of(choices: Iterable[Any]) -> Rule:
    """One of the given strings."""
    legal = list(choices)
    return Rule(f"one of {legal}", lambda value: isinstance(value, str) and value in legal)


def a(kind: type, says: str) -> Rule:
    """An instance of a class."""
    return Rule(says, lambda value: isinstance(value, kind))


def a_subclass(kind: type, says: str) -> Rule:
    """A subclass of a class."""
    return Rule(says, lambda value: isinstance(value, type) and issubclass(value, kind))


def a_list(of: Rule) -> Rule:
    """A list or tuple of values for which a rule holds."""
    says = of.says.removeprefix("an ").removeprefix("a ").replace("integer", "integers", 1)
    return Rule(f"a list of {says}", lambda value: isinstance(value, (list, tuple)) and all(map(of.holds, value)))


FLAG = Rule("True or False", lambda value: isinstance(value, (bool, np.bool_)))
TEXT = a(str, "a string")
NONE = Rule("None", lambda value: value is None)
DICTIONARY = a(Mapping, "a dictionary")
FUNCTION = Rule("a schedule", callable)
SHARE = number(0, 1)
WEIGHT = number(0)
FREQUENCY = integer(1) | Rule(
    "a pair such as (1, 'episode')",
    lambda value: (
        isinstance(value, (tuple, list))
        and len(value) == 2
        and integer(1).holds(value[0])
        and getattr(value[1], "value", value[1]) in ("step", "episode")
    ),  # SB3 converts it to an enum
)

ALGORITHM: dict[str, Rule] = {
    "learning_rate": WEIGHT | FUNCTION,
    "buffer_size": integer(1),
    "learning_starts": integer(0) | NONE,
    "batch_size": integer(1),
    "tau": SHARE,
    "gamma": SHARE,
    "train_freq": FREQUENCY,
    "gradient_steps": integer(-1),
    "replay_buffer_kwargs": DICTIONARY | NONE,
    "optimize_memory_usage": FLAG,
    "n_steps": integer(1),
    "target_update_interval": integer(1) | NONE,
    "exploration_fraction": SHARE,
    "exploration_initial_eps": WEIGHT,
    "exploration_final_eps": SHARE,
    "max_grad_norm": number(0, above=True) | NONE,
    "prediction_depth": integer(0),
    "aet_coef": WEIGHT,
    "symmetry_coef": WEIGHT,
    "reward_coef": WEIGHT,
    "td_coef": WEIGHT,
    "aux_gradient_share": WEIGHT | NONE,
    "double_q": FLAG,
    "prioritized_replay": FLAG,
    "shift_pixels": integer(0),
    "intensity_scale": WEIGHT,
    "cuda_graph": FLAG,
    "stats_window_size": integer(1),
    "tensorboard_log": TEXT | a(os.PathLike, "a path") | NONE,
    "policy_kwargs": DICTIONARY | NONE,
    "verbose": integer(0, 2) | FLAG,
    "seed": integer(0, 2**32 - 1) | NONE,
}
POLICY: dict[str, Rule] = {
    "net_arch": a_list(integer(1)) | NONE,
    "activation_fn": a_subclass(nn.Module, "a class of torch.nn such as nn.ReLU"),
    "features_extractor_class": a_subclass(BaseFeaturesExtractor, "a features extractor of SB3") | TEXT | NONE,
    "features_extractor_kwargs": DICTIONARY | NONE,
    "normalize_images": FLAG,
    "optimizer_class": a_subclass(th.optim.Optimizer, "a class of torch.optim") | TEXT,
    "optimizer_kwargs": DICTIONARY | NONE,
    "layer_norm": FLAG,
    "center": FLAG,
    "head_input": one_of(["state", "trunk"]),
    "dueling": FLAG,
    "noisy": FLAG,
    "sigma_init": WEIGHT,
    "act_with_target": FLAG,
    "bfloat16_targets": FLAG,
    "n_atoms": integer(2),
    "v_min": number(),
    "v_max": number(),
    "spread_init": number(0, above=True) | NONE,
    "n_quantiles": integer(1),
}
BUFFER: dict[str, Rule] = {
    "n_steps": integer(1),
    "gamma": SHARE,
    "prediction_depth": integer(0),
    "frame_stack": integer(1),
    "n_envs": integer(1),
    "alpha": WEIGHT,
    "beta": SHARE,
    "final_beta": SHARE,
}


def option(default: Any, rule: Rule) -> Any:
    """A field of a dataclass with the rule for its values, which :func:`check_fields` checks."""
    return field(default=default, metadata={"rule": rule})


def with_fields_of(options: type) -> Callable[[Any], Any]:
    """A decorator that shows the fields of a dataclass in the signature of a function, in place of its ``**kwargs``."""

    def decorate(function: Any) -> Any:
        found = inspect.signature(function)
        *own, kwargs = found.parameters.values()
        kind = inspect.Parameter.KEYWORD_ONLY
        shown = [inspect.Parameter(f.name, kind, default=f.default, annotation=f.type) for f in fields(options)]
        function.__signature__ = found.replace(parameters=[*own, *shown, kwargs])
        return function

    return decorate


def parameters_of(cls: type) -> dict[str, inspect.Parameter]:
    """Parameters of a constructor, and of those of base classes that it passes ``**kwargs`` to, by name, without ``self``."""
    found: dict[str, inspect.Parameter] = {}
    for base in cls.__mro__:
        if "__init__" in vars(base):
            parameters = list(inspect.signature(base.__init__).parameters.values())[1:]  # type: ignore[misc]
            named = {p.name: p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)}
            found = {**named, **found}
            if not any(p.kind is p.VAR_KEYWORD for p in parameters):
                break
    return found


def rules_of(options: Any) -> dict[str, Rule]:
    """The rules of the fields of a dataclass, by name."""
    return {found.name: found.metadata["rule"] for found in fields(options) if "rule" in found.metadata}


def check_fields(options: Any, prefix: str = "") -> None:
    """As :func:`check_arguments`, for the fields of an instance of a dataclass."""
    check_arguments(vars(options), rules_of(options), prefix)


def plain(value: Any) -> Any:
    """A number of NumPy as one of Python, and a path as a string, which SB3 and PyTorch need in places; else unchanged."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return value.item() if isinstance(value, np.generic) else value


def nearest(name: str, legal: Iterable[str], cutoff: float = 0.6) -> str:
    """The end of a message: a question with the closest legal name, or "" if none has at least the similarity ``cutoff``."""
    found = get_close_matches(name, list(legal), n=1, cutoff=cutoff)
    return f" Did you mean {found[0]!r}?" if found else ""


class SuggestingParser(argparse.ArgumentParser):
    """A parser whose error for an unknown option names the closest one."""

    def error(self, message: str) -> NoReturn:
        """Print usage and message, and exit with 2."""
        unknown = message.partition("unrecognized arguments: ")[2].partition(" ")[0]
        super().error(f"{message}.{nearest(unknown, self._all_options())}" if unknown else message)

    def _all_options(self) -> list[str]:
        """Its options and those of its commands."""
        options = [option for action in self._actions for option in action.option_strings]
        commands = [action for action in self._actions if isinstance(action, argparse._SubParsersAction)]
        return options + [option for action in commands for one in action.choices.values() for option in one._all_options()]


def check(name: str, value: Any, rule: Rule) -> None:
    """Raise ValueError if the rule does not hold for the value of the argument ``name``."""
    if not rule.holds(value):
        raise ValueError(f"{name} must be {rule.says}, got {value!r}.")


def check_arguments(values: Mapping[str, Any], rules: Mapping[str, Rule], prefix: str = "") -> None:
    """Raise ValueError for the first illegal value; those without a rule are legal. Messages put ``prefix`` before names."""
    for name, rule in rules.items():
        if name in values:
            check(prefix + name, values[name], rule)
