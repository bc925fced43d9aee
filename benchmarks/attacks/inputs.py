"""Wrong input: arguments by the table and by hand, and command lines. Each must be answered by name, expected and got."""

import contextlib
import io
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.attacks import Finding
from sb3_eqr import EqRQRDQN, EqRRainbow, ExactCheckpointCallback
from sb3_eqr.common.arguments import ALGORITHM, BUFFER, POLICY, RESETS
from sb3_eqr.common.resets import ResetSchedule
from sb3_eqr.configurations import load_configuration

LONGEST = 5.0  # seconds to an answer
NAN, INF = float("nan"), float("inf")
POOL: list[Any] = [NAN, INF, -INF, -1, -0.5, 2.5, 1e400, True, "x", "", "1", None, [], [0], {}, 1j, object, np.ones(2)]
SMALL = {"n_blocks": 2, "net_arch": [8], "latent_hidden_dim": 8}
Case = tuple[str, str, Callable[[], Any]]  # what, a word that the answer must hold, and the call


def make(agent: type = EqRQRDQN, env: Any = "CartPole-v1", policy: str = "MlpPolicy", **kwargs: Any) -> Any:
    """A small agent."""
    policy_kwargs = {**SMALL, **kwargs.pop("policy_kwargs", {})}
    return agent(policy, env, **{"buffer_size": 500, "learning_starts": 20, **kwargs}, policy_kwargs=policy_kwargs)


def from_the_tables() -> Iterator[Case]:
    """Each argument with each value of the pool that its rule refuses; those of the algorithm once more, set later."""
    model = make()
    for name, rule in ALGORITHM.items():
        for value in POOL:
            if not rule.holds(value):
                yield f"{name}={value!r}", name, lambda n=name, v=value: EqRQRDQN("MlpPolicy", "CartPole-v1", **{n: v})
                if not isinstance(value, (dict, list)) and hasattr(model, name):
                    yield f"model.{name}={value!r}", name, lambda n=name, v=value: set_and_learn(model, n, v)
    for name, rule in POLICY.items():
        agent = EqRQRDQN if name == "n_quantiles" else EqRRainbow
        for value in POOL:
            if not rule.holds(value):
                call = lambda n=name, v=value, a=agent: a("MlpPolicy", "CartPole-v1", policy_kwargs={n: v})  # noqa: E731
                yield f"policy_kwargs: {name}={value!r}", name, call
    for name, rule in BUFFER.items():
        for value in POOL:
            if not rule.holds(value) and name in ("alpha", "beta", "final_beta", "frame_stack"):
                yield f"buffer: {name}={value!r}", name, lambda n=name, v=value: make(replay_buffer_kwargs={n: v})
    for name, rule in RESETS.items():
        for value in POOL:
            if not rule.holds(value):
                yield f"resets: {name}={value!r}", name, lambda n=name, v=value: make(resets={n: v})


def set_and_learn(model: Any, name: str, value: Any) -> None:
    """An attribute that is set after the constructor has looked at it."""
    before = getattr(model, name)
    try:
        setattr(model, name, value)
        model.learn(5)
    finally:
        setattr(model, name, before)


class Broken(gym.Env):
    """An environment that breaks the contract of gymnasium in one way."""

    def __init__(self, how: str):
        self.how = how
        self.observation_space = gym.spaces.Box(-1, 1, (3,))
        self.action_space = gym.spaces.Box(-1, 1, (1,)) if how == "continuous actions" else gym.spaces.Discrete(2)
        if how == "no observation space":
            del self.observation_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """As gymnasium wants it, or not."""
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
BREAKS += ("text as reward", "no reward", "an array as reward", "four results", "no info")


