"""
Measuring EqR, and comparing it: ``sb3-eqr benchmark`` trains, evaluates and reports (docs/benchmark.md), ``load_reference``
has published scores, ``load_scores`` those of a benchmark.
"""

import importlib
from typing import Any

__all__ = ["load_reference", "load_scores"]

_MODULES = {"load_reference": "reference", "load_scores": "scores"}


def __getattr__(name: str) -> Any:  # later: load_reference needs no RL Zoo
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
