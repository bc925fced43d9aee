"""Published scores on Atari 100K, as figures with their source."""

import pathlib

import pandas as pd

RANDOM, HUMAN = "Random", "Human"  # the two methods that scores are normalised by


def load_reference() -> pd.DataFrame:
    """
    Mean scores of published methods on the 26 games of Atari 100K.

    :return: columns method, game, runs (how many the mean is over; 1 where the source gives the mean alone), mean, sd (over
        runs; NaN where unknown), source; among the methods are "Random" and "Human"
    """
    return pd.read_csv(pathlib.Path(__file__).with_name("reference_scores.csv"))


def human_normalized(scores: pd.DataFrame) -> pd.DataFrame:
    """
    (score - random) / (human - random), with the random and human scores of the paper's Table 2.

    :param scores: columns method, game, mean
    :return: rows games, columns methods
    :raises ValueError: for a game that has no human score, with the names of those that have one
    """
    reference = load_reference().pivot(index="game", columns="method", values="mean")
    unknown = set(scores["game"]) - set(reference.index)
    if unknown:
        raise ValueError(f"games: expected some of {', '.join(reference.index)}, found {', '.join(sorted(unknown))}")
    table = scores.pivot(index="game", columns="method", values="mean")
    low, high = reference.loc[table.index, RANDOM], reference.loc[table.index, HUMAN]
    return table.sub(low, axis=0).div(high - low, axis=0)
