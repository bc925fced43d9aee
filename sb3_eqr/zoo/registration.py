"""Register the agents with RL Zoo."""

from functools import partial
from typing import Any

from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS

from sb3_eqr import AGENTS, envs
from sb3_eqr.zoo.search import convert_eqr_params, make_sampler


def register(policy_kwargs: dict[str, Any] | None = None) -> None:
    """
    Register the agents and their search spaces with RL Zoo, and the package's environments with gymnasium.

    :param policy_kwargs: ``policy_kwargs`` that a search does not change
    """
    ALGOS.update(AGENTS)  # type: ignore[arg-type]
    kept = policy_kwargs or {}
    for name in AGENTS:
        HYPERPARAMS_SAMPLER[name] = make_sampler(name == "eqr_rainbow", kept)
        HYPERPARAMS_CONVERTER[name] = partial(convert_eqr_params, kept=kept)  # type: ignore[assignment]
    envs.register()


def trust_files(algo: str) -> None:
    """Make RL Zoo, which cannot pass ``trust``, load the files of an agent with it: its own classes are then imported."""
    kind = AGENTS[algo]

    class Trusting(kind):  # type: ignore[valid-type, misc]
        @classmethod
        def load(cls, *args: Any, **kwargs: Any) -> Any:
            return super().load(*args, **{**kwargs, "trust": True})

    Trusting.__name__ = kind.__name__  # saved with its files
    ALGOS[algo] = Trusting
