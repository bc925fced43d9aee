"""
The benchmark: ``sb3-eqr benchmark`` trains, evaluates and reports (docs/benchmark.md), ``load_reference`` loads published
scores, ``load_scores`` those of a benchmark.

``__main__`` parses the command line. For ``run``, ``suites`` and ``agents`` look up the names, ``runs`` plans a folder per
run, ``dispatch`` executes the runs in processes and ``cluster`` on Ray, ``training`` executes one, with ``evaluation``. For
``report``, ``packed`` reads the runs, ``scores`` their scores, ``selection`` and ``comparison`` choose what to compare,
``reference`` adds published scores, ``statistics`` and ``analysis`` compute the results and put them into words, ``tables``,
``figures`` and ``report`` write them.
"""

import importlib
from typing import Any

__all__ = ["load_reference", "load_scores"]

_MODULES = {"load_reference": "reference", "load_scores": "scores"}


def __getattr__(name: str) -> Any:  # imported on use: load_reference works without RL Zoo
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
