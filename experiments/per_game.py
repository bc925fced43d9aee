"""
Final scores of two agents per game, and the difference of their means over seeds with its 95 % interval (Welch 1947,
https://doi.org/10.1093/biomet/34.1-2.28), from packed runs.

    python -m experiments.per_game docs/results/minatar_30k_final.jsonl.xz --agents eqr_rainbow eqr_rainbow:rainbow
"""

import argparse
import pathlib
from collections import defaultdict
from typing import Any

import numpy as np
from scipy.stats import ttest_ind

from experiments.packed_runs import read
from sb3_eqr.benchmark.scores import evaluation_curve

Scores = dict[tuple[str, str], list[float]]  # agent and game -> a final score per seed


def final_scores(results: list[dict[str, Any]]) -> Scores:
    """:return: the mean score of the last evaluation of each run"""
    found: Scores = defaultdict(list)
    for result in results:
        found[result["agent"], result["game"]].append(float(evaluation_curve(result)[1][-1]))
    return found


def table(scores: Scores, agents: tuple[str, str]) -> str:
    """
    :param scores: see :func:`final_scores`
    :param agents: two of its agents
    :return: Markdown, a row per game that both agents played, with means ± standard deviations
    """
    lines = [f"| game | {agents[0]} | {agents[1]} | difference | seeds |", "|---" * 5 + "|"]
    for game in sorted({game for _, game in scores if all((agent, game) in scores for agent in agents)}):
        both = [scores[agent, game] for agent in agents]
        found = ttest_ind(*both, equal_var=False).confidence_interval()
        cells = [f"{np.mean(values):.2f} ± {np.std(values, ddof=1):.2f}" for values in both]
        cells.append(f"{np.mean(both[0]) - np.mean(both[1]):.2f} [{found.low:.2f}, {found.high:.2f}]")
        lines.append(f"| {game} | {' | '.join(cells)} | {len(both[0])}, {len(both[1])} |")
    return "\n".join(lines)


def main() -> None:
    """Read the files and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=pathlib.Path, nargs="+", help="files of experiments.packed_runs")
    parser.add_argument("--agents", nargs=2, required=True, help="the second is subtracted from the first")
    args = parser.parse_args()
    print(table(final_scores([result for file in args.files for result in read(file).values()]), tuple(args.agents)))


if __name__ == "__main__":
    main()
