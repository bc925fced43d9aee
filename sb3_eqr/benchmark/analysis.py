"""The statistics of a comparison, each computed once, and the sentences of the report about them."""

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from sb3_eqr.benchmark import statistics
from sb3_eqr.benchmark.comparison import Comparison, counted
from sb3_eqr.benchmark.reference import SHOWN, load_reference, published_means
from sb3_eqr.benchmark.scores import normalised
from sb3_eqr.benchmark.statistics import MIN_RUNS
from sb3_eqr.benchmark.tables import differences_per_game, number

FEW_RUNS = 5  # with fewer, the intervals of the percentile bootstrap are far too narrow


@dataclasses.dataclass(frozen=True)
class Analysis:
    """The runs compared, and their statistics."""

    comparison: Comparison
    matrices: dict[str, np.ndarray]  # agent or reference -> (runs, games), normalised scores, games in alphabetical order
    # Rows games, columns published methods, raw mean scores; no columns where a run's steps differ from the published
    # methods', the suite is not normalised by human scores, or a game has no published score.
    means: pd.DataFrame
    # Columns agent, metric, value, low, high, runs, games, from ("runs" or "game means only"), protocol_differs: the metrics
    # that mean something, and the number of games above 1.
    aggregates: pd.DataFrame
    differences: pd.DataFrame  # of the IQMs from the first agent and from the best, see iqm_differences; empty without IQM
    reps: int  # bootstrap samples behind all intervals


def analyse(comparison: Comparison, reps: int) -> Analysis:
    """
    :param comparison: the runs to compare
    :param reps: number of bootstrap samples
    """
    matrices = statistics.score_matrices(comparison.scores)
    means = published_means(SHOWN, comparison.games if comparison.has_published else [])
    if len(means) < len(comparison.games):
        means = pd.DataFrame(index=comparison.games)
    parts = [_aggregates(comparison, matrices, reps).assign(**{"from": "runs"})]
    for method in SHOWN if len(means.columns) else ():  # as of a single run with these scores
        scores = [[normalised(means.at[game, method.label], comparison.bounds[game]) for game in means.index]]
        known = _aggregates(comparison, {method.label: np.array(scores)}, reps)
        parts.append(known.assign(**{"from": "game means only", "runs": method.runs}))
    aggregates = pd.concat(parts, ignore_index=True).assign(games=len(comparison.games))
    aggregates["protocol_differs"] = aggregates["agent"].map(comparison.differing).fillna("")
    columns = ["agent", "metric", "value", "low", "high", "runs", "games", "from", "protocol_differs"]
    baseline = comparison.agents[0]
    if not comparison.is_averaged:
        return Analysis(comparison, matrices, means, aggregates[columns], pd.DataFrame(), reps)
    best = max(comparison.agents, key=lambda agent: float(statistics.iqm(matrices[agent])))
    differences = statistics.iqm_differences(matrices, baseline, reps)
    if best != baseline:
        rest = {agent: matrix for agent, matrix in matrices.items() if agent != baseline}
        differences = pd.concat([differences, statistics.iqm_differences(rest, best, reps)], ignore_index=True)
    return Analysis(comparison, matrices, means, aggregates[columns], differences, reps)


def _aggregates(comparison: Comparison, matrices: Mapping[str, np.ndarray], reps: int) -> pd.DataFrame:
    """:return: columns agent, metric, value, low, high, runs"""
    above = [(agent, comparison.above_one, statistics.games_above(matrix)) for agent, matrix in matrices.items()]
    tables = [statistics.aggregate(matrices, reps), pd.DataFrame(above, columns=["agent", "metric", "value"])]
    table = pd.concat(tables, ignore_index=True)
    table["runs"] = table["agent"].map({agent: len(matrix) for agent, matrix in matrices.items()})
    return table[table["metric"].isin(comparison.metrics)]


def conclusion(analysis: Analysis) -> list[str]:
    """:return: sentences on what the runs show, the most important first"""
    comparison = analysis.comparison
    if not comparison.is_averaged:
        return per_game_in_words(comparison)
    sentences = [difference_in_words(row, comparison) for row in analysis.differences.to_dict("records")]
    alike = {agent: matrix for agent, matrix in analysis.matrices.items() if agent not in comparison.differing}
    best = statistics.distinct_best(alike, analysis.reps)
    if len(comparison.agents) > 2 and best is not None:
        others = "every other one" + (" with the same protocol" if comparison.differing else "")
        sentences.insert(0, f"{comparison.label(best)} is the best agent: these runs distinguish it from {others}.")
    elif len(comparison.agents) > 2:
        sentences.insert(0, "No agent is the best: the one with the highest IQM is not distinguished from all others.")
    if any(abs(row["difference"]) < row["detectable"] for row in analysis.differences.to_dict("records")):
        sentences.append("Four times as many seeds would detect differences half as large.")
    return sentences


