"""Steps of the environment: in collection, and in evaluation."""

import importlib.util
from functools import partial
from typing import Any

import numpy as np
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecFrameStack

from sb3_eqr.benchmark.speed.clock import now
from sb3_eqr.benchmark.speed.stopwatch import Breakdown, Stage, break_down
from sb3_eqr.benchmark.speed.tables import Table
from sb3_eqr.benchmark.speed.workload import AGENTS, EQR_AGENTS, STOCK_QRDQN, close, make_agent, make_env, play
from sb3_eqr.envs import make_atari100k_env

GAME = "Pong"
COLLECTION_STEPS = 300  # of each agent in a round
COLLECTION_ROUNDS = 5  # at most
EVALUATION_ROUNDS = 3  # at most
EPISODES, ONE_BY_ONE = 100, 5  # of our evaluation, and of evaluate_policy's: rates are compared
MAX_STEPS = 1_000  # of a game: whole ones of an agent that loses last about as long
EMULATOR = "emulator"


def lacks(*modules: str) -> list[str]:
    """
    :return: those that are not installed
    """
    return [name for name in modules if importlib.util.find_spec(name) is None]


def measure_collection(rounds: int, device: str) -> list[Table]:
    """
    :param rounds: in which the agents take turns
    :param device: of the agents
    :return: a table on random frames and, with ale-py, one on Pong
    """
    rounds = min(rounds, COLLECTION_ROUNDS)
    models = {name: make_agent(name, make_env(), device) for name in AGENTS}
    tables = [_collection_table("collection_random_frames", "random frames", models, FakeImageEnv, rounds, device)]
    title = f"Collection, {GAME}"
    if missing := lacks("ale_py", "cv2"):
        return [*tables, Table("collection_atari", title, {}, [], [f"left out: {', '.join(missing)} not installed"])]
    from ale_py.env import AtariEnv

    models = {name: make_agent(name, make_atari100k_env(GAME, seed=0), device) for name in (STOCK_QRDQN, *EQR_AGENTS)}
    return [*tables, _collection_table("collection_atari", GAME, models, AtariEnv, rounds, device)]


def collection_stages(model: OffPolicyAlgorithm, game: type) -> list[Stage]:
    """
    :param model: the agent
    :param game: class of the innermost environment
    """
    return [
        Stage(EMULATOR, game, "step"),
        Stage(EMULATOR, game, "reset"),
        Stage("wrappers", model.env, "step"),
        Stage("acting", model, "_sample_action"),
        Stage("storing", model, "_store_transition"),
    ]


def _collection_table(
    name: str, world: str, models: dict[str, OffPolicyAlgorithm], game: type, rounds: int, device: str
) -> Table:
    work = {agent: (collection_stages(model, game), partial(play, model, COLLECTION_STEPS)) for agent, model in models.items()}
    for model in models.values():
        play(model, COLLECTION_STEPS // 4)
    found = break_down(work, rounds, partial(now, device))
    for model in models.values():
        close(model)
    rows = [{"name": agent, **_collection_row(breakdown)} for agent, breakdown in found.items()]
    formats = {"name": "", "steps_per_second": ",.0f", **{key: ".2f" for key in rows[0] if key.startswith("ms")}}
    notes = ["ms per environment step of one environment; on top: everything but the emulator, which is " + game.__name__]
    return Table(name, f"Collection, {world}: acting and storing, no gradient steps", formats, rows, notes)


def _collection_row(breakdown: Breakdown) -> dict[str, float]:
    def per_step(*stages: str) -> float:
        return breakdown.median(*stages) * 1e3 / COLLECTION_STEPS

    on_top = [stage for stage in breakdown.spent[0] if stage != EMULATOR]
    return {
        "steps_per_second": 1e3 / per_step(),
        "ms": per_step(),
        **{f"ms_{stage}": per_step(stage) for stage in breakdown.spent[0]},
        "ms_on_top": per_step(*on_top),
    }


def measure_evaluation(rounds: int, device: str) -> list[Table]:
    """
    :param rounds: in which the two ways take turns
    :param device: of the agent
    :return: one table: the benchmark's evaluation beside SB3's on one environment
    """
    title = f"Evaluation, {GAME}, games of {MAX_STEPS} steps"
    if missing := lacks("ale_py", "cv2", "rl_zoo3", "pandas"):
        return [Table("evaluation", title, {}, [], [f"left out: {', '.join(missing)} not installed"])]
    from sb3_eqr.benchmark.suites import load_suite

    protocol: dict[str, Any] = load_suite("atari100k").protocol(GAME)
    protocol["evaluation"] = {**protocol["evaluation"], "max_steps": MAX_STEPS}
    model = make_agent(EQR_AGENTS[0], make_atari100k_env(GAME, seed=0), device)
    ways = {
        f"evaluate_policy, 1 environment, {ONE_BY_ONE} games": partial(_one_by_one, model, protocol),
        f"benchmark's evaluate, {EPISODES} games": partial(_in_a_batch, model, protocol),
    }
    rates: dict[str, list[float]] = {way: [] for way in ways}
    for _ in range(min(rounds, EVALUATION_ROUNDS)):
        for way, steps_of in ways.items():
            start = now(device)
            n_steps = steps_of()
            rates[way].append(n_steps / (now(device) - start))
    close(model)
    slow = np.array(next(iter(rates.values())))
    rows = [
        {"name": way, "steps_per_second": float(np.median(found)), "ratio": float(np.median(np.array(found) / slow))}
        for way, found in rates.items()
    ]
    notes = ["making the environments is part of it; the emulator may use threads of its own"]
    return [Table("evaluation", title, {"name": "", "steps_per_second": ",.0f", "ratio": ".2f"}, rows, notes)]


def _in_a_batch(model: OffPolicyAlgorithm, protocol: dict[str, Any]) -> int:
    from sb3_eqr.benchmark.evaluation import evaluate

    _, lengths = evaluate(model, protocol, EPISODES, 0)
    return sum(lengths)


def _one_by_one(model: OffPolicyAlgorithm, protocol: dict[str, Any]) -> int:
    """SB3's way: one environment, the whole stack of wrappers, greedy actions."""
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    from sb3_eqr.benchmark.evaluation import make_game, preprocessing_of

    env = VecFrameStack(
        make_vec_env(make_game, seed=0, env_kwargs={"protocol": protocol}), preprocessing_of(protocol)["frame_stack"]
    )
    _, lengths = evaluate_policy(model, env, ONE_BY_ONE, return_episode_rewards=True, warn=False)
    env.close()
    assert isinstance(lengths, list)
    return sum(lengths)
