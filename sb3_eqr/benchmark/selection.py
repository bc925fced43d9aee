"""Which runs of a benchmark can be compared."""

import json
from collections import Counter, defaultdict
from typing import Any

ABSENT = "absent"  # in place of a setting that a file does not have; null may have a meaning of its own
ON_POLICY = ("a2c", "ppo", "ppo_lstm", "trpo")  # RL Zoo's agents that learn after a whole rollout


def flatten(values: Any, prefix: str = "") -> dict[str, Any]:
    """:return: "outer.inner" -> value; empty dictionaries are values"""
    if isinstance(values, dict) and values:
        pairs = [flatten(value, f"{prefix}.{key}" if prefix else str(key)) for key, value in values.items()]
        return {key: value for pair in pairs for key, value in pair.items()}
    return {prefix: values}


def protocol_differences(results: list[dict[str, Any]]) -> dict[str, str]:
    """
    Find runs whose steps, preprocessing or evaluation differ from those of most runs of the same game.

    :return: agent -> what differs, with the games
    """
    found: dict[str, dict[str, dict[str, None]]] = defaultdict(lambda: defaultdict(dict))  # agent -> text -> games
    for game in dict.fromkeys(result["game"] for result in results):
        runs = [result for result in results if result["game"] == game]
        texts = [json.dumps(run["protocol"], sort_keys=True) for run in runs]
        usual = flatten(json.loads(Counter(texts).most_common(1)[0][0]))
        for run in runs:
            own = flatten(run["protocol"])
            for key in sorted(own.keys() | usual.keys()):
                if own.get(key) != usual.get(key):
                    text = f"{key} is {own.get(key, 'absent')}, not {usual.get(key, 'absent')}"
                    found[run["agent"]][text][game] = None
    return {
        agent: "; ".join(f"{text} ({', '.join(games)})" for text, games in differences.items())
        for agent, differences in found.items()
    }


def settings_differences(results: list[dict[str, Any]]) -> list[str]:
    """
    :return: a sentence for every agent whose runs of a game differ in hyperparameters, or in defaults where both have them
    """
    found: dict[str, set[str]] = {}
    first: dict[tuple[str, str], tuple[dict[str, Any], dict[str, Any]]] = {}
    for result in results:
        own = flatten(result["entry"]["hyperparameters"]), flatten(result.get("defaults", {}))
        usual = first.setdefault((result["agent"], result["game"]), own)
        keys = {key for key in own[0].keys() | usual[0].keys() if own[0].get(key, ABSENT) != usual[0].get(key, ABSENT)}
        keys |= {key for key in own[1].keys() & usual[1].keys() if own[1][key] != usual[1][key]}
        if keys:
            found.setdefault(result["agent"], set()).update(keys)
    return [f"{agent}: its runs differ in {', '.join(sorted(keys))}." for agent, keys in found.items()]


def learns_latent_model(result: dict[str, Any]) -> bool:
    """:return: whether the run's agent is one of EqR with a latent model, rather than stock or without EqR"""
    settings = {**result.get("defaults", {}), **result["entry"]["hyperparameters"]}
    return result["entry"]["algo"].startswith("eqr_") and settings.get("prediction_depth") != 0


def never_learn(results: list[dict[str, Any]]) -> list[str]:
    """
    :param results: results of runs, or descriptions of planned runs
    :return: a sentence for every agent whose training ends before its first update
    """
    found: dict[str, dict[str, None]] = defaultdict(dict)
    for result in results:
        entry, steps = result["entry"]["hyperparameters"], result["protocol"]["steps"]
        starts, why = entry.get("learning_starts", 0), ""
        if starts is not None and starts >= steps:  # None: a tenth of the steps or less
            why = f"learning_starts {starts:,}"
        n_steps = {**result.get("defaults", {}), **entry}.get("n_steps", 0)
        if result["entry"]["algo"] in ON_POLICY and (rollout := n_steps * entry.get("n_envs", 1)) > steps:
            why = f"a rollout has {rollout:,}"
        if why:
            found[result["agent"]][f"{result['game']} ({why} of {steps:,} steps)"] = None
    return [f"{agent} makes no update on {', '.join(where)}: it stays untrained." for agent, where in found.items()]


def choose_runs(
    results: list[dict[str, Any]], suite_games: list[str], force: bool
) -> tuple[list[str], dict[str, list[int]], list[str]]:
    """
    Select the games that every agent has runs on, and for each agent the seeds that it has on all of them.

    :param results: results of all finished runs
    :param suite_games: all games, in order
    :param force: continue with the games in common if an agent lacks some games
    :return: games, agent -> seeds, sentences on what is left out
    :raises ValueError: if scores are missing for some games, or if no game, or no seed of an agent, is left
    """
    present: dict[str, dict[str, set[int]]] = defaultdict(lambda: defaultdict(set))
    for result in results:
        present[result["agent"]][result["game"]].add(result["seed"])
    all_games = [*dict.fromkeys([*suite_games, *(result["game"] for result in results)])]
    games = [game for game in all_games if all(game in by_game for by_game in present.values())]
    if not games:
        told = "; ".join(f"{agent} has {', '.join(by_game)}" for agent, by_game in present.items())
        raise ValueError(f"The agents must have at least one game in common, got none: {told}. Select agents with --agents.")
    nobody = [game for game in all_games if not any(game in by_game for by_game in present.values())]
    notes = [f"No finished run of any agent: {', '.join(nobody)}."] if nobody else []
    for agent, by_game in present.items():
        if missing := [game for game in all_games if game not in by_game and game not in nobody]:
            notes.append(f"{agent} has no finished run on {', '.join(missing)}.")
    if notes and not force:
        raise ValueError(
            f"Every agent must have scores for every game, got some missing. {' '.join(notes)} Finish the runs, select "
            "agents with --agents, or pass --force to compare the games that all agents have."
        )
    if len(games) < len(all_games):
        notes.append(f"Only the {len(games)} of {len(all_games)} games that every agent has are compared: {', '.join(games)}.")
    chosen = {}
    for agent, by_game in present.items():
        seeds = {game: by_game[game] for game in games}
        common = set.intersection(*seeds.values())
        if not common:
            told = "; ".join(f"{game}: {_listed(own)}" for game, own in seeds.items())
            raise ValueError(f"{agent} must have a seed finished on every game, got none: {told}. Run the missing ones.")
        lacks = {game: set.union(*seeds.values()) - own for game, own in seeds.items()}
        if fewer := [f"{game} lacks {_listed(missing)}" for game, missing in lacks.items() if missing]:
            notes.append(
                f"{agent} lacks seeds on some games: {'; '.join(fewer)}. Only seeds that it has on every game are compared: "
                f"{_listed(common)}."
            )
        chosen[agent] = sorted(common)
    return games, chosen, notes


def _listed(seeds: set[int]) -> str:
    return ", ".join(map(str, sorted(seeds)))
