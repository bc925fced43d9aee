"""Suites: the games, steps, preprocessing, evaluation protocol and normalisation of a benchmark."""

import pathlib
import string
from collections.abc import Iterable
from typing import Annotated, Any

import yaml
from annotated_types import Len
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, PositiveInt, ValidationError, field_validator, model_validator

from sb3_eqr.benchmark.reference import HUMAN, RANDOM, load_reference
from sb3_eqr.common.checks.arguments import nearest
from sb3_eqr.common.saving.files import atomic_write
from sb3_eqr.envs import check_registered
from sb3_eqr.zoo.entries import read_yaml

RAW = "raw score"  # the unit of scores that are not normalised
OWN_SUITES = pathlib.Path(__file__).with_name("suites.yml")


class Strict(BaseModel):
    """A model that rejects unknown keys, and values of another type, such as a flag for a number."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class Curve(Strict):
    """The learning curve: ``points`` points of ``episodes`` episodes each; the last point is the final evaluation."""

    points: PositiveInt
    episodes: PositiveInt


class Evaluation(Strict):
    """The evaluation: ``episodes`` in ``n_envs`` environments, of at most ``max_steps`` steps (``None``: no limit)."""

    episodes: PositiveInt
    n_envs: PositiveInt
    curve: Curve
    epsilon: float = Field(0.0, ge=0, le=1)
    max_steps: PositiveInt | None = None
    preprocessing: dict[str, Any]


class Normalisation(Strict):
    """The raw scores that become 0 and 1, per game, their unit and source."""

    unit: str
    source: str
    scores: dict[str, Annotated[list[FiniteFloat], Len(2, 2)]]

    @field_validator("scores")
    @classmethod
    def _rise(cls, scores: dict[str, list[float]]) -> dict[str, list[float]]:
        for game, (low, high) in scores.items():
            if low >= high:
                raise ValueError(f"{game}: the score that becomes 1 must be above the one that becomes 0, got {low}, {high}.")
        return scores


class Suite(Strict):
    """The games of a benchmark, and how they are trained on, evaluated and normalised."""

    name: str
    games: Annotated[list[str], Len(1)]
    env_id: str | dict[str, str]  # gymnasium's name of the environments, with "{game}" for the game, or game -> name
    env_kwargs: dict[str, dict[str, Any]] = {}  # game -> arguments of its environment
    steps: dict[str, PositiveInt]  # training steps of the agent, per game; in a file also one number for all games
    preprocessing: dict[str, Any] = {}  # keys of RL Zoo's entries, such as frame_stack, that override an agent's own
    evaluation: Evaluation  # its preprocessing defaults to that of training
    normalisation: Normalisation  # in a file, "human" means random play 0, a human tester 1; the default is raw scores

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, entry: Any) -> Any:
        """Fill in what a file may leave out."""
        if not isinstance(entry, dict) or not isinstance(entry.get("games"), list):
            return entry  # pydantic reports what is wrong
        games = [game for game in entry["games"] if isinstance(game, str)]
        found = {"normalisation": {"unit": RAW, "source": "none", "scores": {game: [0, 1] for game in games}}} | entry
        if found["normalisation"] == "human":
            found["normalisation"] = human_scores(games)
        if "steps" in found and not isinstance(found["steps"], dict):
            found["steps"] = dict.fromkeys(games, found["steps"])
        if isinstance(found.get("evaluation"), dict):
            found["evaluation"] = {"preprocessing": found.get("preprocessing", {})} | found["evaluation"]
        return found

    @model_validator(mode="after")
    def _covers_games(self) -> "Suite":
        if isinstance(self.env_id, str):
            names = {name for _, name, *_ in string.Formatter().parse(self.env_id)} - {None}
            if names != {"game"} and (names or len(self.games) > 1):
                raise ValueError(f"env_id must contain {{game}} and no other braces, got {self.env_id!r}.")
        folders = [game.replace("/", "-") for game in self.games]
        if unfit := [game for game, name in zip(self.games, folders, strict=True) if folders.count(name) > 1 or "\\" in name]:
            raise ValueError(f"games must have names that differ as names of folders, got {', '.join(unfit)}.")
        named = self.games if isinstance(self.env_id, str) else self.env_id
        for what, there in {"env_id": named, "steps": self.steps, "normalisation: scores": self.normalisation.scores}.items():
            if missing := [game for game in self.games if game not in there]:
                raise ValueError(f"{what} must have every game, got none for {', '.join(missing)}.")
        return self

    def protocol(self, game: str) -> dict[str, Any]:
        """:return: the settings that two scores must share to be comparable"""
        evaluation = self.evaluation.model_dump()
        own = {"env_kwargs": self.env_kwargs[game]} if game in self.env_kwargs else {}
        return {
            "env_id": self.env_id.format(game=game) if isinstance(self.env_id, str) else self.env_id[game],
            "steps": self.steps[game],
            "preprocessing": {**self.preprocessing, **own},
            "evaluation": {**evaluation, "preprocessing": {**evaluation["preprocessing"], **own}},
        }


def nearest_name(name: str, legal: Iterable[str]) -> str:
    """:return: the end of a message, with the nearest legal name and all legal names"""
    names = sorted(legal)
    return f"{nearest(name, names)} Choose from {', '.join(names)}."


def human_scores(games: list[str]) -> dict[str, Any]:
    """:return: the normalisation of Atari 100K: random play 0, a human tester 1"""
    table = load_reference().pivot(index="game", columns="method", values="mean")[[RANDOM, HUMAN]]
    scores = {game: table.loc[game.lower()].tolist() for game in games if game.lower() in table.index}
    return {"unit": "human-normalised score", "source": "EqR paper, Table 2", "scores": scores}


def make_suite(name: str, where: str, entry: dict[str, Any]) -> Suite:
    """
    :param where: name of the file, for messages
    :param entry: an entry as in suites.yml
    :raises ValueError: for an invalid or incomplete entry
    """
    where = f"{where}, suite {name!r}"
    if not isinstance(entry, dict):
        raise ValueError(f"{where} must be a mapping, got {entry!r}. See docs/benchmark.md.")
    try:
        suite = Suite.model_validate({"name": name} | entry)
    except ValidationError as error:
        raise ValueError(f"{where}: {first_mistake(error)}") from error
    for game in suite.env_kwargs:
        if game not in suite.games:
            raise ValueError(f"{where}: env_kwargs: there is no game {game!r}.{nearest_name(game, suite.games)}")
    return suite


def first_mistake(error: ValidationError) -> str:
    """:return: the first mistake in words: the key, what it must be, and its value"""
    mistakes = error.errors(include_url=False)  # a misspelt key is also missing: its name says more
    mistake = next((one for one in mistakes if one["type"] == "extra_forbidden"), mistakes[0])
    *outer, key = mistake["loc"] or ("",)
    path = ": ".join(map(str, mistake["loc"]))
    if mistake["type"] == "extra_forbidden":
        kinds: dict[str, type[Strict]] = {"evaluation": Evaluation, "curve": Curve, "normalisation": Normalisation}
        kind = kinds.get(str(outer[-1]), Suite) if outer else Suite
        return f"unknown key {path!r}.{nearest_name(str(key), kind.model_fields)}"
    if mistake["type"] == "missing":
        return f"{path} must be set, got nothing."
    if mistake["type"] == "value_error":
        return f"{path}: {mistake['ctx']['error']}" if path else str(mistake["ctx"]["error"])
    return f"{path}: {mistake['msg'][0].lower()}{mistake['msg'][1:]}, got {mistake['input']!r}."


def load_suite(name: str, file: pathlib.Path | None = None) -> Suite:
    """
    :param file: an additional file of suites, which override ours of the same name
    :raises ValueError: for an unknown suite, with the nearest name, or an invalid one
    """
    entries = {key: (OWN_SUITES, entry) for key, entry in read_yaml(OWN_SUITES).items()}
    if file is not None:
        if not file.is_file():
            raise ValueError(f"--suite-file: there is no file {file}")
        entries |= {key: (file, entry) for key, entry in read_yaml(file, "--suite-file: ").items()}
    if name not in entries:
        nearby = nearest_name(name, entries)
        raise ValueError(f"--suite: there is no suite {name!r}.{nearby} --suite-file FILE adds suites of your own.")
    path, entry = entries[name]
    return make_suite(name, path.name, entry)


def choose(suite: Suite, games: list[str] | None, steps: int | None, episodes: int | None = None) -> Suite:
    """
    :param games: the games to keep, ignoring case; ``None``: all
    :param steps: training steps that override the suite's
    :param episodes: episodes of the final evaluation that override the suite's
    :raises ValueError: for a game that the suite or gymnasium does not have, with the nearest name
    """
    wanted = suite.games if games is None else games
    for game in wanted:
        if game.lower() not in map(str.lower, suite.games):
            raise ValueError(f"--games: suite {suite.name!r} has no game {game!r}.{nearest_name(game, suite.games)}")
    kept = [game for game in suite.games if game.lower() in map(str.lower, wanted)]
    per_game = suite.steps if steps is None else dict.fromkeys(kept, steps)
    for game in kept:
        check_registered(suite.protocol(game)["env_id"], f"suite {suite.name!r}")
    evaluation = suite.evaluation if episodes is None else suite.evaluation.model_copy(update={"episodes": episodes})
    return suite.model_copy(update={"games": kept, "steps": per_game, "evaluation": evaluation})


def merge(old: Suite, new: Suite) -> Suite:
    """
    :return: the new suite, with the games of the old one before its own
    :raises ValueError: if they are not the same suite, or their scores have another unit
    """
    if old.name != new.name:
        raise ValueError(
            f"The runs must be of suite {old.name!r}, as those that are there, got {new.name!r}. Use another place."
        )
    units = old.normalisation.unit, new.normalisation.unit
    if len({*units}) == 2:
        raise ValueError(f"normalisation: unit must be {units[0]!r}, as that of the runs that are there, got {units[1]!r}.")
    ids = [{game: suite.protocol(game)["env_id"] for game in suite.games} for suite in (old, new)]
    merged = new.model_dump() | {
        "games": [*dict.fromkeys([*old.games, *new.games])],
        "env_id": new.env_id if old.env_id == new.env_id else ids[0] | ids[1],
        "env_kwargs": old.env_kwargs | new.env_kwargs,
        "steps": old.steps | new.steps,
    }
    merged["normalisation"]["scores"] = old.normalisation.scores | new.normalisation.scores
    return Suite.model_validate(merged)


def write_suite(suite: Suite, path: pathlib.Path) -> None:
    """Write a suite in full, including defaults, for :func:`read_suite`."""
    with atomic_write(path, "yml") as file:
        file.write(yaml.safe_dump(suite.model_dump(), sort_keys=False).encode())


def read_suite(path: pathlib.Path) -> Suite:
    """Read a suite; raises ValueError if the file does not hold one."""
    return Suite.model_validate(read_yaml(path))
