"""
Seeing what an agent has learned: ``sb3-eqr visualize MODEL.zip`` writes numbers and pictures (docs/visualize.md), ``diagnose``
gives the numbers, ``LatentCallback`` logs them in training, ``record`` films it. Needs ``pip install ".[visualize]"``
in a clone of the repository.

``__main__`` reads the command, ``loading`` finds model and environment, with ``trust`` for files of others. ``latents`` plays
and encodes, ``measures`` and ``findings`` compute, ``diagnostics`` has all of it and the verdict; ``tables`` and ``pictures``
write it, with ``latent_figure`` for the states. A film: ``animation`` shoots it, ``pixels`` and ``sketches`` say what is to be
seen, ``canvas`` draws it. ``callback`` does all this in training.
"""

import importlib
from typing import Any

__all__ = ["Diagnostics", "LatentCallback", "diagnose", "play", "record"]

_MODULES = {
    "Diagnostics": "diagnostics",
    "LatentCallback": "callback",
    "diagnose": "diagnostics",
    "play": "latents",
    "record": "animation",
}


def __getattr__(name: str) -> Any:  # later: the numbers need neither matplotlib nor imageio
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
