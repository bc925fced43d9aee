"""Wrong arguments, from the tables and by hand. Each error must say what is wrong, what it must be and what it got."""

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
from sb3_eqr import EqRQRDQN, EqRRainbow, ExactCheckpointCallback
from sb3_eqr.common.checks.arguments import ALGORITHM, BUFFER, POLICY, Rule, rules_of
from sb3_eqr.common.latent.options import LatentOptions
from sb3_eqr.common.resets import ResetSchedule
from sb3_eqr.configurations import load_configuration

LONGEST = 5.0  # seconds until the error
NAN, INF = float("nan"), float("inf")
POOL: list[Any] = [NAN, INF, -INF, -1, -0.5, 2.5, 1e400, True, "x", "", "1", None, [], [0], {}, 1j, object, np.ones(2)]
EXPLAINS = ("must", "expected", "needs", "Did you mean", "No such file", "doesn't exist", "only supports", "unknown")
Case = tuple[str, str, Callable[[], Any]]  # what, a word that the message must contain, and the call


def refused(table: dict[str, Rule], names: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Yield the names of a table, or some of them, with each value of the pool that their rules reject."""
    for name in names or table:
        yield from ((name, value) for value in POOL if not table[name].holds(value))


def from_the_tables() -> Iterator[Case]:
    """Each argument with each value that its rule rejects; arguments of the algorithm also as attributes set later."""
    model = make()
    for name, value in refused(ALGORITHM):
        yield f"{name}={value!r}", name, partial(EqRQRDQN, "MlpPolicy", "CartPole-v1", **{name: value})
        if hasattr(model, name) and not isinstance(value, (dict, list)):
            yield f"model.{name}={value!r}", name, partial(set_and_learn, model, name, value)
    for name, value in refused(POLICY | rules_of(LatentOptions)):
        kind = EqRQRDQN if name == "n_quantiles" else EqRRainbow
        call = partial(kind, "MlpPolicy", "CartPole-v1", policy_kwargs={name: value})
        yield f"policy_kwargs: {name}={value!r}", name, call
    for name, value in refused(BUFFER, ("alpha", "beta", "final_beta", "frame_stack")):
        yield f"buffer: {name}={value!r}", name, partial(make, replay_buffer_kwargs={name: value})
    for name, value in refused(rules_of(ResetSchedule)):
        yield f"resets: {name}={value!r}", name, partial(make, resets={name: value})


def set_and_learn(model: Any, name: str, value: Any) -> None:
    """Set an attribute after the constructor has checked it, and learn."""
    before = getattr(model, name)
    try:
        setattr(model, name, value)
        model.learn(5)
    finally:
        setattr(model, name, before)


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


COMBINED: list[tuple[str, str, dict[str, Any]]] = [
    ("max_grad_norm=-1", "max_grad_norm", {"max_grad_norm": -1}),
    ("an argument that there is not", "aet_coeff", {"aet_coeff": 1.0}),
    ("a policy argument that there is not", "n_block", {"policy_kwargs": {"n_block": 1}}),
    ("v_min above v_max", "v_min", {"agent": EqRRainbow, "policy_kwargs": {"v_min": 2, "v_max": -2}}),
    ("v_min equal to v_max", "v_min", {"agent": EqRRainbow, "policy_kwargs": {"v_min": 1, "v_max": 1}}),
    ("a buffer that is too small", "buffer_size", {"buffer_size": 3}),
    ("a batch of one", "batch_size", {"batch_size": 1}),
    ("no loss at all", "td_coef", {"td_coef": 0, "prediction_depth": 0}),
    ("whiten without a group", "whiten", {"policy_kwargs": {"whiten": True, "group": None}}),
    ("GET without inverses", "symmetry_coef", {"policy_kwargs": {"group": "none"}}),
]


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
    for what, word, arguments in COMBINED:
        yield what, word, partial(make, **arguments)
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
    """Try every case from the tables and by hand."""
    cases = [*from_the_tables(), *by_hand()]
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
