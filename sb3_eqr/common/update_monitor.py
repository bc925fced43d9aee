"""Numbers that are not finite: refused where they come in, undone where they come out of an update."""

from collections.abc import Iterator

import numpy as np
import torch as th
from torch import nn


def check_finite(what: str, values: np.ndarray | dict[str, np.ndarray] | None, step: int) -> None:
    """
    :param what: the name of the values, for the message
    :param values: from the environment; integers are always finite
    :param step: number of environment steps so far, for the message
    :raises ValueError: if one is NaN or infinite
    """
    for key, array in values.items() if isinstance(values, dict) else [("", values)]:
        array = np.asarray(array)
        if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
            raise ValueError(
                f"step {step}: expected finite {what}s from the environment, found {array[~np.isfinite(array)].flat[0]} "
                f"in the {what}{f' {key!r}' if key else ''}. It was not stored and the model is as before. "
                "Mend the environment; SB3's VecCheckNan tells which action led there."
            )


class UpdateMonitor:
    """
    The figures of each update, read when they are asked for, and the way back from an update that went wrong.

    Figures stay on the device until the next round of updates, when they are long computed: no update waits for them.
    One that is not finite puts model and optimiser back to where the round began.

    :param names: of the figures
    :param model: whose parameters and buffers are kept
    :param optimizer: whose state is kept
    """

    def __init__(self, names: tuple[str, ...], model: nn.Module, optimizer: th.optim.Optimizer):
        self.names = names
        self._model = model
        self._optimizer = optimizer
        self._pending: list[th.Tensor] = []  # (len(names),) each
        self._sums = np.zeros(len(names))
        self._count = 0
        self._backup: list[th.Tensor] = []

    def start_round(self) -> None:
        """Remember model and optimiser as they are now."""
        tensors = list(self._tensors())
        if len(tensors) == len(self._backup):
            th._foreach_copy_(self._backup, tensors)
        else:  # the first round, or the optimiser has made its state since
            self._backup = [tensor.clone() for tensor in tensors]

    def add(self, figures: list[th.Tensor]) -> None:
        """
        :param figures: of one update, scalars, in the order of ``names``
        """
        self._pending.append(th.stack(figures))

    def collect(self, n_updates: int) -> None:
        """
        Take in the figures of the last round.

        :param n_updates: updates done so far, for the message
        :raises FloatingPointError: if one is NaN or infinite; model and optimiser are then as before that round
        """
        if not self._pending:
            return
        figures = th.stack(self._pending).cpu().numpy()  # (updates, names)
        self._pending.clear()
        finite = np.isfinite(figures)
        if not finite.all():
            first = int(np.argmin(finite.all(axis=1)))
            self._roll_back()
            wrong = [f"{n} = {v}" for n, v, ok in zip(self.names, figures[first], finite[first], strict=True) if not ok]
            raise FloatingPointError(
                f"update {n_updates - len(figures) + first + 1}: expected finite losses, found {', '.join(wrong)}. "
                f"The model was put back to update {n_updates - len(figures)} and can be saved. "
                "Lower learning_rate or max_grad_norm, or check the scale of observations and rewards."
            )
        self._sums += figures.sum(axis=0)
        self._count += len(figures)

    def means(self) -> dict[str, float]:
        """
        :return: the mean of each figure over the updates since the last call; nothing if there was none
        """
        if self._count == 0:
            return {}
        means = dict(zip(self.names, (self._sums / self._count).tolist(), strict=True))
        self._sums[:] = 0.0
        self._count = 0
        return means

    def _roll_back(self) -> None:
        tensors = list(self._tensors())
        if len(tensors) == len(self._backup):
            with th.no_grad():
                th._foreach_copy_(tensors, self._backup)
            return
        self._optimizer.state.clear()  # the round was the first one: the optimiser had no state
        with th.no_grad():
            th._foreach_copy_(list(self._tensors()), self._backup)

    def _tensors(self) -> Iterator[th.Tensor]:
        yield from (parameter.detach() for parameter in self._model.parameters())
        yield from self._model.buffers()
        for state in self._optimizer.state.values():
            yield from (value for value in state.values() if isinstance(value, th.Tensor))
