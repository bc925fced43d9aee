"""Scores as data: those of a benchmark's runs, and those of other methods' runs from a file."""

import pathlib
from collections.abc import Iterable
from statistics import fmean
from typing import Annotated, Any

import numpy as np
import pandas as pd
from annotated_types import Len
from pydantic import FiniteFloat, TypeAdapter, ValidationError

from sb3_eqr.benchmark.packed import read
from sb3_eqr.benchmark.reference import plain_game

# game -> scores of runs
RUNS = TypeAdapter(Annotated[dict[str, Annotated[list[FiniteFloat], Len(1)]], Len(1)], config={"strict": True})


def load_scores(folder: str | pathlib.Path) -> pd.DataFrame:
    """
    Load every episode of every finished run of a benchmark.

    :param folder: folder of the benchmark, or a file of ``sb3-eqr benchmark pack``
    :return: a row per episode: agent, game, seed, step, kind ("curve" or "final" for evaluations, or "training"), episode
        (counted from 0 within an evaluation, or within training), score (raw), length (agent steps, in
        training on Atari raw frames; NaN if not recorded)
    :raises ValueError: for a folder without finished runs
    """
    frames = []
    for row in read(pathlib.Path(folder))[1]:
        if "stopped_at" in row:
            continue
        training = row["training"]
        parts = [(part["step"], part["kind"], part["scores"], part["lengths"]) for part in row["evaluations"]]
        for step, kind, scores, lengths in [*parts, (training["step"], "training", training["score"], training["length"])]:
            run = {"agent": row["agent"], "game": row["game"], "seed": row["seed"]}
            part = {"step": step, "kind": kind, "episode": range(len(scores)), "score": scores, "length": lengths or np.nan}
            frames.append(pd.DataFrame(run | part))
    if not frames:
        raise ValueError(f"{folder} must be the folder of a benchmark, got one without finished runs.")
    return pd.concat(frames, ignore_index=True)


def final_score(result: dict[str, Any]) -> float:
    """:return: the mean raw score of its final evaluation"""
    return fmean(score for part in result["evaluations"] if part["kind"] == "final" for score in part["scores"])


def evaluation_curve(result: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """:return: steps (points,), mean raw scores (points,) of its evaluations during training, including the final one"""
    ordered = sorted(result["evaluations"], key=lambda part: part["kind"] == "final")  # the final one overrides
    found = {part["step"]: np.mean(part["scores"]) for part in ordered if part["scores"]}
    steps = sorted(found)
    return np.array(steps), np.array([found[step] for step in steps])


def normalised(raw: Any, bounds: tuple[float, float]) -> Any:
    """:return: a score or an array of scores, of which the first bound becomes 0 and the second 1"""
    low, high = bounds
    return (raw - low) / (high - low)


def read_runs(path: pathlib.Path, name: str, games: Iterable[str]) -> pd.DataFrame:
    """
    Read scores of another method's runs, in rliable's format: {"Alien": [812.0, 640.5, ...], ...}.

    :param path: a JSON file: game, in any spelling -> raw scores, one per run; other games are left out
    :param name: name of the method
    :return: columns agent, game, seed, raw; for every game the first runs, as many as the game with the fewest has; if
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
    by_plain = {plain_game(game): scores for game, scores in content.items()}
    wanted = {game: by_plain.get(plain_game(game), []) for game in games}
    if missing := [game for game, scores in wanted.items() if not scores]:
        raise ValueError(
            f"--reference {name}: {path} must contain scores for {', '.join(wanted)}, got none for {', '.join(missing)}, "
            f"only for {', '.join(content)}. Add them, correct their names, or report without this reference."
        )
    runs = min(map(len, wanted.values()))
    rows = [(name, game, seed, score) for game, scores in wanted.items() for seed, score in enumerate(scores[:runs])]
    table = pd.DataFrame(rows, columns=["agent", "game", "seed", "raw"])
    if max(map(len, wanted.values())) > runs:
        table.attrs["note"] = f"{name}: the first {runs} runs of every game only, as many as all of them have."
    return table
