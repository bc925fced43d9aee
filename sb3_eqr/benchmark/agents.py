"""Agents of a benchmark by name: an algorithm of RL Zoo and the file of hyperparameters that it uses."""

import pathlib
import re
from typing import Any, NamedTuple

import rl_zoo3
from gymnasium import spaces
from rl_zoo3.utils import ALGOS

import sb3_eqr
from sb3_eqr.benchmark.suites import nearest_name
from sb3_eqr.common.checks.arguments import parameters_of
from sb3_eqr.configurations import STOCK, configuration_files, merged
from sb3_eqr.zoo import AGENTS, register
from sb3_eqr.zoo.entries import check_entry, find_entry, read_entry, read_yaml

WORLD = ("env_wrapper", "frame_stack", "env_kwargs", "vec_env_wrapper")  # keys of entries that change the environment
OFF = "off"
CONTINUOUS = ("ddpg", "td3", "sac", "tqc", "crossq", *sb3_eqr.CONTINUOUS)  # algorithms without support for discrete actions
DISCRETE = ("dqn", "qrdqn", *sb3_eqr.DISCRETE)  # algorithms that support discrete actions only
PLAIN = (bool, int, float, str, tuple, list, dict, type(None))
UNRELATED = ("_init_setup_model", "device", "policy_kwargs", "seed", "tensorboard_log", "verbose")  # not to the scores


class Agent(NamedTuple):
    """An algorithm of RL Zoo with its hyperparameters."""

    name: str  # in tables: "qrdqn", "qrdqn:stock", "eqr_rainbow:se2+aet"
    algo: str
    file: pathlib.Path  # of hyperparameters
    changes: dict[str, Any] = {}  # they override those of the file; dictionaries are merged


def find_agent(text: str) -> Agent:
    """
    :param text: ALGO or ALGO:ENTRIES. ALGO alone uses RL Zoo's hyperparameters for a stock algorithm, ours for an EqR agent.
        ENTRIES is "stock" (zoo_hyperparams/stock), "off" (an EqR agent without group and auxiliary losses), the name of one
        of our files, or the path of a YAML file with entries,
        or with ``base``, the ENTRIES or file to start from, and ``changes``; FILE:NAME is one of several of these in a file
    :raises ValueError: for an unknown algorithm or file, with the nearest name
    """
    register()
    algo, _, entries = text.partition(":")
    if algo not in ALGOS:
        raise ValueError(f"--agents: there is no algorithm {algo!r}.{nearest_name(algo, ALGOS)}")
    files = configuration_files()
    if not entries:
        theirs = pathlib.Path(rl_zoo3.__file__).parent / "hyperparams" / f"{algo}.yml"
        return Agent(algo, algo, files[algo] if algo in AGENTS else theirs)
    if entries == OFF and algo in AGENTS:
        without = {"group": None} if algo in sb3_eqr.DISCRETE else {"head_input": "observation"}
        return Agent(text, algo, files[algo], {"prediction_depth": 0, "policy_kwargs": without})
    if match := re.fullmatch(r"(.+\.ya?ml)(?::(.+))?", entries):
        if not pathlib.Path(match[1]).is_file():
            raise ValueError(f"--agents: {text!r}: there is no file {match[1]}")
        return _agent_of_file(algo, pathlib.Path(match[1]).resolve(), match[2])
    named = {key.removesuffix(f"/{algo}"): file for key, file in files.items() if "/" not in key or key == f"{STOCK}/{algo}"}
    if entries not in named:
        ours = [*(key for key in named.keys() - AGENTS.keys() if key != STOCK), OFF] if algo in AGENTS else []
        legal = [*ours, *({STOCK} & named.keys())]
        choices = nearest_name(entries, legal) if legal else f" Use {algo!r} alone, or a YAML file."
        raise ValueError(f"--agents: {text!r}: there are no hyperparameters {entries!r}.{choices}")
    return Agent(text, algo, named[entries])


