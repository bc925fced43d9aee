"""Scores as data: those of a benchmark's runs, and those of other methods' runs from a file."""

import pathlib
from collections.abc import Iterable
from typing import Annotated, Any

import numpy as np
import pandas as pd
from annotated_types import Len
from pydantic import FiniteFloat, TypeAdapter, ValidationError

from sb3_eqr.benchmark.packed import read
from sb3_eqr.benchmark.reference import plain_game

# game -> scores of runs
RUNS = TypeAdapter(Annotated[dict[str, Annotated[list[FiniteFloat], Len(1)]], Len(1)], config={"strict": True})
COLUMNS = ["agent", "game", "seed", "step", "kind", "episode", "score", "length"]


def score_table(results: list[dict[str, Any]]) -> pd.DataFrame:
    """
    :param results: rows of finished runs, see :func:`~sb3_eqr.benchmark.packed.read`
    :return: a row per episode: agent, game, seed, step, kind ("curve" or "final" for evaluations, or "training"), episode
        (counted from 0 within an evaluation, or within training), score (raw), length (agent steps)
    """
    frames = []
    for result in results:
        training = result["training"]
        parts = [(row["kind"], row["step"], row["scores"], row["lengths"]) for row in result["evaluations"]]
        for kind, step, scores, lengths in [*parts, ("training", training["step"], training["score"], training["length"])]:
            rows = {"step": step, "kind": kind, "episode": range(len(scores)), "score": scores, "length": lengths}
            frames.append(pd.DataFrame(rows).assign(agent=result["agent"], game=result["game"], seed=result["seed"]))
    return pd.concat(frames, ignore_index=True)[COLUMNS] if frames else pd.DataFrame(columns=COLUMNS)


def load_scores(folder: str | pathlib.Path) -> pd.DataFrame:
    """
    Load every episode of every finished run of a benchmark.

    :param folder: folder of the benchmark, or a file of ``sb3-eqr benchmark pack``
    :return: see :func:`score_table`
    :raises ValueError: for a folder without finished runs
    """
    results = [row for row in read(pathlib.Path(folder))[1] if "stopped_at" not in row]
    if not results:
        raise ValueError(f"{folder} must be the folder of a benchmark, got one without finished runs.")
    return score_table(results)


def evaluation_curve(result: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """:return: steps (points,), mean raw scores (points,) of its evaluations during training, including the final one"""
    found: dict[int, float] = {}
    for evaluation in sorted(result["evaluations"], key=lambda row: row["kind"] == "final"):  # the final one overrides
        if evaluation["scores"]:
            found[evaluation["step"]] = float(np.mean(evaluation["scores"]))
    steps = sorted(found)
    return np.array(steps), np.array([found[step] for step in steps])


def read_runs(path: pathlib.Path, name: str, games: Iterable[str]) -> pd.DataFrame:
    """
    Read scores of another method's runs, in rliable's format: {"Alien": [812.0, 640.5, ...], ...}.

    :param path: a JSON file: game, in any spelling -> raw scores, one per run; other games are left out
    :param name: name of the method
    :return: columns agent, game, seed, score; for every game the first runs, as many as the game with the fewest has; if
        that leaves some out, ``attrs["note"]`` says so
    :raises ValueError: for a file that is not JSON or has another form, and for missing games
    """
    expected = f'--reference {name}: {path} must contain {{"Game": [score, score, ...], ...}} with a raw score per run'
    try:
        content = RUNS.validate_json(pathlib.Path(path).read_bytes())
    except OSError as error:
        raise ValueError(f"{expected}, got no readable file: {error.strerror}.") from error
    except ValidationError as error:
        mistake = error.errors()[0]
        where = "".join(f"{place}: " for place in mistake["loc"])
        raise ValueError(f"{expected}, got {where}{mistake['msg']}. Write its runs as lists of finite numbers.") from error
    by_plain, games = {plain_game(game): scores for game, scores in content.items()}, list(games)
    if missing := [game for game in games if plain_game(game) not in by_plain]:
        raise ValueError(
            f"--reference {name}: {path} must contain scores for {', '.join(games)}, got none for {', '.join(missing)}, "
            f"only for {', '.join(content)}. Add them, correct their names, or report without this reference."
        )
    wanted = {game: by_plain[plain_game(game)] for game in games}
    runs = min(map(len, wanted.values()))
    rows = [(name, game, seed, float(score)) for game in games for seed, score in enumerate(wanted[game][:runs])]
    table = pd.DataFrame(rows, columns=["agent", "game", "seed", "score"])
    if max(map(len, wanted.values())) > runs:
        table.attrs["note"] = f"{name}: the first {runs} runs of every game only, as many as all of them have."
    return table
