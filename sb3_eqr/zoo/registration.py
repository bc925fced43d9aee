"""Register the agents with RL Zoo, and the search space of ``-optimize``."""

from collections.abc import Callable
from functools import partial
from typing import Any

from optuna.trial import FixedTrial
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS

from sb3_eqr import AGENTS, CONTINUOUS, DISCRETE

LATENT_SPACE: dict[str, list[Any]] = {
    "prediction_depth": [1, 2, 3, 5],
    "aet_coef": [0.1, 0.3, 1.0],
    "reward_coef": [0.0, 0.3, 1.0],
    "group": ["SE(2)", "SO(3)", "GL(2)", "T(72)^1"],
}
NET_ARCHS = {"small": [64, 64], "medium": [256, 256], "one": [256]}


def sample_eqr_params(
    trial: Any, n_actions: int, n_envs: int, additional_args: dict[str, Any], *, categorical: bool, kept: dict[str, Any]
) -> dict[str, Any]:
    """
    Sample as RL Zoo does: group, blocks, depth, the three coefficients, learning rate, n-step, replay ratio.

    :param categorical: whether to search the range of returns as well
    :param kept: ``policy_kwargs`` that are not searched
    :return: keyword arguments of the agent
    """
    sampled = {
        "learning_rate": trial.suggest_float("learning_rate", 2e-4, 3e-3, log=True),
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.003, 0.03, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 5, 6),
        "train_freq_pow": trial.suggest_int("train_freq_pow", 0, 8),
        "replay_ratio": trial.suggest_categorical("replay_ratio", [0.25, 0.5, 1.0]),
        "n_steps": trial.suggest_int("n_steps", 1, 8),
        "prediction_depth": trial.suggest_int("prediction_depth", 1, 5),
        "aet_coef": trial.suggest_categorical("aet_coef", [0.0, 0.1, 0.3, 1.0]),
        "symmetry_coef": trial.suggest_categorical("symmetry_coef", [0.0, 0.1, 0.3, 1.0]),
        "reward_coef": trial.suggest_categorical("reward_coef", [0.0, 0.1, 0.3, 1.0]),
        "target_update_interval": trial.suggest_int("target_update_interval", 100, 2_000, log=True),
        "exploration_fraction": trial.suggest_float("exploration_fraction", 0.05, 0.3),
        "exploration_final_eps": trial.suggest_float("exploration_final_eps", 0.01, 0.1),
        "group": trial.suggest_categorical("group", ["SE(2)", "SO(3)", "GL(2)", "T(2)"]),
        "n_blocks": trial.suggest_int("n_blocks", 2, 16),
        "net_arch": trial.suggest_categorical("net_arch", list(NET_ARCHS)),
        "noisy": trial.suggest_categorical("noisy", [False, True]),
    }
    batch_size, train_freq = 2 ** sampled.pop("batch_size_pow"), 2 ** sampled.pop("train_freq_pow")
    policy_kwargs = {**kept, **{name: sampled.pop(name) for name in ("group", "n_blocks", "net_arch", "noisy")}}
    policy_kwargs["net_arch"] = NET_ARCHS[policy_kwargs["net_arch"]]
    if categorical:
        v_max = float(trial.suggest_categorical("return_range", [10, 30, 100, 200, 400]))
        policy_kwargs |= {"v_min": -v_max, "v_max": v_max}
    return {
        "gamma": 1 - sampled.pop("one_minus_gamma"),
        "batch_size": batch_size,
        "train_freq": train_freq,
        "gradient_steps": max(round(train_freq * sampled.pop("replay_ratio")), 1),
        **sampled,
        "policy_kwargs": policy_kwargs,
    }


def sample_actor_critic_params(
    trial: Any, n_actions: int, n_envs: int, additional_args: dict[str, Any], *, stock: str, kept: dict[str, Any]
) -> dict[str, Any]:
    """Sample as RL Zoo does for the ``stock`` algorithm, and the latent model's group, depth and coefficients."""
    found = HYPERPARAMS_SAMPLER[stock](trial, n_actions, n_envs, additional_args)
    own = {name: trial.suggest_categorical(name, values) for name, values in LATENT_SPACE.items()}
    policy_kwargs = {**kept, **found["policy_kwargs"], "group": own.pop("group")}
    if "^" in policy_kwargs["group"]:  # which has its number of blocks
        policy_kwargs.pop("n_blocks", None)
    return {**found, **own, "policy_kwargs": policy_kwargs}


def convert(sampled: dict[str, Any], sampler: Callable[..., dict[str, Any]]) -> dict[str, Any]:
    """The keyword arguments that ``sampler`` returned for the trial whose parameters are ``sampled``."""
    return sampler(FixedTrial(sampled), 1, 1, {"using_her_replay_buffer": False})


def register(policy_kwargs: dict[str, Any] | None = None) -> None:
    """
    Register the agents and their search spaces with RL Zoo.

    :param policy_kwargs: ``policy_kwargs`` that a search does not change
    """
    ALGOS.update(AGENTS)  # type: ignore[arg-type]
    kept = policy_kwargs or {}
    samplers = {name: partial(sample_eqr_params, categorical=name == "eqr_rainbow", kept=kept) for name in DISCRETE}
    for name in CONTINUOUS:
        samplers[name] = partial(sample_actor_critic_params, stock=name.removeprefix("eqr_"), kept=kept)
    for name, sampler in samplers.items():
        HYPERPARAMS_SAMPLER[name] = sampler  # type: ignore[assignment]
        HYPERPARAMS_CONVERTER[name] = partial(convert, sampler=sampler)  # type: ignore[assignment]


def trust_files(algo: str) -> None:
    """Make RL Zoo, which cannot pass ``trust``, load the files of an agent with it: its own classes are then imported."""
    kind = AGENTS[algo]
    load = partial(kind.load, trust=True)
    ALGOS[algo] = type(kind.__name__, (kind,), {"load": staticmethod(load)})  # files hold the name
