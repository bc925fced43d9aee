"""Suites: the games, steps, preprocessing, evaluation protocol and normalisation of a benchmark."""

import pathlib
from collections.abc import Iterable
from typing import Annotated, Any

import gymnasium as gym
import yaml
from annotated_types import Len
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, PositiveInt, ValidationError, field_validator, model_validator

from sb3_eqr import envs
from sb3_eqr.benchmark.reference import HUMAN, RANDOM, load_reference
from sb3_eqr.common.files import atomic_write
from sb3_eqr.zoo.checks import nearest

OWN_SUITES = pathlib.Path(__file__).with_name("suites.yml")


class Strict(BaseModel):
    """Keys and values exactly as written here: an unknown key is a mistake, and so is a flag where a number is needed."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class Curve(Strict):
    """A learning curve has ``points`` points of ``episodes`` episodes each; the last one is the final evaluation."""

    points: PositiveInt
    episodes: PositiveInt


class Evaluation(Strict):
    """How agents are evaluated: ``episodes`` in ``n_envs`` environments, of at most ``max_steps`` steps (``None``: any)."""

    episodes: PositiveInt
    n_envs: PositiveInt
    curve: Curve
    epsilon: float = Field(0.0, ge=0, le=1)
    max_steps: PositiveInt | None = None
    preprocessing: dict[str, Any]


class Normalisation(Strict):
    """Which raw scores become 0 and 1, per game, and what they are."""

    unit: str
    source: str
    scores: dict[str, Annotated[list[FiniteFloat], Len(2, 2)]]

    @field_validator("scores")
    @classmethod
    def _rise(cls, scores: dict[str, list[float]]) -> dict[str, list[float]]:
        for game, (low, high) in scores.items():
            if low >= high:
                raise ValueError(f"{game}: the score that becomes 1 must be above the one that becomes 0")
        return scores


class Suite(Strict):
    """
    :param name: of the suite
    :param games: names as users write them
    :param env_id: gymnasium's name of a game's environment, "{game}" standing for the game
    :param steps: training steps of the agent, per game; in a file also one number for all
    :param preprocessing: keys of RL Zoo's entries (``env_wrapper``, ``frame_stack``, ...) that stand before an agent's own
    :param evaluation: its preprocessing is that of training where it has none
    :param normalisation: "human" in a file: random play 0, a human tester 1; raw scores where there is none
    """

    name: str
    games: Annotated[list[str], Len(1)]
    env_id: str
    steps: dict[str, PositiveInt]
    preprocessing: dict[str, Any] = {}
    evaluation: Evaluation
    normalisation: Normalisation

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, entry: Any) -> Any:
        """What a file may leave out."""
        if not isinstance(entry, dict) or not isinstance(entry.get("games"), list):
            return entry  # pydantic says what is wrong
        games = [game for game in entry["games"] if isinstance(game, str)]
        found = {"normalisation": {"unit": "raw score", "source": "none", "scores": {game: [0, 1] for game in games}}} | entry
        if found["normalisation"] == "human":
            found["normalisation"] = human_scores(games)
        if "steps" in found and not isinstance(found["steps"], dict):
            found["steps"] = dict.fromkeys(games, found["steps"])
        if isinstance(found.get("evaluation"), dict):
            found["evaluation"] = {"preprocessing": found.get("preprocessing", {})} | found["evaluation"]
        return found

    @model_validator(mode="after")
    def _covers_games(self) -> "Suite":
        if "{game}" not in self.env_id and len(self.games) > 1:
            raise ValueError(f"env_id: expected {{game}} in it, found {self.env_id!r}")
        for what, there in (("steps", self.steps), ("normalisation: scores", self.normalisation.scores)):
            if missing := [game for game in self.games if game not in there]:
                raise ValueError(f"{what}: expected them for every game, found none for {', '.join(missing)}")
        return self

    def protocol(self, game: str) -> dict[str, Any]:
        """
        :return: what must be the same for two scores to stand in one table
        """
        return {
            "env_id": self.env_id.format(game=game),
            "steps": self.steps[game],
            "preprocessing": self.preprocessing,
            "evaluation": self.evaluation.model_dump(),
        }


def nearest_name(name: str, legal: Iterable[str]) -> str:
    """
    :return: the end of a message: the nearest legal name and all of them
    """
    names = sorted(legal)
    return f"{nearest(name, names)} There are {', '.join(names)}."


def human_scores(games: list[str]) -> dict[str, Any]:
    """
    :return: the normalisation of Atari 100K: random play 0, a human tester 1
    """
    table = load_reference().pivot(index="game", columns="method", values="mean")
    known = {game: table.loc[game.lower()] for game in games if game.lower() in table.index}
    scores = {game: [float(row[RANDOM]), float(row[HUMAN])] for game, row in known.items()}
    return {"unit": "human-normalised score", "source": "EqR paper, Table 2", "scores": scores}


def make_suite(name: str, where: str, entry: dict[str, Any]) -> Suite:
    """
    :param name: of the suite
    :param where: the file, for messages
    :param entry: as in suites.yml
    :raises ValueError: for an entry that is not complete, with what is wrong
    """
    where = f"{where}, suite {name!r}"
    if not isinstance(entry, dict):
        raise ValueError(f"{where}: expected keys and values, found {entry!r}")
    try:
        return Suite.model_validate({"name": name} | entry)
    except ValidationError as error:
        raise ValueError(f"{where}: {_first_mistake(error)}") from error


def _first_mistake(error: ValidationError) -> str:
    """In words: where it is, what was expected, what was found."""
    mistake = error.errors(include_url=False)[0]
    *outer, key = mistake["loc"] or ("",)
    path = ": ".join(map(str, mistake["loc"]))
    if mistake["type"] == "extra_forbidden":
        kinds: dict[str, type[Strict]] = {"evaluation": Evaluation, "curve": Curve, "normalisation": Normalisation}
        kind = kinds.get(str(outer[-1]), Suite) if outer else Suite
        return f"unknown key {path!r}.{nearest_name(str(key), kind.model_fields)}"
    if mistake["type"] == "missing":
        return f"expected the key {path!r}, found none"
    if mistake["type"] == "value_error":
        return f"{path}: {mistake['ctx']['error']}" if path else str(mistake["ctx"]["error"])
    return f"{path}: {mistake['msg'][0].lower()}{mistake['msg'][1:]}, found {mistake['input']!r}"


def load_suite(name: str, file: pathlib.Path | None = None) -> Suite:
    """
    :param name: of a suite
    :param file: one more file of suites; its names stand before ours
    :raises ValueError: for a suite that there is not, with the nearest name, or one that is not complete
    """
    entries = {key: (OWN_SUITES, entry) for key, entry in yaml.safe_load(OWN_SUITES.read_text(encoding="utf-8")).items()}
    if file is not None:
        if not file.is_file():
            raise ValueError(f"--suite-file: there is no file {file}")
        try:
            own = yaml.safe_load(file.read_text(encoding="utf-8"))
        except yaml.YAMLError as error:
            raise ValueError(f"{file} is no YAML: {error}") from error
        if not isinstance(own, dict):
            raise ValueError(f"{file}: expected suites by name, found {type(own).__name__}. See docs/benchmark.md.")
        entries |= {key: (file, entry) for key, entry in own.items()}
    if name not in entries:
        raise ValueError(
            f"--suite: there is no suite {name!r}.{nearest_name(name, entries)} A file with your own: --suite-file FILE."
        )
    path, entry = entries[name]
    return make_suite(name, path.name, entry)


def choose(suite: Suite, games: list[str] | None, steps: int | None) -> Suite:
    """
    :param suite: the suite
    :param games: those to keep, in any case; ``None``: all
    :param steps: instead of the suite's own
    :raises ValueError: for a game that the suite has not, with the nearest name, or that gymnasium has not
    """
    envs.register()
    kept = suite.games
    if games is not None:
        for game in games:
            if game.lower() not in map(str.lower, suite.games):
                raise ValueError(f"--games: suite {suite.name!r} has no game {game!r}.{nearest_name(game, suite.games)}")
        kept = [game for game in suite.games if game.lower() in map(str.lower, games)]
    per_game = suite.steps if steps is None else dict.fromkeys(kept, steps)
    for game in kept:
        env_id = suite.env_id.format(game=game)
        if env_id not in gym.registry:
            raise ValueError(
                f"suite {suite.name!r}: {env_id!r} is not registered with gymnasium."
                f'{nearest(env_id, gym.registry)} For Atari: pip install ".[atari]" in a clone of the repository.'
            )
    return suite.model_copy(update={"games": kept, "steps": per_game})


def write_suite(suite: Suite, path: pathlib.Path) -> None:
    """Write a suite whole, with everything that it leaves to its defaults."""
    with atomic_write(path, "yml") as file:
        file.write(yaml.safe_dump(suite.model_dump(), sort_keys=False).encode())


def read_suite(path: pathlib.Path) -> Suite:
    """
    :param path: of :func:`write_suite`
    """
    return Suite.model_validate(yaml.safe_load(path.read_text(encoding="utf-8")))