def _agent_of_file(algo: str, file: pathlib.Path, name: str | None = None) -> Agent:
    """
    The agent of a YAML file: entries, or ``base``, the ENTRIES or file to start from, and ``changes`` of all entries; ``name``
    is that of one of several such pairs in the file.
    """
    found = read_yaml(file, "--agents: ")
    if name is not None:
        if name not in found:
            raise ValueError(f"--agents: {file} has no agent {name!r}.{nearest_name(name, map(str, found))}")
        if "/" in name or "\\" in name:
            raise ValueError(f"--agents: an agent's name must have no slashes, as it names a folder, got {name!r}.")
        found = found[name]
    label = f"{algo}:{name or file.stem}"
    if not isinstance(found, dict) or "base" not in found or found.keys() - {"base", "changes"}:
        if name is not None:
            raise ValueError(f"--agents: {file}: {name!r} must be a mapping with base and changes, got {found!r:.60}.")
        return Agent(label, algo, file)
    start = OFF if found["base"] is False else str(found["base"])  # YAML reads off as False
    changes = found.get("changes") or {}
    if not isinstance(changes, dict):
        raise ValueError(f"--agents: {file}: changes must be a mapping, got {changes!r:.60}.")
    beside, _, of_several = start.partition(":")
    if (file.parent / beside).is_file():
        if (file.parent / beside).resolve() == file and (of_several or None) == name:
            raise ValueError(f"--agents: {file}: base must be another agent, got this one.")
        base = _agent_of_file(algo, (file.parent / beside).resolve(), of_several or None)
    else:
        base = find_agent(f"{algo}:{start}")
    return Agent(label, algo, base.file, merged(base.changes, changes))


def defaults(agent: Agent, entry: dict[str, Any]) -> dict[str, Any]:
    """
    :return: the defaults of the algorithm for what the entry leaves out, and of its policy, as far as they are plain data:
        where they change between versions, the same entry makes another agent
    """
    algorithm = ALGOS[agent.algo]
    policy = algorithm.policy_aliases.get(entry.get("policy", ""))
    own, of_policy = (
        {name: p.default for name, p in parameters_of(kind).items() if isinstance(p.default, PLAIN)} if kind else {}
        for kind in (algorithm, policy)
    )
    return {**{key: own[key] for key in own if key not in entry and key not in UNRELATED}, "policy_kwargs": of_policy}


def hyperparameters(agent: Agent, protocol: dict[str, Any], action_space: spaces.Space) -> dict[str, Any]:
    """
    The agent's entry for a game, checked; exits with a message if it is missing or invalid.

    :param protocol: see :meth:`~sb3_eqr.benchmark.suites.Suite.protocol`; its preprocessing overrides the entry's
    :return: the entry as in the file, with the suite's steps, and a replay buffer no larger than these steps can fill
    :raises ValueError: if the agent does not support the game's actions, or its entry changes the environment
    """
    steps, env_id, preprocessing = protocol["steps"], protocol["env_id"], protocol["preprocessing"]
    changes = {**preprocessing, "n_timesteps": steps}
    written, where = find_entry(str(agent.file), env_id, changes), f"{agent.name}, {env_id}"
    if isinstance(written.get("policy_kwargs"), str) and "policy_kwargs" in agent.changes:
        raise ValueError(
            f"{where}: policy_kwargs must be a mapping in {agent.file.name}, so that changes can be merged into it, got text. "
            "Copy the section into a file of your own."
        )
    entry = merged(written, agent.changes)
    check_entry(merged(read_entry(str(agent.file), env_id, changes), agent.changes), agent.algo, str(agent.file))
    if own := [key for key in WORLD if entry.get(key) is not None and (key not in preprocessing or key in agent.changes)]:
        raise ValueError(
            f"{where}: the section must not change the suite's environment, got its own {', '.join(own)}. "
            "Set it under preprocessing in the suite (null for none), so that all agents have the same environment."
        )
    kind = "discrete" if isinstance(action_space, spaces.Discrete) else "continuous"
    if agent.algo in (CONTINUOUS if kind == "discrete" else DISCRETE):
        raise ValueError(f"{where}: {agent.algo} does not support {kind} actions. Leave the agent out.")
    if steps % entry.get("n_envs", 1):
        raise ValueError(f"{where}: steps must be a multiple of n_envs = {entry['n_envs']}, got {steps}.")
    default = parameters_of(ALGOS[agent.algo]).get("buffer_size")
    if default is not None:
        entry["buffer_size"] = min(entry.get("buffer_size", default.default), max(steps, 1_000))
    return entry