def per_game_in_words(comparison: Comparison) -> list[str]:
    """:return: a sentence per agent on the games on which it differs from the first, for scores without a common scale"""
    found = differences_per_game(comparison)
    first, sentences = comparison.label(comparison.agents[0]), []
    for agent in dict.fromkeys(agent for agent, _ in found):
        of_agent = {game: ends for (name, game), (_, *ends) in found.items() if name == agent}
        better = [game for game, (low, _) in of_agent.items() if low > 0]
        worse = [game for game, (_, high) in of_agent.items() if high < 0]
        rest = counted(len(of_agent) - len(better) - len(worse), "game")
        sentences.append(
            f"Compared with {first}, {comparison.label(agent)} is better on {', '.join(better) or 'no game'}, worse on "
            f"{', '.join(worse) or 'no game'}, with no clear difference on {rest} (95% intervals of Welch's t test)."
        )
    return [*sentences, "Scores are raw and each game has its own scale, so they are not averaged over games."]


def difference_in_words(row: dict[str, Any], comparison: Comparison) -> str:
    """
    :param row: a row of ``Analysis.differences``
    :return: a sentence on whether the runs distinguish the two agents
    """
    agent, other = comparison.label(row["agent"]), comparison.label(row["baseline"])
    difference, detectable = row["difference"], row["detectable"]
    if difference == 0:
        return f"{agent} and {other} have the same IQM."
    size, least = _distinct(abs(difference), detectable)
    side = "higher" if difference > 0 else "lower"
    if math.isnan(detectable):
        few = min(row["runs"], row["baseline_runs"])
        chance = f"{counted(few, 'run')} per game {'does' if few == 1 else 'do'} not show how much of that is chance"
        return f"The IQM of {agent} is {size} {side} than that of {other}: {chance}."
    runs = str(row["runs"]) if row["runs"] == row["baseline_runs"] else f"{row['runs']} and {row['baseline_runs']}"
    shown = f"{runs} runs on {counted(row['games'], 'game')} can only detect differences above {least}"
    if abs(difference) < detectable:
        found = f"the IQM of the first is {size} {side}"
        return f"{agent} and {other} cannot be distinguished with these runs: {found}, and {shown}."
    verdict = "better" if difference > 0 else "worse"
    return f"{agent} is {verdict} than {other}: its IQM is {size} {side}; {shown.replace('only ', '')}."


def _distinct(difference: float, detectable: float) -> tuple[str, str]:
    """:return: both with two decimals, or with as many more as show a digit of each and which of them is larger"""
    for decimals in range(2, 7):
        texts = number(difference, decimals), number(detectable, decimals)
        if texts[0] != texts[1] and float(texts[0].replace(",", "")) != 0:
            break
    return texts


def notes(analysis: Analysis) -> list[str]:
    """:return: caveats that readers need before the numbers"""
    comparison = analysis.comparison
    found = [f"‡ {agent} was run under another protocol: {what}." for agent, what in comparison.differing.items()]
    found += comparison.notes
    if single := [agent for agent, matrix in analysis.matrices.items() if len(matrix) == 1]:
        verb = "has" if len(single) == 1 else "have"
        found.append(f"{', '.join(single)} {verb} a single run per game: no intervals, and another run may score differently.")
    if few := [agent for agent, matrix in analysis.matrices.items() if 1 < len(matrix) < FEW_RUNS]:
        found.append(
            f"{', '.join(few)}: fewer than {FEW_RUNS} runs per game. Bootstrap intervals of so few runs are too narrow, so "
            f"intervals that do not overlap show nothing; the conclusion allows for it, and gives none below {MIN_RUNS} runs."
        )
    return found


def table_notes(analysis: Analysis) -> list[str]:
    """:return: sentences on what the table of games shows"""
    comparison = analysis.comparison
    found = [
        "Raw scores: mean ± standard deviation over runs. "
        "Bold: significantly better than every other agent with the same protocol.",
    ]
    if comparison.is_averaged:
        found.append(
            f"The last rows are aggregates of {'raw' if comparison.is_raw else 'normalised'} scores over all runs and games, "
            f"with 95% intervals{'' if comparison.is_raw else f'; {comparison.above_one} are games with a mean above 1'}."
        )
    if len(analysis.means.columns):
        sources = load_reference().drop_duplicates("method").set_index("method")["source"]
        found += [f"† {m.label}: 100K steps, game means only ({m.n_runs}), no interval. {sources[m.method]}." for m in SHOWN]
    return found + [f"‡ {agent}: another protocol: {what}." for agent, what in comparison.differing.items()]


def all_of(values: Iterable[Any]) -> str:
    """:return: the distinct values, in order of appearance"""
    return ", ".join(dict.fromkeys(map(str, values)))
