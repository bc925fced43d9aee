"""Published scores on Atari 100K, as figures with their source."""

import difflib
import pathlib
from collections.abc import Iterable
from typing import NamedTuple

import pandas as pd

RANDOM, HUMAN = "Random", "Human"  # the two methods that scores are normalised by
PUBLISHED_STEPS = 100_000  # of the agents whose scores are bundled


class PublishedMethod(NamedTuple):
    """How a method of :func:`load_reference` is shown beside the runs of a benchmark."""

    method: str
    label: str
    runs: int  # that the published means are over, which the EqR paper tells in the captions of its tables
    most: int | None = None  # where games differ in it

    @property
    def n_runs(self) -> str:
        """In words."""
        return f"{self.runs} runs" if self.most is None else f"{self.runs} to {self.most} runs"


# The EqR paper's own agents by their losses, and the methods they are usually held against, from the source with most runs.
SHOWN = (
    PublishedMethod("EqR [EqR Tab4]", "EqR (paper)", 10),
    PublishedMethod("EqR, L_{GET} [EqR Tab4]", "EqR, GET (paper)", 10),
    PublishedMethod("EqR, L_R [EqR Tab2]", "EqR, R (paper)", 10),
    PublishedMethod("EqR, L_R + L_{GET} [EqR Tab2]", "EqR, R + GET (paper)", 10),
    PublishedMethod("DER (rliable, 100 runs)", "DER", 100),
    PublishedMethod("DrQ (rliable, 100 runs)", "DrQ", 100),
    PublishedMethod("SPR (rliable, 100 runs)", "SPR", 100),
    PublishedMethod("BBF RR8_BBF", "BBF, replay ratio 8", 52, 60),
)
SHOWN_LOSSES = SHOWN[:4]  # Table 4
SHOWN_GROUPS = (  # Table 3
    PublishedMethod("MLP [EqR Tab3]", "MLP (paper)", 10),
    PublishedMethod("EqR, T_2 [EqR Tab3]", "EqR, T(2) (paper)", 10),
    PublishedMethod("EqR, SE_2 [EqR Tab3]", "EqR, SE(2) (paper)", 10),
    PublishedMethod("EqR, GL_2 [EqR Tab3]", "EqR, GL(2) (paper)", 10),
)


def load_reference() -> pd.DataFrame:
    """
    Mean scores of published methods on the 26 games of Atari 100K.

    :return: columns method, game, runs (how many the mean is over; 1 where the source gives the mean alone), mean, sd (over
        runs; NaN where unknown), source; among the methods are "Random" and "Human"
    """
    return pd.read_csv(pathlib.Path(__file__).with_name("reference_scores.csv"))


def plain_game(name: str) -> str:
    """
    :param name: as any source writes it: "BankHeist", "bank_heist", "Bank Heist"
    :return: "bankheist", as in the bundled scores
    """
    return name.replace("_", "").replace(" ", "").lower()


def match_games(names: Iterable[str], known: Iterable[str]) -> dict[str, str]:
    """
    :param names: of games, as a source writes them
    :param known: the names to match them to, regardless of case, "_" and spaces
    :return: name -> known name
    :raises ValueError: for a name that matches none, with the nearest; and for two that match the same
    """
    by_plain = {plain_game(game): game for game in known}
    found: dict[str, str] = {}
    for name in names:
        plain = plain_game(name)
        if plain not in by_plain:
            raise ValueError(f"game: expected one of {', '.join(by_plain.values())}, found {name!r}.{nearest(name, by_plain)}")
        if by_plain[plain] in found.values():
            raise ValueError(f"game: expected each game once, found {name!r} beside another spelling. Keep one of them.")
        found[name] = by_plain[plain]
    return found


def nearest(name: str, by_plain: dict[str, str]) -> str:
    """
    :param name: that was not found
    :param by_plain: plain name -> name, of those that exist
    :return: a sentence with the most similar name, "" where none is similar
    """
    close = difflib.get_close_matches(plain_game(name), list(by_plain), n=1)
    return f" Did you mean {by_plain[close[0]]!r}?" if close else ""


def published_means(methods: Iterable[PublishedMethod], games: Iterable[str]) -> pd.DataFrame:
    """
    :param methods: to look up
    :param games: names in any spelling; those without published scores are left out
    :return: rows games (as given), columns labels; raw mean scores
    """
    table = load_reference().pivot(index="game", columns="method", values="mean")
    present = [game for game in games if plain_game(game) in table.index]
    methods = list(methods)
    values = table.loc[[plain_game(game) for game in present], [m.method for m in methods]]
    return values.set_axis(present, axis=0).set_axis([m.label for m in methods], axis=1)
