"""Timing in turns: whatever slows the machine for a while slows all that is compared."""

import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch as th

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]


class Series(NamedTuple):
    """What one of the things compared took, round by round."""

    ms: np.ndarray  # milliseconds, (rounds,)
    faults: np.ndarray | None  # page faults, (rounds,); None where they cannot be counted

    @property
    def median(self) -> float:
        """Milliseconds."""
        return float(np.median(self.ms))

    @property
    def best(self) -> float:
        """Milliseconds."""
        return float(self.ms.min())

    @property
    def median_faults(self) -> float | None:
        """Page faults."""
        return None if self.faults is None else float(np.median(self.faults))

    def ratio(self, other: "Series") -> float:
        """
        :return: median of the ratios within a round
        """
        return float(np.median(self.ms / other.ms))

    def beyond(self, other: "Series") -> float:
        """
        :return: median of the differences within a round, milliseconds
        """
        return float(np.median(self.ms - other.ms))


def now(device: str = "cpu") -> float:
    """
    :param device: of the work to be timed; what a GPU was asked for is done before the clock is read
    :return: seconds
    """
    if device != "cpu":
        th.cuda.synchronize(device)
    return time.perf_counter()


def page_faults(device: str = "cpu") -> int | None:
    """
    :return: how many pages the process has been given so far, without reading a disk
    """
    if resource is None or device != "cpu":
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt


def take_turns(
    calls: Mapping[str, Callable[[], object]], rounds: int, n_per_call: int = 1, device: str = "cpu"
) -> dict[str, Series]:
    """
    :param calls: what is compared; each is called once per round
    :param rounds: number of rounds, after one that does not count
    :param n_per_call: how many steps, draws, ... one call does: the series are per step
    :param device: where the work is done
    """
    ms: dict[str, list[float]] = {name: [] for name in calls}
    faults: dict[str, list[int]] = {name: [] for name in calls}
    for call in calls.values():
        call()
    for _ in range(rounds):
        for name, call in calls.items():
            faults_before, start = page_faults(device), now(device)
            call()
            ms[name].append((now(device) - start) * 1e3)
            faults_after = page_faults(device)
            if faults_before is not None and faults_after is not None:
                faults[name].append(faults_after - faults_before)
    return {
        name: Series(np.array(ms[name]) / n_per_call, np.array(faults[name]) / n_per_call if faults[name] else None)
        for name in calls
    }
