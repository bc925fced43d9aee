"""Agents of a benchmark by name: an algorithm of RL Zoo and the file of hyperparameters that it uses."""

import inspect
import pathlib
from typing import Any, NamedTuple

import rl_zoo3
from gymnasium import spaces
from rl_zoo3.utils import ALGOS

from sb3_eqr.benchmark.suites import nearest_name
from sb3_eqr.configurations import STOCK, configuration_files
from sb3_eqr.zoo import AGENTS, register
from sb3_eqr.zoo.entries import check_entry, find_entry, read_entry

WORLD = ("env_wrapper", "frame_stack", "env_kwargs", "vec_env_wrapper")  # keys of entries that change what is played
CONTINUOUS = ("ddpg", "td3", "sac", "tqc", "crossq")  # algorithms that take no discrete actions
DISCRETE = ("dqn", "qrdqn", *AGENTS)  # algorithms that take no others


class Agent(NamedTuple):
    """
    :param name: as in tables: "qrdqn", "qrdqn:stock", "eqr_rainbow:se2+aet"
    :param algo: RL Zoo's name of the algorithm
    :param file: of hyperparameters
    """

    name: str
    algo: str
    file: pathlib.Path


def find_agent(text: str) -> Agent:
    """
    :param text: ALGO or ALGO:ENTRIES. ALGO alone has RL Zoo's hyperparameters for a stock algorithm and ours for an EqR agent.
        ENTRIES is "stock" (zoo_hyperparams/stock), the name of one of our files or the beginning of exactly one such name
        ("mlp" for "mlp+aet+r"), or the path of a YAML file
    :raises ValueError: for an algorithm or a file that there is not, with the nearest name
    """
    register()
    algo, _, entries = text.partition(":")
    if algo not in ALGOS:
        raise ValueError(f"--agents: {algo!r} is no algorithm.{nearest_name(algo, ALGOS)}")
    files = configuration_files()
    if not entries:
        own = files[algo] if algo in AGENTS else pathlib.Path(rl_zoo3.__file__).parent / "hyperparams" / f"{algo}.yml"
        return Agent(algo, algo, own)
    if entries.endswith((".yml", ".yaml")):
        if not pathlib.Path(entries).is_file():
            raise ValueError(f"--agents: {text!r}: there is no file {entries}")
        return Agent(f"{algo}:{pathlib.Path(entries).stem}", algo, pathlib.Path(entries).resolve())
    name = f"{STOCK}/{algo}" if entries == STOCK else entries
    legal = [key for key in files if key not in AGENTS and not key.startswith(f"{STOCK}/")]
    longer = [key for key in legal if key.startswith(entries)]
    if name not in files and len(longer) == 1:
        entries = name = longer[0]
    if name not in files and longer:
        raise ValueError(
            f"--agents: {text!r}: expected the beginning of one name, found {', '.join(sorted(longer))}. Write one of them."
        )
    if name not in files:
        legal += [STOCK] if f"{STOCK}/{algo}" in files else []
        raise ValueError(f"--agents: {text!r}: there are no such hyperparameters.{nearest_name(entries, legal)}")
    return Agent(f"{algo}:{entries}", algo, files[name])


def hyperparameters(agent: Agent, protocol: dict[str, Any], action_space: spaces.Space) -> dict[str, Any]:
    """
    The agent's entry for a game, checked; leaves with a message if there is none or it has a mistake.

    :param agent: the agent
    :param protocol: of :meth:`~sb3_eqr.benchmark.suites.Suite.protocol`; its preprocessing stands before the entry's
    :param action_space: of the game
    :return: the entry as it is written, with the steps, and no larger replay buffer than these can fill
    :raises ValueError: if the agent cannot play this game, or plays another one than the suite says
    """
    steps, env_id, preprocessing = protocol["steps"], protocol["env_id"], protocol["preprocessing"]
    changes = {**preprocessing, "n_timesteps": steps}
    entry = find_entry(str(agent.file), env_id, changes)
    check_entry(read_entry(str(agent.file), env_id, changes), agent.algo, str(agent.file))
    where = f"{agent.name}, {env_id}"
    if own := [key for key in WORLD if entry.get(key) is not None and key not in preprocessing]:
        raise ValueError(
            f"{where}: expected the suite's game, found an entry with its own {', '.join(own)}. "
            "All agents must play the same: name it under preprocessing in the suite (null for none)."
        )
    kind = "discrete" if isinstance(action_space, spaces.Discrete) else "continuous"
    if agent.algo in (CONTINUOUS if kind == "discrete" else DISCRETE):
        raise ValueError(f"{where}: expected a game that {agent.algo} can play, found {kind} actions. Leave the agent out.")
    if steps % entry.get("n_envs", 1):
        raise ValueError(f"{where}: expected steps in whole rounds of its {entry['n_envs']} environments, found {steps} steps")
    default = inspect.signature(ALGOS[agent.algo]).parameters.get("buffer_size")
    if default is not None:
        entry["buffer_size"] = min(entry.get("buffer_size", default.default), max(steps, 1_000))
    return entry
