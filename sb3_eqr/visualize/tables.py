"""The diagnostics as tables, one CSV file each."""

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from sb3_eqr.common.saving.files import atomic_write
from sb3_eqr.visualize.diagnostics import Diagnostics
from sb3_eqr.visualize.findings import ActionSymmetry
from sb3_eqr.visualize.latents import names_of_factors


def all_tables(diagnostics: Diagnostics, actions: Sequence[str], factors: Sequence[str] = ()) -> dict[str, pd.DataFrame]:
    """
    :param diagnostics: see :func:`~sb3_eqr.visualize.diagnostics.diagnose`
    :param actions: names of the actions, (A,)
    :param factors: names of the true factors, (F,), if known
    :return: name of the file without suffix -> table, without those that say nothing about this agent; the order of columns is
        stable, new ones are added at the end
    """
    symmetry, collapse = diagnostics.action_symmetry, diagnostics.collapse._asdict()
    spectrum = {f"spectrum {i}": value for i, value in enumerate(collapse.pop("spectrum"))}
    n_windows = int(diagnostics.loss.n_windows[0])
    tables = {
        "transition": _transition(diagnostics),
        "collapse": _measures(collapse | spectrum),
        "rewards": _per_step(diagnostics.rewards._asdict()).assign(trained=diagnostics.rewards_trained),
        "summary": _measures({"verdict": diagnostics.verdict, **diagnostics.scalars, "windows": n_windows}),
    }
    if diagnostics.has_group:
        tables |= {"motion": _motion(diagnostics, actions), "generators": _generators(diagnostics, actions)}
    if diagnostics.compares_blocks:
        tables["disentanglement"] = _disentanglement(diagnostics, actions, factors)
    if symmetry is not None:
        row = (*symmetry, diagnostics.symmetry_trained)
        tables["action_symmetry"] = pd.DataFrame([row], columns=[*ActionSymmetry._fields, "trained"])
    return tables


def write_tables(tables: dict[str, pd.DataFrame], folder: pathlib.Path) -> None:
    """Write each table as CSV, to a temporary file that is renamed."""
    for name, table in tables.items():
        with atomic_write(folder / f"{name}.csv", "csv") as file:
            table.to_csv(file, index=False)


def _measures(values: dict[str, Any]) -> pd.DataFrame:
    return pd.DataFrame(values.items(), columns=["measure", "value"])


def _per_step(columns: dict[str, np.ndarray]) -> pd.DataFrame:
    table = pd.DataFrame(columns)
    table.insert(0, "steps_ahead", np.arange(1, len(table) + 1))
    return table


def _transition(diagnostics: Diagnostics) -> pd.DataFrame:
    columns = {"windows": diagnostics.loss.n_windows}
    for kind, errors in {"projection": diagnostics.loss, "latent": diagnostics.transition}.items():
        columns |= {f"{kind}_{name}": values for name, values in errors._asdict().items() if name != "n_windows"}
    return _per_step(columns)


def _motion(diagnostics: Diagnostics, actions: Sequence[str]) -> pd.DataFrame:
    predicted, observed = diagnostics.motion
    rows = [
        (a, name, block, predicted[a, k], observed[a, k])
        for a, name in enumerate(actions)
        for k, block in enumerate(diagnostics.blocks)
    ]
    return pd.DataFrame(rows, columns=["action", "action_name", "block", "predicted", "observed"])


def _generators(diagnostics: Diagnostics, actions: Sequence[str]) -> pd.DataFrame:
    rows = [
        (a, action, f"{part.group} {k}", name, part.mean[a, k, c], part.std[a, k, c])
        for a, action in enumerate(actions)
        for part in diagnostics.generators
        for k in range(part.mean.shape[1])
        for c, name in enumerate(part.names)
    ]
    return pd.DataFrame(rows, columns=["action", "action_name", "block", "coordinate", "mean", "std"])


def _disentanglement(diagnostics: Diagnostics, actions: Sequence[str], factors: Sequence[str]) -> pd.DataFrame:
    found, blocks = diagnostics.disentanglement, diagnostics.blocks
    pairs = [(i, j) for i in range(len(blocks)) for j in range(i + 1, len(blocks))]
    rows = [("opposite", actions[a], actions[b], np.nan) for a, b in enumerate(found.opposites) if a < b]
    rows += [("specificity", block, "", value) for block, value in zip(blocks, found.specificity, strict=True)]
    rows += [("redundancy", blocks[i], blocks[j], found.redundancy[i, j]) for i, j in pairs]
    if found.information is not None and found.gap is not None:
        names = names_of_factors(found.information.shape[1], factors)
        rows += [
            ("information", block, name, value)
            for block, values in zip(blocks, found.information, strict=True)
            for name, value in zip(names, values, strict=True)
        ]
        rows += [("gap", "", name, value) for name, value in zip(names, found.gap, strict=True)]
    return pd.DataFrame(rows, columns=["measure", "of", "with", "value"])
