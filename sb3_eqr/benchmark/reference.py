"""Published scores on Atari 100K, as figures with their source."""

import difflib
import json
import math
import pathlib
from collections.abc import Iterable
from typing import Any, NamedTuple

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


def read_runs(path: pathlib.Path, name: str, games: Iterable[str], others: Iterable[str] = ()) -> pd.DataFrame:
    """
    Scores of another method's runs, in the form rliable publishes them: {"Alien": [812.0, 640.5, ...], ...}.

    :param path: a JSON file: game -> raw scores, one per run
    :param name: what to call the method
    :param games: that are needed
    :param others: further games that may be there and are left out
    :return: columns agent, game, seed, score; as many runs on every game as the game with fewest has, the first ones; where
        that leaves some out, ``attrs["note"]`` says so
    :raises ValueError: for a file that is no JSON or has another form, and for missing and unknown games
    """
    games = list(games)
    try:
        content = json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"reference {name}: expected a JSON file, found {path}: {error}. Write game -> [scores].") from error
    expected = f'reference {name}, {path}: expected {{"Game": [score, score, ...], ...}} with a raw score per run'
    if not isinstance(content, dict) or not content:
        raise ValueError(f"{expected}, found {_describe(content)}. Write one list per game.")
    for game, scores in content.items():
        if not isinstance(scores, list) or not scores or not all(_is_number(score) for score in scores):
            raise ValueError(f"{expected}, found for {game} {_describe(scores)}. Write its runs as a list of finite numbers.")
    try:
        matched = match_games(content, dict.fromkeys([*games, *_not_among(others, games)]))
    except ValueError as error:
        raise ValueError(f"reference {name}, {path}: {error} Correct the name or take the game out.") from error
    missing = [game for game in games if game not in matched.values()]
    unused = [given for given, game in matched.items() if game not in games]
    if missing:
        raise ValueError(
            f"reference {name}, {path}: expected scores for {', '.join(games)}, found none for {', '.join(missing)}"
            f"{f' (not needed: {chr(44).join(unused)})' if unused else ''}. "
            "Add them or report without this reference."
        )
    wanted = {game: content[given] for given, game in matched.items() if game in games}
    runs = min(map(len, wanted.values()))
    rows = [(name, game, seed, float(score)) for game in games for seed, score in enumerate(wanted[game][:runs])]
    table = pd.DataFrame(rows, columns=["agent", "game", "seed", "score"])
    if most := max(map(len, wanted.values())) - runs:
        fewest = next(game for game, scores in wanted.items() if len(scores) == runs)
        table.attrs["note"] = f"{name}: its first {runs} runs, as many as {fewest} has; other games have up to {most} more."
    return table


def _not_among(others: Iterable[str], games: list[str]) -> list[str]:
    plain = {plain_game(game) for game in games}
    return [game for game in others if plain_game(game) not in plain]


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _describe(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
