"""Select from benchmark folders what can be compared: games and seeds that every agent has, under one protocol."""

import dataclasses
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from sb3_eqr.benchmark import selection
from sb3_eqr.benchmark.packed import read
from sb3_eqr.benchmark.reference import PUBLISHED_STEPS
from sb3_eqr.benchmark.runs import PLAN, Run, read_plan
from sb3_eqr.benchmark.scores import final_score, normalised, read_runs
from sb3_eqr.benchmark.statistics import METRICS
from sb3_eqr.benchmark.suites import RAW, Suite, nearest_name


@dataclasses.dataclass(frozen=True)
class Comparison:
    """What benchmark folders have in common."""

    suite: str  # its name; several names are joined by "+"
    unit: str  # of the normalised scores
    source: str  # of the bounds that scores are normalised by
    bounds: dict[str, tuple[float, float]]  # game -> (score that becomes 0, score that becomes 1)
    games: list[str]  # that every agent has runs on, in the suite's order
    agents: list[str]  # of the benchmark; the first is the baseline
    scores: pd.DataFrame  # columns agent, game, seed, raw, score (normalised); the runs compared, of agents and references
    results: list[dict[str, Any]]  # result.json of those runs
    differing: dict[str, str]  # agent -> how its protocol differs from the others', where the comparison was forced
    notes: list[str]  # sentences on what was left out and why

    @property
    def human(self) -> bool:
        """Whether a normalised score of 1 is a human tester's, as for published Atari scores."""
        return self.unit.startswith("human-normali")

    @property
    def is_raw(self) -> bool:
        """Whether scores are not normalised: then 0 and 1 mean nothing."""
        return self.unit == RAW

    @property
    def is_averaged(self) -> bool:
        """Whether scores of different games are averaged: raw ones have no common scale."""
        return not self.is_raw or len(self.games) == 1

    @property
    def metrics(self) -> list[str]:
        """The aggregates that mean something."""
        if not self.is_averaged:
            return []
        return [metric for metric in METRICS if metric != "optimality gap"] if self.is_raw else [*METRICS, self.above_one]

    @property
    def above_one(self) -> str:
        """The name of games with a mean above 1."""
        return "superhuman games" if self.human else "games above 1"

    @property
    def has_published(self) -> bool:
        """Whether published scores are for as many steps as the runs."""
        return self.human and {result["protocol"]["steps"] for result in self.results} == {PUBLISHED_STEPS}

    def label(self, agent: str) -> str:
        """:return: the agent's name, marked where its protocol differs from the others'"""
        return f"{agent} ‡" if agent in self.differing else agent

    def runs(self, agent: str) -> list[dict[str, Any]]:
        """:return: the results of an agent; an empty list for a reference"""
        return [result for result in self.results if result["agent"] == agent]

    def minutes(self, agent: str) -> float:
        """:return: mean wall-clock time of a run; NaN for a reference"""
        times = [result["wall_clock_s"] for result in self.runs(agent)]
        return float(np.mean(times)) / 60 if times else np.nan


def counted(count: int, noun: str) -> str:
    """:return: "1 game", "5 games" """
    return f"{count} {noun}{'' if count == 1 else 's'}"


