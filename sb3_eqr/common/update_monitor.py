"""The metrics of each update, read when they are long computed, and the way back from an update that went wrong."""

from typing import Any, NamedTuple, NoReturn

import numpy as np
import torch as th
from torch import nn


class BadUpdateError(FloatingPointError):
    """An update whose metrics are not finite. Model and optimiser have been put back to after ``n_updates`` updates."""

    def __init__(self, message: str, n_updates: int):
        super().__init__(message)
        self.n_updates = n_updates


class Backup(NamedTuple):
    """Model and optimiser at the start of a round of updates."""

    n_updates: int
    model: dict[str, Any]
    optimizer: dict[str, Any]


class UpdateMonitor:
    """
    The metrics of each update, and the way back from an update that went wrong.

    Metrics stay on the device until the next round of updates, when they are long computed: no update waits for them.
    The losses of an update are computed before its step, so the first update of a round is what tells whether the
    round before left a sound model. That is why two backups are kept. They are made at the start of a round, but not of every
    one: a backup takes as long as some hundred small operations.

    :param model: whose parameters and buffers are kept
    :param optimizer: whose state is kept
    """

    INTERVAL = 50  # updates between two backups, at least

    def __init__(self, model: nn.Module, optimizer: th.optim.Optimizer):
        self._model = model
        self._optimizer = optimizer
        self._names: list[str] = []
        self._pending: list[th.Tensor] = []  # (len(names),) each
        self._round_start = 0  # updates done before it
        self._has_updates = False  # since the last backup
        self._last: Backup | None = None
        self._sound: Backup | None = None  # the one before: the metrics after it are known to be finite

    def forget(self) -> None:
        """The model is another one now: there is no way back to before."""
        self._pending.clear()
        self._last = self._sound = None

    def start_round(self, n_updates: int) -> None:
        """After so many updates, remember model and optimiser as they are, if the last backup is old enough."""
        self._round_start = n_updates
        if self._last is not None and n_updates < self._last.n_updates + self.INTERVAL:
            return
        if self._has_updates:  # a round without updates says nothing about the one before
            self._sound = self._last
        self._has_updates = False
        self._last = Backup(n_updates, _cloned(self._model.state_dict()), _cloned(self._optimizer.state_dict()))

    def add(self, metrics: dict[str, th.Tensor]) -> None:
        """Note the metrics of one update, scalars by name; the names are the same for all updates of a round."""
        self._has_updates = True
        self._names = list(metrics)
        self._pending.append(th.stack(list(metrics.values())))

    def collect(self) -> dict[str, float]:
        """
        Take in the metrics of the last round.

        :return: their means over the round; nothing if there was none
        :raises BadUpdateError: if one is NaN or infinite; model and optimiser are then as they last were sound
        """
        if not self._pending:
            return {}
        assert self._last is not None
        metrics = th.stack(self._pending).cpu().numpy()  # (updates, metrics)
        self._pending.clear()
        finite = np.isfinite(metrics)
        if finite.all():
            return dict(zip(self._names, metrics.mean(axis=0, dtype=np.float64).tolist(), strict=True))
        first = int(np.argmin(finite.all(axis=1)))
        bad_update = self._round_start + first + 1
        is_first = bad_update == self._last.n_updates + 1  # after the last backup, which may be of a spoilt model
        wrong = [f"{n} = {v}" for n, v, ok in zip(self._names, metrics[first], finite[first], strict=True) if not ok]
        self._roll_back(
            bad_update, "losses", ", ".join(wrong), self._sound if is_first and self._sound is not None else self._last
        )

    def check_model(self, n_updates: int) -> None:
        """
        What the losses cannot show: whether the last update has left finite parameters.

        :param n_updates: updates done
        :raises BadUpdateError: if not; model and optimiser are then as they last were sound
        """
        found = _largest(self._model.state_dict())
        if not np.isfinite(found):
            backups = [backup for backup in (self._last, self._sound) if backup and np.isfinite(_largest(backup.model))]
            self._roll_back(n_updates, "parameters", str(found), backups[0] if backups else None)

    def _roll_back(self, bad_update: int, what: str, found: str, sound: Backup | None) -> NoReturn:
        self._pending.clear()
        self._last = self._sound = None
        state = "There is no sound model to put back: load an earlier file."
        if sound is not None:
            self._model.load_state_dict(sound.model)
            self._optimizer.load_state_dict(sound.optimizer)
            state = f"The model was put back to update {sound.n_updates} and can be saved."
        raise BadUpdateError(
            f"update {bad_update}: expected finite {what}, found {found}. {state} "
            "Lower learning_rate or max_grad_norm, or check the scale of observations and rewards.",
            bad_update if sound is None else sound.n_updates,
        )


def _largest(state: dict[str, Any]) -> float:
    """The largest absolute number in a state dict: not finite if one of them is not."""
    tensors = [tensor for tensor in state.values() if tensor.is_floating_point() and tensor.numel()]
    return th.stack(th._foreach_norm(tensors, float("inf"))).max().item()


def _cloned(state: Any) -> Any:
    """A state dict with tensors of its own; a fifth of the time of ``deepcopy``."""
    if isinstance(state, dict):
        return {key: _cloned(value) for key, value in state.items()}
    return state.clone() if isinstance(state, th.Tensor) else state
