"""Scores as data: what the runs of a benchmark have written."""

import json
import pathlib
from typing import Any

import pandas as pd

from sb3_eqr.benchmark.run import RESULT


def load_results(folder: pathlib.Path) -> list[dict[str, Any]]:
    """
    :param folder: of a benchmark
    :return: ``result.json`` of every finished run
    """
    paths = sorted(folder.glob(f"runs/*/*/*/{RESULT}"))
    return [json.loads(path.read_text(encoding="utf-8")) for path in paths]


def score_table(results: list[dict[str, Any]]) -> pd.DataFrame:
    """
    :param results: of :func:`load_results`
    :return: a row per episode: agent, game, seed, step, kind ("curve" or "final": evaluations; "training"), episode (counted
        from 0 within an evaluation, or within training), score (raw), length (agent steps)
    """
    frames = []
    for result in results:
        parts = [(row["kind"], row["step"], row["scores"], row["lengths"]) for row in result["evaluations"]]
        training = result["training"]
        parts.append(("training", training["step"], training["score"], training["length"]))
        for kind, step, scores, lengths in parts:
            rows = {"step": step, "kind": kind, "episode": range(len(scores)), "score": scores, "length": lengths}
            frames.append(pd.DataFrame(rows).assign(agent=result["agent"], game=result["game"], seed=result["seed"]))
    columns = ["agent", "game", "seed", "step", "kind", "episode", "score", "length"]
    return pd.concat(frames, ignore_index=True)[columns] if frames else pd.DataFrame(columns=columns)


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
