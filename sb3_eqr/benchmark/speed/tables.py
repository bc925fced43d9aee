"""What is found, as tables: text for people, rows for JSON. And whether a cost grows faster than its arithmetic."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

TOLERANCE = 1.25  # of the growth of a time: caches, and a machine that is not always as fast


@dataclass(frozen=True)
class Table:
    """
    :param name: its key in the JSON file
    :param title: its heading
    :param formats: key of a row -> how its value is printed; the key heads the column
    :param rows: by key; None is printed as a dash
    :param notes: lines below it
    """

    name: str
    title: str
    formats: dict[str, str]
    rows: list[dict[str, Any]]
    notes: list[str] = field(default_factory=list)

    def text(self) -> str:
        """Title, aligned columns, notes."""
        heads = ["growth" if key.endswith("_growth") else key.replace("_", " ") for key in self.formats]
        body = [[_shown(row[key], spec) for key, spec in self.formats.items()] for row in self.rows]
        widths = [max(map(len, column)) for column in zip(heads, *body, strict=True)]
        lines = [
            "  ".join(cell.rjust(width) if place else cell.ljust(width) for place, (cell, width) in enumerate(cells)).rstrip()
            for cells in (list(zip(row, widths, strict=True)) for row in ([heads, *body] if body else []))
        ]
        return "\n".join([self.title, *lines, *self.notes])

    def data(self) -> dict[str, Any]:
        """For JSON, five digits of each figure."""
        rows = [{key: _rounded(value) for key, value in row.items()} for row in self.rows]
        return {"title": self.title, "rows": rows, "notes": self.notes}


def _shown(value: Any, spec: str) -> str:
    return "-" if value is None else format(value, spec)


def _rounded(value: Any) -> Any:
    return float(f"{value:.5g}") if isinstance(value, float) else value


def growth(costs: Sequence[float], arithmetic: Sequence[float]) -> list[float]:
    """
    :param costs: times, from the smallest size on
    :param arithmetic: what has to be computed, in any unit, at the same sizes
    :return: how many times as fast as the arithmetic the cost has grown since the smallest size
    """
    return [(cost / costs[0]) / (work / arithmetic[0]) for cost, work in zip(costs, arithmetic, strict=True)]


def verdict(growths: Sequence[float]) -> str:
    """
    :param growths: of :func:`growth`, of one size or of many
    """
    return "ok" if max(growths) <= TOLERANCE else "grows faster"


@dataclass(frozen=True)
class Sweep:
    """
    Costs at several sizes of one thing.

    :param name: its key in the JSON file
    :param title: its heading
    :param size: what is varied
    :param sizes: from small to large, or names
    :param costs: what -> milliseconds at each size
    :param arithmetic: what -> how much is to be computed at each size, in any unit; the same keys
    :param unit: what that arithmetic is
    :param details: further columns: values at each size and their format
    """

    name: str
    title: str
    size: str
    sizes: list[Any]
    costs: dict[str, list[float]]
    arithmetic: dict[str, list[float]]
    unit: str
    details: dict[str, tuple[list[Any], str]] = field(default_factory=dict)

    def table(self) -> Table:
        """Sizes, details, and each cost beside its growth."""
        growths = {what: growth(costs, self.arithmetic[what]) for what, costs in self.costs.items()}
        formats = {self.size: "" if isinstance(self.sizes[0], str) else ",d"}
        formats |= {key: spec for key, (_, spec) in self.details.items()}
        for what in self.costs:
            formats |= {what: ".3f" if max(self.costs[what]) < 1 else ".2f", f"{what}_growth": ".2f"}
        formats["verdict"] = ""
        rows = []
        for place, size in enumerate(self.sizes):
            row = {self.size: size} | {key: values[place] for key, (values, _) in self.details.items()}
            for what, costs in self.costs.items():
                row |= {what: costs[place], f"{what}_growth": growths[what][place]}
            row["verdict"] = verdict([values[place] for values in growths.values()])
            rows.append(row)
        notes = [f"growth of the time to its left since the first row, over that of the arithmetic: {self.unit}"]
        return Table(self.name, self.title, formats, rows, [*notes, f"ok up to {TOLERANCE}"])