def by_hand() -> Iterator[Case]:
    """What no table says."""
    model, names = make(), lambda *words: " ".join(words)
    yield "max_grad_norm=-1", "max_grad_norm", lambda: make(max_grad_norm=-1)
    yield "an argument that there is not", "aet_coeff", lambda: make(aet_coeff=1.0)
    yield "a policy argument that there is not", "n_block", lambda: make(policy_kwargs={"n_block": 1})
    yield "a keyword of load", "gama", lambda: EqRQRDQN.load("nowhere", gama=1)
    for value in (-5, NAN, "many", None):
        yield f"learn({value!r})", "total_timesteps", lambda v=value: model.learn(v)
    for obs in (np.full(4, NAN), np.full(4, INF), np.zeros(3), np.zeros((2, 2, 2)), "x", None):
        yield f"predict({obs!r})", "observation", lambda o=obs: model.predict(o)
    for device in ("nodevice", 3.5, "cuda:x"):
        yield f"device={device!r}", "device", lambda d=device: make(device=d)
    for group in ("SU(2)", "SO(1)", "GL(0)", "SE(2)^0", 2, "", "so(2)", "SO(2)^"):
        yield f"group={group!r}", "", lambda g=group: make(policy_kwargs={"group": g, "n_blocks": None})
    for low, high in ((1, 1), (2, -2)):
        yield f"v_min={low}, v_max={high}", "v_min", lambda a=low, b=high: make(EqRRainbow, policy_kwargs={"v_min": a, "v_max": b})
    for policy in ("LstmPolicy", "CnnPolicy", "MultiInputPolicy", 3, None):
        yield f"policy={policy!r}", "", lambda p=policy: make(policy=p)
    for env in ("NoSuch-v0", 3, None, "Pendulum-v1"):
        yield f"env={env!r}", "", lambda e=env: make(env=e).learn(5)
    for how in BREAKS:
        yield f"an environment with {names(how)}", "", lambda h=how: make(env=Broken(h)).learn(30)
    yield "a buffer that is too small", "buffer_size", lambda: make(buffer_size=3)
    yield "a batch of one", "batch_size", lambda: make(batch_size=1)
    yield "no loss at all", "td_coef", lambda: make(td_coef=0, prediction_depth=0)
    yield "whiten without a group", "whiten", lambda: make(policy_kwargs={"whiten": True, "group": None})
    yield "GET without inverses", "symmetry_coef", lambda: make(policy_kwargs={"group": "none"})
    yield "a configuration that there is not", "rainbo", lambda: load_configuration("rainbo")
    for value in (0, -1, 2.5, True, "x", None):
        yield f"save_freq={value!r}", "save_freq", lambda v=value: ExactCheckpointCallback(v, "x")
        yield f"keep={value!r}", "keep", lambda v=value: ExactCheckpointCallback(1, "x", keep=v)
    yield "resets with an unknown key", "intervall", lambda: make(resets={"intervall": 1})
    yield "resets as a number", "resets", lambda: make(resets=3)
    yield "a schedule's arguments", "interval", lambda: ResetSchedule(interval=0)
    for action in (2, -1, NAN):
        yield f"buffer.add of action {action}", "action", lambda a=action: add(model, a, 0.0)
    for reward in (NAN, INF):
        yield f"buffer.add of reward {reward}", "reward", lambda r=reward: add(model, 0, r)
    for path in ("nowhere", "nowhere.zip", "/"):
        yield f"load({path!r})", "", lambda p=path: EqRQRDQN.load(p)
        yield f"resume({path!r})", "", lambda p=path: EqRQRDQN.resume(p, model.get_env())
        yield f"load_replay_buffer({path!r})", "", lambda p=path: model.load_replay_buffer(p)
        yield f"load_representation({path!r})", "", lambda p=path: model.load_representation(p)


def add(model: Any, action: float, reward: float) -> None:
    """A transition straight into the replay buffer."""
    obs, zero = np.zeros((1, 4), dtype=np.float32), np.zeros(1)
    model.replay_buffer.add(obs, obs, np.array([action]), np.array([reward]), zero, [{}])


def ask(case: Case) -> str | None:
    """What is wrong with the answer; ``None``: nothing."""
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
        is_explained = any(part in text for part in ("must", "expected", "needs", "Did you mean", "No such file", "doesn't exist", "only supports", "unknown"))
        return None if is_explained else f"{what}: {type(error).__name__} does not say what was expected: {text[:100]}"
    except Exception as error:
        return f"{what}: {type(error).__name__}: {str(error)[:100]}"
    return f"{what}: silent"


def wrong_arguments() -> Finding:
    """Every case of the tables and by hand."""
    cases = [*from_the_tables(), *by_hand()]
    wrong = [found for found in map(ask, cases) if found is not None]
    must = "all answered by name, expected, got; none silent, none over 5 s"
    return Finding(f"{len(cases)} wrong inputs", must, f"{len(cases) - len(wrong)} answered", not wrong, tuple(wrong))
