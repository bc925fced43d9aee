"""
Measuring EqR, and comparing it: ``sb3-eqr benchmark`` trains, evaluates and reports (docs/benchmark.md), ``load_reference``
has published scores, ``load_scores`` those of a benchmark.

``__main__`` reads a command. To run: ``suites`` and ``agents`` find what it names, ``runs`` plans a folder for each run,
``dispatch`` hands them to Ray, ``training`` does one, with ``evaluation``. To report: ``scores`` reads what the runs wrote,
``selection`` and ``comparison`` choose what can stand side by side, with ``reference`` for published scores, ``statistics``
and ``analysis`` compute and say what it shows, ``tables``, ``figures`` and ``report`` write it.
"""

import importlib
from typing import Any

__all__ = ["load_reference", "load_scores"]

_MODULES = {"load_reference": "reference", "load_scores": "scores"}


def __getattr__(name: str) -> Any:  # later: load_reference needs no RL Zoo
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
