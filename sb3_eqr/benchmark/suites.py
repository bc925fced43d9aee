"""Suites: the games, steps, preprocessing, evaluation protocol and normalisation of a benchmark."""

import dataclasses
import pathlib
from collections.abc import Iterable
from typing import Any

import gymnasium as gym
import yaml

from sb3_eqr import envs
from sb3_eqr.benchmark.reference import HUMAN, RANDOM, load_reference
from sb3_eqr.common.arguments import number
from sb3_eqr.common.files import atomic_write
from sb3_eqr.common.validation import check_number
from sb3_eqr.zoo.checks import nearest

OWN_SUITES = pathlib.Path(__file__).with_name("suites.yml")
EVALUATION = {"episodes", "n_envs", "epsilon", "max_steps", "preprocessing", "curve"}
CURVE = {"points", "episodes"}
NORMALISATION = {"unit", "source", "scores"}


@dataclasses.dataclass(frozen=True)
class Suite:
    """
    :param name: of the suite
    :param games: names as users write them
    :param env_id: gymnasium's name of a game's environment, "{game}" standing for the game
    :param steps: training steps of the agent, per game
    :param preprocessing: keys of RL Zoo's entries (``env_wrapper``, ``frame_stack``, ...) that stand before an agent's own
    :param evaluation: episodes, n_envs, epsilon, max_steps (``None``: no limit), preprocessing (of evaluation), curve:
        {points, episodes}: the learning curve has ``points`` points of ``episodes`` episodes, the last being the final one
    :param normalisation: unit, source, scores: game -> [score that is 0, score that is 1]
    """

    name: str
    games: list[str]
    env_id: str
    steps: dict[str, int]
    preprocessing: dict[str, Any]
    evaluation: dict[str, Any]
    normalisation: dict[str, Any]

    def protocol(self, game: str) -> dict[str, Any]:
        """
        :return: what must be the same for two scores to stand in one table
        """
        return {
            "env_id": self.env_id.format(game=game),
            "steps": self.steps[game],
            "preprocessing": self.preprocessing,
            "evaluation": self.evaluation,
        }


def nearest_name(name: str, legal: Iterable[str]) -> str:
    """
    :return: the end of a message: the nearest legal name and all of them
    """
    names = sorted(legal)
    return f"{nearest(name, names)} There are {', '.join(names)}."


def check_keys(where: str, found: Iterable[str], legal: set[str], needed: set[str]) -> None:
    """
    :raises ValueError: for a key that there is not, or one that is missing
    """
    for key in found:
        if key not in legal:
            raise ValueError(f"{where}: unknown key {key!r}.{nearest_name(key, legal)}")
    if missing := needed - set(found):
        raise ValueError(f"{where}: expected the keys {', '.join(sorted(needed))}, found no {', '.join(sorted(missing))}")


def check_mapping(where: str, value: Any) -> dict[str, Any]:
    """
    :raises ValueError: if it is no mapping
    """
    if not isinstance(value, dict):
        raise ValueError(f"{where}: expected keys and values, found {value!r}")
    return value


def check_scores(where: str, scores: Any) -> None:
    """
    :raises ValueError: for anything but two finite numbers, the second above the first: what becomes 0 and what becomes 1
    """
    is_pair = isinstance(scores, (list, tuple)) and len(scores) == 2
    if not (is_pair and all(map(number().holds, scores)) and scores[0] < scores[1]):
        raise ValueError(f"{where}: expected the scores that become 0 and 1, the second above the first, found {scores!r}")


def human_scores(games: list[str]) -> dict[str, Any]:
    """
    :return: the normalisation of Atari 100K: random play 0, a human tester 1
    """
    table = load_reference().pivot(index="game", columns="method", values="mean")
    scores = {}
    for game in games:
        row = table.index[table.index == game.lower()]
        if len(row):
            scores[game] = [float(table.at[row[0], RANDOM]), float(table.at[row[0], HUMAN])]
    return {"unit": "human-normalised score", "source": "EqR paper, Table 2", "scores": scores}


