"""The frames of a store on the device where the networks are, so that an update has to send indices only."""

import numpy as np
import torch as th

from sb3_eqr.common.frame_store import FrameStore


class DeviceFrames:
    """
    A copy of a store's frames, brought up to date by :meth:`update`.

    :param store: whose frames; it must live as long
    :param device: where the copy is
    """

    def __init__(self, store: FrameStore, device: th.device):
        self.store = store
        self._device = device
        self._upload()

    def _upload(self) -> None:
        self.store.start_log()
        self.frames = th.zeros(0)  # an old copy makes room
        self.frames = th.as_tensor(self.store.frames).to(self._device, copy=True)  # (capacity, *frame_shape)

    def update(self) -> None:
        """Send what the store has written since the last call."""
        slots = self.store.read_log()
        if len(self.frames) != len(self.store.frames):  # it has grown
            self._upload()
        elif len(slots) > 0:
            index, frames = (send(array, self._device) for array in (slots, self.store.frames[slots]))
            self.frames.index_copy_(0, index, frames)

    def observations(self, ids: th.Tensor) -> th.Tensor:
        """
        :param ids: frames of observations, (..., n_stack), on the device
        :return: (..., *obs_shape)
        """
        return self.frames[ids.long()].reshape(*ids.shape[:-1], *self.store.obs_shape)


def send(array: np.ndarray, device: th.device) -> th.Tensor:
    """
    A copy on a device, without waiting for what the device is doing.

    :param array: on the host
    :param device: where the copy goes
    """
    tensor = th.as_tensor(array)
    if device.type == "cuda":  # only from pinned memory; PyTorch keeps it until the copy is done
        return tensor.pin_memory().to(device, non_blocking=True)
    return tensor.to(device, copy=True)
