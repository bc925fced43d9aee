"""When a round of updates runs, and whether as a captured graph."""

import io
import pathlib
import warnings
from abc import abstractmethod
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th

from sb3_eqr.common.buffers import SequenceReplayBuffer
from sb3_eqr.common.captured_update import CapturedUpdate
from sb3_eqr.common.eqr_setup import EqRSetup
from sb3_eqr.common.late_priorities import LatePriorities
from sb3_eqr.common.type_aliases import SequenceReplayBufferSamples


class UpdateRounds(EqRSetup):
    """
    Mixin, to stand before an SB3 Q-learning algorithm: what the argument ``fast`` means.
    :class:`~sb3_eqr.common.eqr_algorithm.EqRAlgorithm` adds the updates.
    """

    _trained: list[th.nn.Parameter]

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
    def _update(self, samples: SequenceReplayBufferSamples) -> None:
        """One gradient step, the target, the priorities."""

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
        if self._waiting_round is not None:
            self._start_waiting_round()
            self.policy.set_training_mode(False)  # as callbacks know it
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
        if self.fast == "off":
            return False
        reason = self._captured.failure or self._why_not_captured()
        if reason is not None and self.fast != "auto" and not self._warned_of_eager:
            self._warned_of_eager = True
            if self._captured.failure is None:  # it has been told otherwise
                warnings.warn(f"fast={self.fast!r}: updates are not captured: {reason}.")
        return reason is None

    def _why_not_captured(self) -> str | None:
        buffer = type(self.replay_buffer)
        if self.device.type != "cuda":
            return f"CUDA graphs need a GPU, and device is {self.device.type!r}"
        if self._vec_normalize_env is not None:
            return "VecNormalize changes observations on the host"
        if not all(group.get("fused") for group in self.policy.optimizer.param_groups):
            return 'the optimiser keeps a part of its state on the host (optimizer_kwargs={"fused": True} would not)'
        if self.policy.latent_model.group.needs_host:
            return f"elements of {self.policy.latent_model.group} need a matrix exponential"
        if any(getattr(buffer, name) is not getattr(SequenceReplayBuffer, name) for name in ("sample", "_samples")):
            return f"{buffer.__name__} has a sample of its own"
        return None

    def _run_captured(self, arrays: dict[str, np.ndarray]) -> None:
        """
        :param arrays: of the replay buffer's ``draw``
        """
        assert self.replay_buffer is not None
        try:
            places = self.replay_buffer.update_device_frames()
        except th.cuda.OutOfMemoryError as error:
            self._captured.give_up(error)
            self._update(self.replay_buffer._samples(arrays, None))
            return
        outputs = self._captured((places, self._constants()), arrays)
        if "priorities" in outputs:  # the next update writes to the same place
            outputs = {**outputs, "priorities": outputs["priorities"].clone()}
        self._record(arrays["indices"], outputs)

    def _constants(self) -> tuple[Hashable, ...]:
        """Whatever an update depends on that a graph holds fast: numbers, and where tensors are."""
        moments = self.policy.optimizer.state
        return (
            *(getattr(self, f"{name}_coef") for name in ("td", "aet", "get", "reward")),
            *(self.tau, self.max_grad_norm, self.double_q, self.bf16, self.shift_pixels, self.intensity_scale),
            *(self.target_update_interval is None, self._target_is_online),
            *((p.requires_grad, p.data_ptr(), *(t.data_ptr() for t in moments.get(p, {}).values())) for p in self._trained),
        )

    def _update_captured(self, tensors: dict[str, th.Tensor]) -> dict[str, th.Tensor]:
        assert self.replay_buffer is not None
        return self._update_networks(self.replay_buffer.samples_on_device(tensors))

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """As SB3's ``save_replay_buffer``, with the same parameters."""
        self._late.write_back()
        super().save_replay_buffer(path)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_captured", "_late", "_may_wait", "_warned_of_eager"]
