"""Wrong arguments that no table of rules has. Each error must say what is wrong, what it must be and what it got."""

import contextlib
import io
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from experiments.attacks import Finding, make
from sb3_eqr import EqRQRDQN, ExactCheckpointCallback
from sb3_eqr.common.resets import ResetSchedule
from sb3_eqr.configurations import load_configuration

LONGEST = 5.0  # seconds until the error
NAN, INF = float("nan"), float("inf")
EXPLAINS = ("must", "expected", "needs", "Did you mean", "No such file", "doesn't exist", "only supports", "unknown")
Case = tuple[str, str, Callable[[], Any]]  # what, a word that the message must contain, and the call


class Broken(gym.Env):
    """An environment that violates gymnasium's API in one way."""

    def __init__(self, how: str):
        self.how = how
        self.observation_space = gym.spaces.Box(-1, 1, (3,))
        self.action_space = gym.spaces.Box(-1, 1, (1,)) if how == "continuous actions" else gym.spaces.Discrete(2)
        if how == "no observation space":
            del self.observation_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """As in gymnasium's API, or not."""
        super().reset(seed=seed)
        obs = np.zeros(4 if self.how == "another shape at reset" else 3, dtype=np.float32)
        return obs if self.how == "reset without info" else (obs, {})

    def step(self, action: Any) -> Any:
        """Likewise."""
        obs: Any = np.zeros(4 if self.how == "another shape" else 3, dtype=np.float32)
        reward: Any = {"text as reward": "one", "no reward": None, "an array as reward": np.ones(2)}.get(self.how, 1.0)
        if self.how == "four results":
            return obs, reward, False, {}
        return obs, reward, False, False, None if self.how == "no info" else {}


BREAKS = ("continuous actions", "no observation space", "another shape at reset", "reset without info", "another shape")
RESULTS = ("text as reward", "no reward", "an array as reward", "four results", "no info")


def by_hand() -> Iterator[Case]:
    """What no table says."""
    model = make()
    observations = (np.full(4, NAN), np.full(4, INF), np.zeros(3), np.zeros((2, 2, 2)), "x", None)
    groups = ("SU(2)", "SO(1)", "GL(0)", "SE(2)^0", 2, "", "so(2)", "SO(2)^")
    frequencies, paths = (0, -1, 2.5, True, "x", None), ("nowhere", "nowhere.zip", "/")
    many: list[tuple[str, str, Iterable[Any], Callable[[Any], Any]]] = [
        ("learn({!r})", "total_timesteps", (-5, NAN, "many", None), model.learn),
        ("predict({!r})", "observation", observations, model.predict),
        ("device={!r}", "device", ("nodevice", 3.5, "cuda:x"), lambda value: make(device=value)),
        ("group={!r}", "", groups, lambda value: make(policy_kwargs={"group": value, "n_blocks": None})),
        ("policy={!r}", "", ("LstmPolicy", "CnnPolicy", "MultiInputPolicy", 3, None), lambda value: make(policy=value)),
        ("env={!r}", "", ("NoSuch-v0", 3, None, "Pendulum-v1"), lambda value: make(env=value).learn(5)),
        ("an environment with {}", "", BREAKS + RESULTS, lambda value: make(env=Broken(value)).learn(30)),
        ("save_freq={!r}", "save_freq", frequencies, lambda value: ExactCheckpointCallback(value, "x")),
        ("keep={!r}", "keep", frequencies, lambda value: ExactCheckpointCallback(1, "x", keep=value)),
        ("buffer.add of action {}", "action", (2, -1, NAN), lambda value: add(model, value, 0.0)),
        ("buffer.add of reward {}", "reward", (NAN, INF), lambda value: add(model, 0, value)),
        ("load({!r})", "", paths, EqRQRDQN.load),
        ("resume({!r})", "", paths, lambda value: EqRQRDQN.resume(value, model.get_env())),
        ("load_replay_buffer({!r})", "", paths, model.load_replay_buffer),
        ("load_representation({!r})", "", paths, model.load_representation),
        ("resets={!r}", "resets", (3, {"intervall": 1}), lambda value: make(resets=value)),
    ]
    for what, word, values, call in many:
        yield from ((what.format(value), word, partial(call, value)) for value in values)
    yield "a keyword of load", "gama", lambda: EqRQRDQN.load("nowhere", gama=1)
    yield "a configuration that there is not", "rainbo", lambda: load_configuration("rainbo")
    yield "a schedule's arguments", "interval", lambda: ResetSchedule(interval=0)


def add(model: Any, action: float, reward: float) -> None:
    """Add a transition directly to the replay buffer."""
    obs, zero = np.zeros((1, 4), dtype=np.float32), np.zeros(1)
    model.replay_buffer.add(obs, obs, np.array([action]), np.array([reward]), zero, [{}])


def ask(case: Case) -> str | None:
    """:return: what is wrong with the error of a case; ``None`` if nothing is"""
    what, word, call = case
    began = time.monotonic()
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            call()
    except (ValueError, TypeError, AssertionError, FileNotFoundError, gym.error.Error, RuntimeError) as error:
        seconds, text = time.monotonic() - began, str(error)
        if seconds > LONGEST:
            return f"{what}: {seconds:.1f} s"
        if word not in text or not text:
            return f"{what}: {type(error).__name__} does not say {word!r}: {text[:100]}"
        is_explained = any(part in text for part in EXPLAINS)
        return None if is_explained else f"{what}: {type(error).__name__} does not say what it must be: {text[:100]}"
    except Exception as error:
        return f"{what}: {type(error).__name__}: {str(error)[:100]}"
    return f"{what}: silent"


def wrong_arguments() -> Finding:
    """Try every case."""
    cases = [*by_hand()]
    wrong = [found for found in map(ask, cases) if found is not None]
    must = "every error names the argument, what it must be and what it got; none silent, none over 5 s"
    return Finding(f"{len(cases)} wrong inputs", must, f"{len(cases) - len(wrong)} rejected", wrong)


def without_asserts() -> Finding:
    """The same with ``python -O``, which removes assertions."""
    call = "from experiments.attacks.inputs import wrong_arguments as f; x = f(); print(x.found, *x.details, sep='\\n')"
    done = subprocess.run([sys.executable, "-O", "-c", call], capture_output=True, text=True)
    found, *wrong = done.stdout.strip().splitlines() or [done.stderr[-200:]]
    wrong += [f"status {done.returncode}"] if done.returncode else []
    return Finding("the same with python -O", "all rejected", found, wrong)
