"""The figures of each update, read when they are long computed, and the way back from an update that went wrong."""

from typing import NamedTuple

import numpy as np
import torch as th
from torch import nn


class BadUpdateError(FloatingPointError):
    """
    An update whose figures are not finite. Model and optimiser have been put back.

    :param message: what was found
    :param n_updates: the number of updates that the model is left with
    """

    def __init__(self, message: str, n_updates: int):
        super().__init__(message)
        self.n_updates = n_updates


class Backup(NamedTuple):
    """Model and optimiser at the start of a round of updates."""

    n_updates: int
    model: list[th.Tensor]
    optimizer: dict[tuple[th.Tensor, str], th.Tensor]


class UpdateMonitor:
    """
    The figures of each update, read when they are asked for, and the way back from an update that went wrong.

    Figures stay on the device until the next round of updates, when they are long computed: no update waits for them.
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
        self._start: Backup | None = None  # the last one
        self._sound_start: Backup | None = None  # the one before: the figures after it are known to be finite

    def forget(self) -> None:
        """The model is another one now: there is no way back to before."""
        self._pending.clear()
        self._start = self._sound_start = None

    def start_round(self, n_updates: int) -> None:
        """
        Remember model and optimiser as they are now, if the last backup is old enough.

        :param n_updates: updates done so far
        """
        self._round_start = n_updates
        if self._start is not None and n_updates < self._start.n_updates + self.INTERVAL:
            return
        model, state = self._model_tensors(), self._optimizer_tensors()
        old = self._start
        if self._has_updates:  # a round without updates says nothing about the one before
            old, self._sound_start = self._sound_start, self._start
        self._has_updates = False
        if old is None or old.optimizer.keys() != state.keys():  # the first rounds: make room
            kept = [tensor.clone() for tensor in model], {key: tensor.clone() for key, tensor in state.items()}
        else:
            kept = old.model, old.optimizer
            th._foreach_copy_([*kept[0], *kept[1].values()], [*model, *(state[key] for key in kept[1])])
        self._start = Backup(n_updates, *kept)

    def add(self, figures: dict[str, th.Tensor]) -> None:
        """
        :param figures: of one update, scalars; the names are the same for all updates of a round
        """
        self._has_updates = True
        self._names = list(figures)
        self._pending.append(th.stack(list(figures.values())))

    def collect(self) -> dict[str, float]:
        """
        Take in the figures of the last round.

        :return: their means over the round; nothing if there was none
        :raises BadUpdateError: if one is NaN or infinite; model and optimiser are then as they last were sound
        """
        if not self._pending:
            return {}
        assert self._start is not None
        figures = th.stack(self._pending).cpu().numpy()  # (updates, figures)
        self._pending.clear()
        finite = np.isfinite(figures)
        if finite.all():
            return dict(zip(self._names, figures.mean(axis=0, dtype=np.float64).tolist(), strict=True))
        first = int(np.argmin(finite.all(axis=1)))
        bad_update = self._round_start + first + 1
        is_first = bad_update == self._start.n_updates + 1  # after the last backup, which may be of a spoilt model
        sound = self._sound_start if is_first and self._sound_start is not None else self._start
        self._put_back(sound)
        wrong = [f"{n} = {v}" for n, v, ok in zip(self._names, figures[first], finite[first], strict=True) if not ok]
        raise BadUpdateError(
            f"update {bad_update}: expected finite losses, found {', '.join(wrong)}. "
            f"The model was put back to update {sound.n_updates} and can be saved. "
            "Lower learning_rate or max_grad_norm, or check the scale of observations and rewards.",
            sound.n_updates,
        )

    def _put_back(self, backup: Backup) -> None:
        self._start = self._sound_start = None
        with th.no_grad():
            th._foreach_copy_(self._model_tensors(), backup.model)
        state = self._optimizer_tensors()
        for parameter in {parameter for parameter, _ in state.keys() - backup.optimizer.keys()}:
            del self._optimizer.state[parameter]  # it had none then
        for (parameter, name), tensor in backup.optimizer.items():
            if (parameter, name) in state:
                state[parameter, name].copy_(tensor)
            else:  # a reset of the agent has cleared it since
                self._optimizer.state[parameter][name] = tensor.clone()

    def _model_tensors(self) -> list[th.Tensor]:
        return [*(parameter.detach() for parameter in self._model.parameters()), *self._model.buffers()]

    def _optimizer_tensors(self) -> dict[tuple[th.Tensor, str], th.Tensor]:
        return {
            (parameter, name): value
            for parameter, state in self._optimizer.state.items()
            for name, value in state.items()
            if isinstance(value, th.Tensor)
        }
