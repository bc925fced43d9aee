"""Scores as data: what the runs of a benchmark have written."""

import json
import pathlib
from typing import Any

import numpy as np
import pandas as pd

from sb3_eqr.benchmark.runs import RESULT

COLUMNS = ["agent", "game", "seed", "step", "kind", "episode", "score", "length"]


def load_results(folder: pathlib.Path) -> list[dict[str, Any]]:
    """:return: ``result.json`` of every finished run of a benchmark"""
    return [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob(f"runs/*/*/*/{RESULT}"))]


def score_table(results: list[dict[str, Any]]) -> pd.DataFrame:
    """
    :param results: of :func:`load_results`
    :return: a row per episode: agent, game, seed, step, kind ("curve" or "final": evaluations; "training"), episode (counted
        from 0 within an evaluation, or within training), score (raw), length (agent steps)
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
    Every episode of every finished run of a benchmark.

    :param folder: of the benchmark
    :return: see :func:`score_table`
    :raises ValueError: for a folder without finished runs
    """
    results = load_results(pathlib.Path(folder))
    if not results:
        raise ValueError(f"{folder}: expected the folder of a benchmark, found no finished run in it")
    return score_table(results)


def evaluation_curve(result: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """
    :param result: of a run
    :return: steps (points,), mean raw scores (points,) of its evaluations along training, the final one included
    """
    found: dict[int, float] = {}
    for evaluation in sorted(result["evaluations"], key=lambda row: row["kind"] == "final"):  # the final one wins at its step
        if evaluation["scores"]:
            found[evaluation["step"]] = float(np.mean(evaluation["scores"]))
    steps = sorted(found)
    return np.array(steps), np.array([found[step] for step in steps])
