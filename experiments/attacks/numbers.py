"""NaN wherever one can arise: it must raise an error that names it, and never be saved."""

import pathlib
import re
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th

from experiments.attacks import Finding, make
from sb3_eqr import EqRQRDQN, EqRRainbow

LEARNING_STARTS, STEPS = 20, 60
UPDATES = {"first": 1, "middle": (STEPS - LEARNING_STARTS) // 2, "last": STEPS - LEARNING_STARTS}  # one per step
OUTSIDE, INSIDE = ("observation", "reward"), ("loss", "gradient", "parameter")


class Poisoned(gym.ObservationWrapper):
    """CartPole with a NaN in the observation or reward of step ``at``."""

    def __init__(self, what: str, at: int):
        super().__init__(gym.make("CartPole-v1"))
        self.what, self.at, self.steps = what, at, 0

    def observation(self, observation: Any) -> Any:
        """The observation, or NaN."""
        return observation * (np.nan if self.what == "observation" and self.steps == self.at else 1)

    def step(self, action: Any) -> Any:
        """As gymnasium's ``step``; the reward may be NaN."""
        self.steps += 1
        observation, reward, *rest = super().step(action)
        return observation, np.nan if self.what == "reward" and self.steps == self.at else reward, *rest


def poison(model: Any, what: str, update: int) -> None:
    """Put a NaN into the loss, the gradient or a parameter at one update."""
    objective, after = model.objective, model.policy.after_gradient_step
    parameter = next(model.policy.online.head.parameters())
    count = 0

    def poisoned_objective(*args: Any) -> Any:
        nonlocal count
        count += 1
        terms = objective(*args)
        if count == update and what == "loss":
            terms = terms._replace(loss=terms.loss * np.nan)
        if count == update and what == "gradient":
            terms.loss.register_hook(lambda gradient: gradient * np.nan)
        return terms

    def poisoned_step() -> None:
        after()
        if count == update and what == "parameter":
            with th.no_grad():
                parameter.view(-1)[0] = np.nan

    model.objective, model.policy.after_gradient_step = poisoned_objective, poisoned_step


def mistake(kind: Any, what: str, update: int, path: pathlib.Path) -> str | None:
    """:return: what is wrong if there is a NaN at an update of an agent, which is then saved; ``None`` if nothing is"""
    is_outside = what in OUTSIDE
    env = Poisoned(what, LEARNING_STARTS + update) if is_outside else gym.make("CartPole-v1")
    model = make(kind, env=env, learning_starts=LEARNING_STARTS, train_freq=1, gradient_steps=1, seed=0)
    if not is_outside:
        poison(model, what, update)
    try:
        model.learn(STEPS)
        return "silent"
    except Exception as error:
        step = re.search(r"step (\d+)", str(error))  # an update is checked within two more
        is_near = step is not None and 0 <= int(step[1]) - LEARNING_STARTS - update <= 2
        if "finite" not in str(error) or not is_near:
            return f"{type(error).__name__}: {str(error)[:100]}"
    vars(model).pop("objective")
    vars(model.policy).pop("after_gradient_step", None)
    try:
        model.save(path)
    except FloatingPointError:  # an update has spoilt the model, which is refused
        return "the step was refused, but so is the model" if is_outside else None
    state = kind.load(path).policy.state_dict()
    is_finite = all(bool(th.isfinite(value).all()) for value in state.values() if value.is_floating_point())
    return None if is_finite else "NaN in the file"


def not_a_number(folder: pathlib.Path) -> Finding:
    """Try each place, at the first, a middle and the last update, for both agents."""
    folder.mkdir(parents=True)
    places = list(product((EqRQRDQN, EqRRainbow), (*OUTSIDE, *INSIDE), UPDATES))
    found = [mistake(kind, what, UPDATES[when], folder / "saved.zip") for kind, what, when in places]
    pairs = zip(places, found, strict=True)
    wrong = [f"{kind.__name__}, {what}, {when} update: {text}" for (kind, what, when), text in pairs if text is not None]
    must = "every one stopped with an error that names it, none saved"
    return Finding(f"NaN at {len(places)} places", must, f"{len(places) - len(wrong)} stopped", wrong)
