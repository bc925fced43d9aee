"""Priorities on their way from the device to the replay buffer."""

from typing import NamedTuple

import numpy as np
import torch as th

from sb3_eqr.common.buffers import PrioritizedSequenceReplayBuffer


class _Late(NamedTuple):
    buffer: PrioritizedSequenceReplayBuffer
    indices: np.ndarray  # (B,)
    priorities: th.Tensor  # (B,), on the host once `arrived`
    arrived: th.cuda.Event | None


class LatePriorities:
    """What has been sent, oldest first; nothing waits for it before it is written."""

    def __init__(self) -> None:
        self._late: list[_Late] = []

    def add(self, buffer: PrioritizedSequenceReplayBuffer, indices: np.ndarray, priorities: th.Tensor) -> None:
        """
        :param buffer: where they go
        :param indices: of the samples, (B,)
        :param priorities: theirs, (B,), on the device
        """
        arrived = None
        if priorities.device.type == "cuda":
            stream = th.cuda.current_stream(priorities.device)
            host = th.empty(priorities.shape, dtype=priorities.dtype, pin_memory=True)
            priorities = host.copy_(priorities, non_blocking=True)
            arrived = th.cuda.Event()
            arrived.record(stream)
        self._late.append(_Late(buffer, indices, priorities, arrived))

    def write_back(self, but: int = 0) -> None:
        """
        :param but: how many of the newest to leave on their way
        """
        while len(self._late) > but:
            late = self._late.pop(0)
            if late.arrived is not None:
                late.arrived.synchronize()
            late.buffer.update_priorities(late.indices, late.priorities)
