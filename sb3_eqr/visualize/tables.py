"""The diagnostics as tables, one CSV file each."""

import pathlib
from collections.abc import Sequence

import numpy as np
import pandas as pd

from sb3_eqr.common.saving.files import atomic_write
from sb3_eqr.visualize.diagnostics import Diagnostics, skill_and_gain
from sb3_eqr.visualize.findings import ActionSymmetry
from sb3_eqr.visualize.measures import mean_of_known


def all_tables(diagnostics: Diagnostics, actions: Sequence[str], factors: Sequence[str] = ()) -> dict[str, pd.DataFrame]:
    """
    :param diagnostics: see :func:`~sb3_eqr.visualize.diagnostics.diagnose`
    :param actions: names of the actions, (A,)
    :param factors: names of the true factors, (F,), if known
    :return: name of the file without suffix -> table; the order of columns is stable, new ones are added at the end
    """
    return {
        "transition": _transition(diagnostics),
        "motion": _motion(diagnostics, actions),
        "generators": _generators(diagnostics, actions),
        "disentanglement": _disentanglement(diagnostics, actions, factors),
        "action_symmetry": pd.DataFrame(
            [(*diagnostics.action_symmetry, diagnostics.symmetry_trained)] if diagnostics.action_symmetry else [],
            columns=[*ActionSymmetry._fields, "trained"],
        ),
        "collapse": _collapse(diagnostics),
        "rewards": _per_step(diagnostics.rewards._asdict()).assign(trained=diagnostics.rewards_trained),
        "summary": _summary(diagnostics),
    }


def write_tables(tables: dict[str, pd.DataFrame], folder: pathlib.Path) -> None:
    """Write each table as CSV, to a temporary file that is renamed."""
    for name, table in tables.items():
        with atomic_write(folder / f"{name}.csv", "csv") as file:
            table.to_csv(file, index=False)


def _per_step(columns: dict[str, np.ndarray]) -> pd.DataFrame:
    n = len(next(iter(columns.values())))
    return pd.DataFrame({"steps_ahead": np.arange(1, n + 1), **columns})


def _transition(diagnostics: Diagnostics) -> pd.DataFrame:
    loss = diagnostics.loss._asdict()
    n_windows = loss.pop("n_windows")
    latent = {name: values for name, values in diagnostics.transition._asdict().items() if name != "n_windows"}
    projected = {"loss" if name == "error" else f"loss_{name}": values for name, values in loss.items()}
    return _per_step({"windows": n_windows, **latent, **projected})


def _motion(diagnostics: Diagnostics, actions: Sequence[str]) -> pd.DataFrame:
    motion = diagnostics.motion
    return pd.DataFrame(
        {"action": a, "action_name": actions[a], "block": block, "predicted": predicted, "observed": observed}
        for a in range(len(actions))
        for block, predicted, observed in zip(diagnostics.blocks, motion.predicted[a], motion.observed[a], strict=True)
    )


def _generators(diagnostics: Diagnostics, actions: Sequence[str]) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "action": a,
            "action_name": actions[a],
            "block": f"{part.group} {k}",
            "coordinate": name,
            "mean": part.mean[a, k, c],
            "std": part.std[a, k, c],
        }
        for a in range(len(actions))
        for part in diagnostics.generators
        for k in range(part.mean.shape[1])
        for c, name in enumerate(part.names)
    )


def _disentanglement(diagnostics: Diagnostics, actions: Sequence[str], factors: Sequence[str]) -> pd.DataFrame:
    found, blocks = diagnostics.disentanglement, diagnostics.blocks
    rows: list[tuple[str, str, str, float]] = [
        ("opposite", actions[a], actions[b], np.nan) for a, b in enumerate(found.opposites) if a < b
    ]
    rows += [("specificity", block, "", value) for block, value in zip(blocks, found.specificity, strict=True)]
    rows += [
        ("redundancy", blocks[i], blocks[j], found.redundancy[i, j])
        for i in range(len(blocks))
        for j in range(i + 1, len(blocks))
    ]
    if found.information is not None and found.gap is not None:
        names = factor_names(found.information.shape[1], factors)
        rows += [
            ("information", block, name, value)
            for block, values in zip(blocks, found.information, strict=True)
            for name, value in zip(names, values, strict=True)
        ]
        rows += [("gap", "", name, value) for name, value in zip(names, found.gap, strict=True)]
    return pd.DataFrame(rows, columns=["measure", "of", "with", "value"])


def factor_names(n_factors: int, names: Sequence[str]) -> list[str]:
    """:return: the names if their number is right, or else numbers"""
    return list(names) if len(names) == n_factors else [f"factor {i}" for i in range(n_factors)]


def _collapse(diagnostics: Diagnostics) -> pd.DataFrame:
    found = diagnostics.collapse._asdict()
    values = found.pop("spectrum")
    return pd.DataFrame(
        [*found.items(), *((f"spectrum {i}", value) for i, value in enumerate(values))], columns=["measure", "value"]
    )


def _summary(diagnostics: Diagnostics) -> pd.DataFrame:
    skill, gain = skill_and_gain(diagnostics.loss)
    apart = ~np.eye(len(diagnostics.blocks), dtype=bool)
    redundancy = diagnostics.disentanglement.redundancy[apart]
    rows = [
        ("verdict", diagnostics.verdict),
        ("skill", skill),
        ("gain", gain),
        ("effective_rank", diagnostics.collapse.effective_rank),
        ("dimensions", diagnostics.collapse.dimensions),
        ("spread", diagnostics.collapse.spread),
        ("dead_units", diagnostics.collapse.dead_units),
        ("specificity", mean_of_known(diagnostics.disentanglement.specificity)),
        ("redundancy", mean_of_known(redundancy)),
        ("gap", np.nan if diagnostics.disentanglement.gap is None else mean_of_known(diagnostics.disentanglement.gap)),
        ("reward_explained", mean_of_known(diagnostics.rewards.explained)),
        ("windows", int(diagnostics.loss.n_windows[0])),
    ]
    return pd.DataFrame(rows, columns=["measure", "value"])
