"""Stress tests of the package: they kill it, pass wrong and hostile input, and fill its disk."""

import pathlib
from typing import Any, NamedTuple

import torch as th

from sb3_eqr import EqRQRDQN, ExactCheckpointCallback
from sb3_eqr.common.saving.checkpoints import find_checkpoints


class Finding(NamedTuple):
    """A row of the table: what was done, what must happen, what happened, and the failures, a line each."""

    test: str
    must: str
    found: str
    details: list[str]

    @property
    def holds(self) -> bool:
        """Whether the requirement is met."""
        return not self.details


def make(agent: type = EqRQRDQN, env: Any = "CartPole-v1", policy: str = "MlpPolicy", **kwargs: Any) -> Any:
    """Create a small agent."""
    policy_kwargs = {"n_blocks": 2, "net_arch": [8], "latent_hidden_dim": 8, **kwargs.pop("policy_kwargs", {})}
    return agent(policy, env, **{"buffer_size": 500, "learning_starts": 20, **kwargs}, policy_kwargs=policy_kwargs)


def finish(folder: pathlib.Path, env: Any, steps: int, save_freq: int, agent: Any = EqRQRDQN, **kwargs: Any) -> Any:
    """Start a run, or resume it from its last checkpoint in the folder, and finish it."""
    th.set_num_threads(1)
    model = agent.resume(folder, env) if find_checkpoints(folder) else make(agent, env, **kwargs)
    if model.num_timesteps < steps:
        callback = ExactCheckpointCallback(save_freq, folder)
        model.learn(steps - model.num_timesteps, callback, reset_num_timesteps=False)
    return model


def are_equal(state: dict[str, th.Tensor], other: dict[str, th.Tensor]) -> bool:
    """Whether two state dicts are bit-identical."""
    return all(th.equal(value, other[name]) for name, value in state.items())


def partial_files(folder: pathlib.Path) -> list[str]:
    """Files that were not completed: their names begin with a dot."""
    return [str(path) for path in folder.rglob(".*")]