def make_suite(name: str, where: str, entry: dict[str, Any]) -> Suite:
    """
    :param name: of the suite
    :param where: the file, for messages
    :param entry: as in suites.yml
    :raises ValueError: for an entry that is not complete, with what is wrong
    """
    where = f"{where}, suite {name!r}"
    check_mapping(where, entry)
    needed = {"env_id", "games", "steps", "evaluation"}
    check_keys(where, entry, needed | {"preprocessing", "normalisation"}, needed)
    if not isinstance(entry["games"], list) or not entry["games"]:
        raise ValueError(f"{where}: games: expected a list, found {entry['games']!r}")
    if "{game}" not in str(entry["env_id"]) and len(entry["games"]) > 1:
        raise ValueError(f"{where}: env_id: expected {{game}} in it, found {entry['env_id']!r}")
    games = [str(game) for game in entry["games"]]
    steps = entry["steps"] if isinstance(entry["steps"], dict) else dict.fromkeys(games, entry["steps"])
    if missing := [game for game in games if game not in steps]:
        raise ValueError(f"{where}: expected steps for every game, found none for {', '.join(missing)}")
    if wrong := [game for game in games if not (isinstance(steps[game], int) and steps[game] > 0)]:
        raise ValueError(f"{where}: steps: expected whole numbers above 0, found {steps[wrong[0]]!r} for {wrong[0]}")
    evaluation = {"max_steps": None, "preprocessing": entry.get("preprocessing", {}), "epsilon": 0.0}
    evaluation |= check_mapping(f"{where}: evaluation", entry["evaluation"])
    check_keys(f"{where}: evaluation", evaluation, EVALUATION, EVALUATION)
    check_keys(f"{where}: evaluation: curve", check_mapping(f"{where}: curve", evaluation["curve"]), CURVE, CURVE)
    for key in ("episodes", "n_envs"):
        check_number(f"{where}: evaluation: {key}", evaluation[key], 1, whole=True)
    for key in CURVE:
        check_number(f"{where}: evaluation: curve: {key}", evaluation["curve"][key], 1, whole=True)
    check_number(f"{where}: evaluation: epsilon", evaluation["epsilon"], 0, 1)
    normalisation = entry.get("normalisation", {"unit": "raw score", "source": "none", "scores": {g: [0, 1] for g in games}})
    if normalisation == "human":
        normalisation = human_scores(games)
    check_keys(
        f"{where}: normalisation", check_mapping(f"{where}: normalisation", normalisation), NORMALISATION, NORMALISATION
    )
    if missing := [game for game in games if game not in normalisation["scores"]]:
        raise ValueError(f"{where}: normalisation: expected two scores for every game, found none for {', '.join(missing)}")
    for game in games:
        check_scores(f"{where}: normalisation: {game}", normalisation["scores"][game])
    return Suite(
        name,
        games,
        entry["env_id"],
        {game: steps[game] for game in games},
        entry.get("preprocessing", {}),
        evaluation,
        normalisation,
    )


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
    if games is not None:
        by_name = {game.lower(): game for game in suite.games}
        for game in games:
            if game.lower() not in by_name:
                raise ValueError(f"--games: suite {suite.name!r} has no game {game!r}.{nearest_name(game, suite.games)}")
        kept = {game.lower() for game in games}
        suite = dataclasses.replace(suite, games=[game for game in suite.games if game.lower() in kept])
    if steps is not None:
        suite = dataclasses.replace(suite, steps=dict.fromkeys(suite.games, steps))
    for game in suite.games:
        env_id = suite.env_id.format(game=game)
        if env_id not in gym.registry:
            raise ValueError(
                f"suite {suite.name!r}: {env_id!r} is not registered with gymnasium."
                f'{nearest(env_id, gym.registry)} For Atari: pip install "sb3-eqr[atari]".'
            )
    return suite


def write_suite(suite: Suite, path: pathlib.Path) -> None:
    """Write a suite whole, with everything that it leaves to its defaults."""
    with atomic_write(path, "yml") as file:
        file.write(yaml.safe_dump(dataclasses.asdict(suite), sort_keys=False).encode())


def read_suite(path: pathlib.Path) -> Suite:
    """
    :param path: of :func:`write_suite`
    """
    return Suite(**yaml.safe_load(path.read_text(encoding="utf-8")))
