"""Timing methods from outside: nothing of this is in what is timed, and nothing stays there."""

import functools
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple

import numpy as np

REST = "rest"
REMEDY = "Bring the tables of stages in sb3_eqr/benchmark/speed up to date."


class Stage(NamedTuple):
    """
    :param name: several methods may share one
    :param owner: an object, a class or a module. A method that Python looks up on the class, such as ``__call__``, needs
        the class
    :param attribute: of the owner: a function or method
    """

    name: str
    owner: Any
    attribute: str


class Stopwatch:
    """
    Time by stage. What a stage spends in another stage counts there only, so that stages add up to the whole.

    :param now: gives seconds
    """

    def __init__(self, now: Callable[[], float] = time.perf_counter):
        self._now = now
        self._nested = [0.0]  # per call that is open: seconds spent in stages inside
        self.seconds: dict[str, float] = {}
        self.calls: dict[str, int] = {}

    @contextmanager
    def watching(self, stages: Iterable[Stage]) -> Iterator[None]:
        """
        Time the stages' methods; they are put back afterwards.

        :raises AttributeError: for a stage whose method is not there
        """
        with ExitStack() as put_back:
            for stage in stages:
                put_back.enter_context(self._replaced(stage))
            yield

    @contextmanager
    def _replaced(self, stage: Stage) -> Iterator[None]:
        if not callable(getattr(stage.owner, stage.attribute, None)):
            owner = stage.owner.__name__ if hasattr(stage.owner, "__name__") else type(stage.owner).__name__
            raise AttributeError(
                f"stage {stage.name!r}: expected a method {stage.attribute!r} of {owner}, found none. {REMEDY}"
            )
        self.seconds.setdefault(stage.name, 0.0)
        self.calls.setdefault(stage.name, 0)
        own = vars(stage.owner)
        was_own, before = stage.attribute in own, own.get(stage.attribute)
        setattr(stage.owner, stage.attribute, self._timed(stage.name, getattr(stage.owner, stage.attribute)))
        try:
            yield
        finally:
            if was_own:
                setattr(stage.owner, stage.attribute, before)
            else:  # an object found it on its class
                delattr(stage.owner, stage.attribute)

    def _timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def timed(*args: Any, **kwargs: Any) -> Any:
            self._nested.append(0.0)
            start = self._now()
            try:
                return function(*args, **kwargs)
            finally:
                took = self._now() - start
                self.seconds[name] += took - self._nested.pop()
                self._nested[-1] += took
                self.calls[name] += 1

        return timed

    def measure(self, stages: Iterable[Stage], call: Callable[[], object]) -> dict[str, float]:
        """
        :param stages: what to tell apart
        :param call: called once
        :return: seconds by stage in this call, and in the rest of it
        :raises RuntimeError: for a stage that it did not come to: its time would hide in the rest
        """
        seconds, calls = dict(self.seconds), dict(self.calls)
        with self.watching(stages):
            start = self._now()
            call()
            took = self._now() - start
        missed = [name for name, count in self.calls.items() if count == calls.get(name, 0)]
        if missed:
            raise RuntimeError(f"stages: expected calls of each, found none of {', '.join(missed)}. {REMEDY}")
        spent = {name: after - seconds.get(name, 0.0) for name, after in self.seconds.items()}
        return {**spent, REST: took - sum(spent.values())}


class Breakdown(NamedTuple):
    """What a call took by stage."""

    spent: list[dict[str, float]]  # round by round: seconds by stage, the rest among them
    calls: dict[str, float]  # of each stage per round

    def median(self, *stages: str) -> float:
        """
        :param stages: taken together; all of them and the rest where none is named
        :return: seconds
        """
        return float(np.median([sum(found[stage] for stage in stages or found) for found in self.spent]))


def break_down(
    work: Mapping[str, tuple[list[Stage], Callable[[], object]]], rounds: int, now: Callable[[], float]
) -> dict[str, Breakdown]:
    """
    :param work: what is compared: stages, and what is called once per round, in turns
    :param rounds: number of rounds
    :param now: gives seconds
    """
    watches = {name: Stopwatch(now) for name in work}
    spent: dict[str, list[dict[str, float]]] = {name: [] for name in work}
    for _ in range(rounds):
        for name, (stages, call) in work.items():
            spent[name].append(watches[name].measure(stages, call))
    return {
        name: Breakdown(spent[name], {stage: count / rounds for stage, count in watches[name].calls.items()}) for name in work
    }
