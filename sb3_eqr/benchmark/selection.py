"""Which runs of a benchmark can stand side by side."""

import json
from collections import Counter
from collections.abc import Mapping
from typing import Any


def protocol_differences(results: list[dict[str, Any]]) -> dict[str, str]:
    """
    Runs of a game whose steps, preprocessing or evaluation are not those of most of its runs.

    :param results: of runs
    :return: agent -> what differs, with the games
    """
    found: dict[str, dict[str, list[str]]] = {}
    for game in dict.fromkeys(result["game"] for result in results):
        runs = [result for result in results if result["game"] == game]
        texts = [json.dumps(run["protocol"], sort_keys=True) for run in runs]
        usual = flatten(json.loads(Counter(texts).most_common(1)[0][0]))
        for run in runs:
            own = flatten(run["protocol"])
            for key in sorted(own.keys() | usual.keys()):
                if own.get(key) != usual.get(key):
                    text = f"{key} is {_show(own, key)}, not {_show(usual, key)}"
                    games = found.setdefault(run["agent"], {}).setdefault(text, [])
                    games += [game] if game not in games else []
    return {
        agent: "; ".join(f"{text} ({', '.join(games)})" for text, games in differences.items())
        for agent, differences in found.items()
    }


def _show(values: Mapping[str, Any], key: str) -> str:
    return str(values[key]) if key in values else "absent"


def flatten(values: Any, prefix: str = "") -> dict[str, Any]:
    """
    :param values: nested dictionaries and lists
    :return: "outer.inner" -> value; empty dictionaries stand for themselves
    """
    if isinstance(values, dict) and values:
        pairs = [flatten(value, f"{prefix}.{key}" if prefix else str(key)) for key, value in values.items()]
        return {key: value for pair in pairs for key, value in pair.items()}
    return {prefix: values}


def settings_differences(results: list[dict[str, Any]]) -> list[str]:
    """
    :param results: of runs
    :return: a sentence for every agent whose runs of a game have not all the same hyperparameters
    """
    found: dict[str, dict[str, None]] = {}
    first: dict[tuple[str, str], dict[str, Any]] = {}
    for result in results:
        own = flatten(result["entry"]["hyperparameters"])
        usual = first.setdefault((result["agent"], result["game"]), own)
        for key in own.keys() | usual.keys():
            if own.get(key) != usual.get(key):
                found.setdefault(result["agent"], {})[key] = None
    return [f"{agent}: its runs do not all have the same {', '.join(sorted(keys))}." for agent, keys in found.items()]


def never_learn(results: list[dict[str, Any]]) -> list[str]:
    """
    :param results: of runs, or descriptions of runs to come
    :return: a sentence for every agent that makes no update before its training is over
    """
    found: dict[str, dict[str, None]] = {}
    for result in results:
        starts, steps = result["entry"]["hyperparameters"].get("learning_starts", 0), result["protocol"]["steps"]
        if starts >= steps:
            found.setdefault(result["agent"], {})[f"{result['game']} (learning_starts {starts:,} of {steps:,} steps)"] = None
    return [f"{agent} learns nothing on {', '.join(where)}: it stays as it was made." for agent, where in found.items()]


def choose_runs(
    results: list[dict[str, Any]], suite_games: list[str], force: bool
) -> tuple[list[str], dict[str, list[int]], list[str]]:
    """
    The games that every agent has runs on, and of each agent the seeds that it has on all of them.

    :param results: of all finished runs
    :param suite_games: all games, in order
    :param force: continue with the games in common where some agent lacks others
    :return: games, agent -> seeds, sentences on what is left out
    :raises ValueError: if scores are missing for some games, or no game, or no seed of an agent, is left
    """
    present: dict[str, dict[str, set[int]]] = {}
    for result in results:
        present.setdefault(result["agent"], {}).setdefault(result["game"], set()).add(result["seed"])
    all_games = [*suite_games, *(g for g in dict.fromkeys(r["game"] for r in results) if g not in suite_games)]
    games = [game for game in all_games if all(game in by_game for by_game in present.values())]
    lacking = {agent: [game for game in all_games if game not in by_game] for agent, by_game in present.items()}
    nobody = [game for game in all_games if all(game in missing for missing in lacking.values())]
    if not games:
        told = "; ".join(f"{agent} has {', '.join(by_game)}" for agent, by_game in present.items())
        raise ValueError(
            f"games: expected one or more that every agent has run, found none: {told}. Choose some with --agents."
        )
    notes = [f"No finished run of any agent: {', '.join(nobody)}."] if nobody else []
    for agent, missing in lacking.items():
        if own := [game for game in missing if game not in nobody]:
            notes.append(f"{agent} has no finished run on {', '.join(own)}.")
    if notes and not force:
        raise ValueError(
            f"expected scores of every agent on every game, found some missing. {' '.join(notes)} Finish the runs, choose "
            "with --agents, or pass --force to compare the games that all have."
        )
    if len(games) < len(all_games):
        notes.append(f"Compared are the {len(games)} of {len(all_games)} games that every agent has: {', '.join(games)}.")
    chosen = {}
    for agent, by_game in present.items():
        common = set.intersection(*(by_game[game] for game in games))
        every = set.union(*(by_game[game] for game in games))
        if not common:
            told = "; ".join(f"{game}: {', '.join(map(str, sorted(by_game[game])))}" for game in games)
            raise ValueError(f"{agent}: expected a seed that it has on every game, found none: {told}. Run the missing ones.")
        if common != every:
            lacks = {game: every - by_game[game] for game in games}
            fewer = [f"{game} lacks {', '.join(map(str, sorted(seeds)))}" for game, seeds in lacks.items() if seeds]
            notes.append(
                f"{agent} has not all seeds on every game: {'; '.join(fewer)}. Compared are its seeds "
                f"{', '.join(map(str, sorted(common)))}, which are on every game."
            )
        chosen[agent] = sorted(common)
    return games, chosen, notes
