"""
Visualise what an agent has learned: ``sb3-eqr visualize MODEL.zip`` writes metrics and figures (docs/latent_states.md),
``diagnose`` computes the metrics, ``LatentCallback`` logs them during training, ``record`` writes a video. Needs
``pip install ".[visualize]"`` in a clone of the repository.

``__main__`` parses the command line, ``loading`` loads model and environment, ``trust`` checks files from others. ``latents``
runs the agent and encodes, ``measures`` and ``findings`` compute, ``diagnostics`` collects the metrics and the verdict;
``tables`` and ``pictures`` write them, ``film`` makes videos. ``callback`` is for use during training.
"""

import importlib
from typing import Any

_MODULES = {"Diagnostics": "diagnostics", "LatentCallback": "callback", "diagnose": "diagnostics"}
_MODULES |= {"play": "latents", "record": "film"}
__all__ = ["Diagnostics", "LatentCallback", "diagnose", "play", "record"]


def __getattr__(name: str) -> Any:  # imported on use: the metrics need neither matplotlib nor imageio
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    except ImportError as error:
        raise ImportError(f'{error}. Run pip install ".[visualize]" in a clone of the repository.') from error
