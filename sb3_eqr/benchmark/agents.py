"""Agents of a benchmark by name: an algorithm of RL Zoo and the file of hyperparameters that it uses."""

import pathlib
from typing import Any, NamedTuple

import rl_zoo3
from rl_zoo3.utils import ALGOS

from sb3_eqr.benchmark.suites import nearest
from sb3_eqr.configurations import STOCK, configuration_files
from sb3_eqr.zoo import AGENTS, register
from sb3_eqr.zoo.entries import check_entry, read_entry


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
        raise ValueError(f"--agents: {algo!r} is no algorithm.{nearest(algo, ALGOS)}")
    files = configuration_files()
    if not entries:
        own = files[algo] if algo in AGENTS else pathlib.Path(rl_zoo3.__file__).parent / "hyperparams" / f"{algo}.yml"
        return Agent(algo, algo, own)
    if entries.endswith((".yml", ".yaml")):
        return Agent(f"{algo}:{pathlib.Path(entries).stem}", algo, pathlib.Path(entries).resolve())
    name = f"{STOCK}/{algo}" if entries == STOCK else entries
    legal = [key for key in files if key not in AGENTS and not key.startswith(f"{STOCK}/")]
    longer = [key for key in legal if key.startswith(entries)]
    if name not in files and len(longer) == 1:
        entries = name = longer[0]
    if name not in files:
        raise ValueError(f"--agents: {text!r}: there are no hyperparameters {entries!r}.{nearest(entries, [*legal, STOCK])}")
    return Agent(f"{algo}:{entries}", algo, files[name])


def hyperparameters(agent: Agent, protocol: dict[str, Any]) -> dict[str, Any]:
    """
    The agent's entry for the game, checked; leaves with a message if there is none or it has a mistake.

    :param agent: the agent
    :param protocol: of :meth:`~sb3_eqr.benchmark.suites.Suite.protocol`; its preprocessing stands before the entry's
    """
    changes = {**protocol["preprocessing"], "n_timesteps": protocol["steps"]}
    entry = read_entry(str(agent.file), protocol["env_id"], changes)
    check_entry(entry, agent.algo, str(agent.file))
    return entry