def compare(
    folders: list[pathlib.Path],
    references: Mapping[str, pathlib.Path],
    force: bool,
    agents: Sequence[str] = (),
    baseline: str | None = None,
) -> Comparison:
    """
    :param folders: folders of benchmarks
    :param references: name -> file of runs, see :func:`~sb3_eqr.benchmark.scores.read_runs`
    :param force: also compare agents with different protocols or games
    :param agents: the agents to compare; empty: all
    :param baseline: the agent that the others are compared with; ``None``: the first stock one, or else the first without EqR
    :return: what the folders have in common
    :raises ValueError: if they have nothing in common, or comparing it would mislead
    """
    if not folders:
        raise ValueError("folders must be at least one benchmark folder, got none.")
    found = {folder: read(pathlib.Path(folder)) for folder in folders}
    suites = [suite for suite, _ in found.values()]
    finished = {folder: [row for row in rows if "stopped_at" not in row] for folder, (_, rows) in found.items()}
    wanted = [*agents, *([baseline] if baseline and agents else [])]
    results = _select(finished, wanted)
    bounds = _bounds(suites, results)
    games, chosen, notes = selection.choose_runs(results, [game for suite in suites for game in suite.games], force)
    if baseline is not None and baseline not in chosen:
        raise ValueError(f"--baseline must be one of {', '.join(chosen)}, got {baseline!r}.")
    with_eqr = {row["agent"] for row in results if selection.learns_latent_model(row)}
    agents = sorted(chosen, key=lambda agent: (agent != baseline, agent.startswith("eqr_"), agent in with_eqr, agent))
    used = [row for row in results if row["game"] in games and row["seed"] in chosen[row["agent"]]]
    used.sort(key=lambda row: (agents.index(row["agent"]), games.index(row["game"]), row["seed"]))
    stopped = [row for _, of_folder in found.values() for row in of_folder if "stopped_at" in row]
    if left := sum(not wanted or row["agent"] in wanted for row in stopped):
        notes.append(f"{counted(left, 'run')} stopped before the end: left out.")
    planned = [run for folder, (_, rows) in found.items() for run in _unfinished(folder, rows)]
    if unfinished := [run.label for run in planned if not wanted or run.agent.name in wanted]:
        notes.append(f"Left out, because they have not finished: {'; '.join(unfinished)}.")
    notes += [*selection.never_learn(used), *selection.settings_differences(used)]
    differing = selection.protocol_differences(used)
    if differing and not force:
        raise ValueError(
            "The protocol must be the same for every run of a game, got "
            f"{' '.join(f'{agent}: {what}.' for agent, what in differing.items())} "
            "Select agents with --agents, or pass --force to compare them, marked in every table."
        )
    rows = [(row["agent"], row["game"], row["seed"], final_score(row)) for row in used]
    tables = [pd.DataFrame(rows, columns=["agent", "game", "seed", "raw"])]
    for name, path in references.items():
        if name in agents:
            raise ValueError(f"--reference must have a name that no agent has, got {name!r}. Rename it.")
        tables.append(read_runs(path, name, games))
    scores = pd.concat(tables, ignore_index=True)
    scores["score"] = [normalised(raw, bounds[game]) for game, raw in zip(scores["game"], scores["raw"], strict=True)]
    comparison = Comparison(
        suite=" + ".join(dict.fromkeys(suite.name for suite in suites)),
        unit=suites[0].normalisation.unit,
        source=suites[0].normalisation.source,
        bounds=bounds,
        games=games,
        agents=agents,
        scores=scores,
        results=used,
        differing=differing,
        notes=notes,
    )
    if comparison.human and not comparison.has_published:
        notes.append("Published scores are omitted, because they are for 100,000 steps.")
    notes += [table.attrs["note"] for table in tables if "note" in table.attrs]
    return comparison


def _select(finished: Mapping[pathlib.Path, list[dict[str, Any]]], agents: list[str]) -> list[dict[str, Any]]:
    """
    :param finished: folder -> its finished runs
    :param agents: the agents to keep; empty: all
    :raises ValueError: for a folder or an agent without finished runs, or a run that is in two folders
    """
    for folder, rows in finished.items():
        if not rows:
            raise ValueError(
                f"{folder} must contain finished runs, got none. Run sb3-eqr benchmark run, again if runs were stopped."
            )
    there = {row["agent"] for rows in finished.values() for row in rows}
    for agent in agents:
        if agent not in there:
            raise ValueError(f"--agents: {agent!r} has no finished run.{nearest_name(agent, there)}")
    kept = [(folder, row) for folder, rows in finished.items() for row in rows if not agents or row["agent"] in agents]
    where: dict[tuple, pathlib.Path] = {}
    for folder, row in kept:
        run = (row["agent"], row["game"], row["seed"])
        name = f"{run[0]}, {run[1]}, seed {run[2]}"
        if run in where:
            raise ValueError(f"{name} must be in one folder, got it in {where[run]} and {folder}. Report only one of them.")
        if not any(part["kind"] == "final" and part["scores"] for part in row["evaluations"]):
            raise ValueError(f"{folder}: {name} must have a final evaluation, got none.")
        where[run] = folder
    return [row for _, row in kept]


def _unfinished(folder: pathlib.Path, rows: list[dict[str, Any]]) -> list[Run]:
    """:return: the planned runs of a benchmark's folder that have no row; none for a file"""
    there = {(row["agent"], row["game"], row["seed"]) for row in rows}
    planned = read_plan(folder) if any(folder.glob(f"runs/*/*/*/{PLAN}")) else []
    return [run for run in planned if (run.agent.name, run.game, run.seed) not in there]


def _bounds(suites: list[Suite], results: list[dict[str, Any]]) -> dict[str, tuple[float, float]]:
    """
    :return: game -> (score that becomes 0, score that becomes 1)
    :raises ValueError: if a game has no bounds, or folders disagree on them
    """
    bounds: dict[str, tuple[float, float]] = {}
    first = suites[0]
    for suite in suites:
        if suite.normalisation.unit != first.normalisation.unit:
            raise ValueError(
                f"The unit of normalisation must be the same in all folders, got {first.normalisation.unit!r} in {first.name} "
                f"and {suite.normalisation.unit!r} in {suite.name}. Report them separately."
            )
        for game, (low, high) in suite.normalisation.scores.items():
            if bounds.setdefault(game, (low, high)) != (low, high):
                raise ValueError(
                    f"The bounds of {game} must be the same in all folders, got {low} and {high} in "
                    f"{suite.name} and {bounds[game]} before. Correct suite.yml."
                )
    for result in results:
        if result["game"] not in bounds:
            raise ValueError(
                f"{result['game']} has no bounds for normalisation in {first.name}, which has them for "
                f"{', '.join(bounds) or 'no game'}. "
                "Correct the name, or add the game under normalisation: scores in suite.yml."
            )
    return bounds
