"""When a round of updates runs, and whether as a captured graph."""

import warnings
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th

from sb3_eqr.common.captured_update import CapturedUpdate
from sb3_eqr.common.eqr_setup import EqRSetup
from sb3_eqr.common.late_priorities import LatePriorities
from sb3_eqr.common.type_aliases import SequenceReplayBufferSamples


class UpdateRounds(EqRSetup):
    """
    Mixin, to stand before an SB3 Q-learning algorithm: what the argument ``fast`` means.
    :class:`~sb3_eqr.common.eqr_algorithm.EqRAlgorithm` adds the updates.
    """

    def _setup_model(self) -> None:
        super()._setup_model()
        self._captured = CapturedUpdate(self._update_captured, self.policy.optimizer, self.device)
        self._late = LatePriorities()
        self._may_wait = False
        self._warned_of_eager = False

    @property
    @abstractmethod
    def _target_is_online(self) -> bool:
        """Whether target features are online features, so that one pass serves for both."""

    @abstractmethod
    def _train(self, gradient_steps: int, batch_size: int) -> None:
        """A round of updates."""

    @abstractmethod
    def _update_networks(self, samples: SequenceReplayBufferSamples) -> dict[str, th.Tensor]:
        """All of an update that the device does."""

    @abstractmethod
    def _record(self, indices: np.ndarray, outputs: dict[str, th.Tensor]) -> None:
        """All of an update that the host does."""

    @contextmanager
    def _rounds_may_wait(self) -> Iterator[None]:
        """Within ``learn``."""
        self._may_wait = self.fast == "overlap"
        try:
            yield
        finally:
            self._may_wait = False
        self._start_waiting_round()
        self._late.write_back()

    def _sample_action(self, *args: Any, **kwargs: Any) -> tuple[np.ndarray, np.ndarray]:
        """As SB3's, with the same parameters; a round of updates that has waited for the action is started now."""
        actions = super()._sample_action(*args, **kwargs)
        self._start_waiting_round()
        return actions

    def _start_waiting_round(self) -> None:
        if self._waiting_round is not None:
            waiting, self._waiting_round = self._waiting_round, None
            self._train(*waiting)

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """
        A round of updates; with ``fast="overlap"``, within ``learn``, it starts when the next action is chosen, so that a GPU
        computes while the environments step.

        :param gradient_steps: number of updates
        :param batch_size: B
        """
        if self._may_wait:
            self._waiting_round = (gradient_steps, batch_size)
        else:
            self._train(gradient_steps, batch_size)

    def _captures(self) -> bool:
        """Whether updates are captured; if that was asked for and cannot be, say why, once."""
        reason = None
        if self.device.type != "cuda":
            reason = f"CUDA graphs need a GPU, and device is {self.device.type!r}"
        elif self._vec_normalize_env is not None:
            reason = "VecNormalize changes observations on the host"
        elif not all("capturable" in group for group in self.policy.optimizer.param_groups):
            reason = f"{type(self.policy.optimizer).__name__} cannot be, Adam and AdamW can"
        if reason is not None and self.fast in ("graph", "overlap") and not self._warned_of_eager:
            self._warned_of_eager = True
            warnings.warn(f"fast={self.fast!r}: updates are not captured: {reason}.")
        return reason is None and self.fast != "off"

    def _run_captured(self, arrays: dict[str, np.ndarray]) -> None:
        """
        :param arrays: of the replay buffer's ``draw``
        """
        assert self.replay_buffer is not None
        constants = (
            *self.replay_buffer.update_device_frames(),
            *(getattr(self, f"{name}_coef") for name in ("td", "aet", "get", "reward")),
            *(self.tau, self.max_grad_norm, self.double_q, self.target_update_interval is None, self._target_is_online),
        )
        figures = self._captured(constants, arrays)
        # The next update writes to the same place.
        self._record(arrays["indices"], {name: figure.clone() for name, figure in figures.items()})

    def _update_captured(self, tensors: dict[str, th.Tensor]) -> dict[str, th.Tensor]:
        assert self.replay_buffer is not None
        return self._update_networks(self.replay_buffer.samples_on_device(tensors))

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_captured", "_late", "_may_wait", "_warned_of_eager"]
