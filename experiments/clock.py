"""Timing of alternating calls, so that slow periods of the machine affect all of them alike; counting; tables."""

import resource
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch as th
from torch.profiler import ProfilerActivity, profile
from torch.utils.benchmark import timer


class Series(NamedTuple):
    """The cost of one of the calls compared, per round, (rounds,) each."""

    ms: np.ndarray  # milliseconds of wall-clock time
    cpu_ms: np.ndarray  # milliseconds of CPU time, over all threads of this process
    faults: np.ndarray  # page faults

    def ratio(self, other: "Series") -> float:
        """Median of the ratios within a round: of CPU time if PyTorch has one thread, else of wall-clock time."""
        numbers = (self.cpu_ms, other.cpu_ms) if th.get_num_threads() == 1 else (self.ms, other.ms)
        return median(numbers[0] / numbers[1])


def median(numbers: Any) -> float:
    """The median as a Python float, for tables and JSON."""
    return float(np.median(numbers))


def read_clocks() -> np.ndarray:
    """Milliseconds and page faults so far, in the order of ``Series``. PyTorch's timer waits for a GPU first."""
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt  # pages provided without reading a disk
    return np.array([timer() * 1e3, time.process_time() * 1e3, faults])


def take_turns(calls: Mapping[str, Callable[[], object]], rounds: int, n_per_call: int = 1) -> dict[str, Series]:
    """
    :param calls: the calls to compare; each is called once per round
    :param rounds: number of rounds, after a first one that does not count
    :param n_per_call: number of updates, samples, ... per call; the series are per update
    """
    found: dict[str, list[np.ndarray]] = {name: [] for name in calls}
    for _ in range(rounds + 1):
        for name, call in calls.items():
            start = read_clocks()
            call()
            found[name].append((read_clocks() - start) / n_per_call)
    return {name: Series(*np.array(numbers[1:]).T) for name, numbers in found.items()}


def count_operations(call: Callable[[], object]) -> int:
    """Operations that Python and the backward pass launch: the profiler's ``aten::`` events outside other such events."""
    with profile(activities=[ProfilerActivity.CPU]) as profiled:
        call()

    def is_inside(event: Any) -> bool:
        parent = event.cpu_parent
        while parent is not None and not parent.name.startswith("aten::"):
            parent = parent.cpu_parent
        return parent is not None

    return sum(event.name.startswith("aten::") and not is_inside(event) for event in profiled.events())


class Table(NamedTuple):
    """Rows as dictionaries, whose keys are the column names. None is printed as a dash, and a column of None is left out."""

    name: str  # its key in the JSON file
    title: str
    rows: list[dict[str, Any]]
    notes: list[str] = []  # lines below the table

    def text(self) -> str:
        """Title, aligned columns, notes."""
        frame = pd.DataFrame(self.rows).dropna(axis="columns", how="all")
        first = frame.columns[0]
        frame = frame.set_index(first).rename(columns=lambda key: key.replace("_", " "))
        shown = frame.rename_axis(index=None, columns=first).to_string(na_rep="-", float_format=three_digits)
        return "\n".join([self.title, shown, *self.notes])


def three_digits(number: float) -> str:
    """Format with three digits, or with all digits before the decimal point."""
    return f"{number:,.0f}" if abs(number) >= 99.95 else f"{number:#.3g}"
