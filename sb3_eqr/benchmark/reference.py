"""Published scores on Atari 100K, with their sources."""

import pathlib
from collections.abc import Iterable
from typing import NamedTuple

import pandas as pd

RANDOM, HUMAN = "Random", "Human"  # the two methods that scores are normalised by
PUBLISHED_STEPS = 100_000  # training steps of the bundled scores


class PublishedMethod(NamedTuple):
    """How a method of :func:`load_reference` is shown next to the runs of a benchmark."""

    method: str
    label: str
    runs: int  # behind each published mean; for the EqR paper, from the captions of its tables
    most: int | None = None  # the maximum, where the number differs between games

    @property
    def n_runs(self) -> str:
        """The number of runs in words."""
        return f"{self.runs} runs" if self.most is None else f"{self.runs} to {self.most} runs"


# The EqR paper's agents by their losses, and the methods they are usually compared with, from the source with the most runs.
SHOWN = (
    PublishedMethod("EqR [EqR Tab4]", "EqR, AET only (paper)", 10),
    PublishedMethod("EqR, L_{GET} [EqR Tab4]", "EqR, GET (paper)", 10),
    PublishedMethod("EqR, L_R [EqR Tab2]", "EqR, R (paper)", 10),
    PublishedMethod("EqR, L_R + L_{GET} [EqR Tab2]", "EqR, R + GET (paper)", 10),
    PublishedMethod("DER (rliable, 100 runs)", "DER", 100),
    PublishedMethod("DrQ (rliable, 100 runs)", "DrQ", 100),
    PublishedMethod("SPR (rliable, 100 runs)", "SPR", 100),
    PublishedMethod("SPR+resets (Nikishin et al., 32 runs, final eval, back-computed from HNS)", "SPR with resets", 32),
    PublishedMethod("BBF RR8_BBF", "BBF, replay ratio 8", 52, 60),
)


def load_reference() -> pd.DataFrame:
    """
    Mean scores of published methods on the 26 games of Atari 100K.

    :return: columns method, game, runs (number of runs behind the mean; 1 where the source gives only the mean), mean, sd
        (over runs; NaN where unknown), source; the methods include "Random" and "Human"
    """
    return pd.read_csv(pathlib.Path(__file__).with_name("reference_scores.csv"))


def plain_game(name: str) -> str:
    """
    :param name: name of a game in any spelling: "BankHeist", "bank_heist", "Bank Heist"
    :return: its spelling in the bundled scores: "bankheist"
    """
    return name.replace("_", "").replace(" ", "").lower()


def published_means(methods: Iterable[PublishedMethod], games: Iterable[str]) -> pd.DataFrame:
    """
    :param methods: methods to look up
    :param games: names in any spelling; games without published scores are left out
    :return: rows games (as given), columns labels; raw mean scores
    """
    table = load_reference().pivot(index="game", columns="method", values="mean")
    present = [game for game in games if plain_game(game) in table.index]
    methods = list(methods)
    values = table.loc[[plain_game(game) for game in present], [m.method for m in methods]]
    return values.set_axis(present, axis=0).set_axis([m.label for m in methods], axis=1)
