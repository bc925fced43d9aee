"""Collects the metrics of updates without waiting for the device, and finds updates that are not finite."""

from typing import NoReturn

import numpy as np
import torch as th
from torch import nn


class UpdateMonitor:
    """
    Collects the metrics of each update of ``model``. They stay on the device until the next round of updates, so no update
    waits for them.
    """

    def __init__(self, model: nn.Module):
        self._model = model
        self._names: list[str] = []
        self._pending: list[th.Tensor] = []  # (len(names),) each
        self._round_start = 0  # number of updates before the current round

    def forget(self) -> None:
        """Discard metrics, because the model was replaced."""
        self._pending.clear()

    def start_round(self, n_updates: int) -> None:
        """A round of updates begins after ``n_updates`` updates."""
        self._round_start = n_updates

    def add(self, metrics: dict[str, th.Tensor]) -> None:
        """Add the metrics of one update, scalars by name; all updates of a round have the same names."""
        self._names = list(metrics)
        self._pending.append(th.stack(list(metrics.values())))

    def collect(self, step: int) -> list[dict[str, float]]:
        """The metrics of each update of the last round, by name; raises FloatingPointError if one is NaN or infinite."""
        if not self._pending:
            return []
        metrics = th.stack(self._pending).cpu().numpy()  # (updates, metrics)
        self._pending.clear()
        finite = np.isfinite(metrics)
        if not finite.all():
            first = int(np.argmin(finite.all(axis=1)))
            wrong = [f"{n} = {v}" for n, v, ok in zip(self._names, metrics[first], finite[first], strict=True) if not ok]
            self._refuse(step, self._round_start + first + 1, "losses", ", ".join(wrong))
        return [dict(zip(self._names, update, strict=True)) for update in metrics.tolist()]

    def check_losses(self, losses: dict[str, float], n_updates: int, step: int) -> None:
        """Raise FloatingPointError if one of the losses is not finite after ``n_updates``."""
        if wrong := [f"{name} = {value}" for name, value in losses.items() if not np.isfinite(value)]:
            self._refuse(step, n_updates, "losses", ", ".join(wrong))

    def check_model(self, n_updates: int, step: int) -> None:
        """Raise FloatingPointError if the parameters are not finite after ``n_updates``: the last losses cannot show it."""
        parameters = [tensor.detach() for tensor in self._model.parameters() if tensor.is_floating_point() and tensor.numel()]
        found = th.stack(th._foreach_norm(parameters, float("inf"))).max().item()  # the largest absolute value
        if not np.isfinite(found):
            self._refuse(step, n_updates, "parameters", str(found))

    def _refuse(self, step: int, update: int, what: str, found: str) -> NoReturn:
        raise FloatingPointError(
            f"step {step}, update {update}: {what} must be finite, got {found}. The model is spoilt and cannot be saved: load "
            "the last checkpoint, and lower learning_rate, or check the scale of observations and rewards."
        )
