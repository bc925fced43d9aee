"""A replay buffer's observations: every frame stored once, on the host and, where an update is captured, on the device."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_eqr.common.device_frames import DeviceFrames
from sb3_eqr.common.frame_store import FrameStore
from sb3_eqr.common.type_aliases import PyTorchObs, SequenceReplayBufferSamples


class FrameReplayBuffer(ReplayBuffer):
    """The part of a replay buffer that holds observations and makes samples of a draw; a subclass draws."""

    def _make_stores(self, frame_stack: int) -> None:
        is_dict = isinstance(self.observation_space, spaces.Dict)
        obs_spaces = self.observation_space.spaces if is_dict else {"": self.observation_space}  # type: ignore[attr-defined]
        shapes = self.obs_shape if isinstance(self.obs_shape, dict) else {"": self.obs_shape}
        self._stores = {
            key: FrameStore(self.buffer_size, self.n_envs, shapes[key], space.dtype, frame_stack)  # type: ignore[arg-type]
            for key, space in obs_spaces.items()
        }
        self._device_frames: dict[str, DeviceFrames] = {}

    def _shaped(self, obs: np.ndarray, store: FrameStore) -> np.ndarray:
        shape = (self.n_envs, *store.obs_shape)
        if obs.shape == shape[:1]:  # Discrete
            return obs.reshape(shape)
        if obs.shape != shape:
            raise ValueError(
                f"observations: expected the shape {shape} of the replay buffer, found {obs.shape}. "
                "Wrappers that change the shape (VecTransposeImage, VecFrameStack) belong inside VecNormalize."
            )
        return obs

    def _samples(self, arrays: dict[str, np.ndarray], env: VecNormalize | None) -> SequenceReplayBufferSamples:
        """
        :param arrays: of :meth:`draw`
        :param env: normalises observations, where given
        """
        fields: dict[str, Any] = {}
        for name, array in arrays.items():
            field, _, key = name.partition("/")
            if "observations" in field:
                fields.setdefault(field, {})[key] = self._stores[key].observations(array)
            else:  # arrays here are fresh copies already
                fields[field] = array if field == "indices" else th.as_tensor(array, device=self.device)
        for field in fields:
            if "observations" in field:
                fields[field] = self._on_device(self._normalize_obs(self._unkeyed(fields[field]), env))
        return SequenceReplayBufferSamples(**fields)

    def samples_on_device(self, tensors: dict[str, th.Tensor]) -> SequenceReplayBufferSamples:
        """
        The samples of a draw whose arrays are on the device already, where the frames are, too: nothing crosses.

        :param tensors: of :meth:`draw`
        """
        fields: dict[str, Any] = {}
        for name, tensor in tensors.items():
            field, _, key = name.partition("/")
            if "observations" in field:
                fields.setdefault(field, {})[key] = self._device_frames[key].observations(tensor)
            else:
                fields[field] = tensor
        fields.update({field: self._unkeyed(value) for field, value in fields.items() if "observations" in field})
        return SequenceReplayBufferSamples(**fields)

    def update_device_frames(self) -> tuple[tuple[int, int], ...]:
        """
        Bring the frames on the device up to date; they are 7 kB per transition of Atari.

        :return: where they are in memory, and how many: both change when a store grows
        """
        for key, store in self._stores.items():
            if key not in self._device_frames or self._device_frames[key].store is not store:
                self._device_frames[key] = DeviceFrames(store, self.device)
            self._device_frames[key].update()
        return tuple((held.frames.data_ptr(), len(held.frames)) for held in self._device_frames.values())

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_device_frames": {}}  # made again when they are needed

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update({"_device_frames": {}, **state})

    def _unkeyed(self, observations: dict[str, Any]) -> Any:
        return observations if isinstance(self.observation_space, spaces.Dict) else observations[""]

    def _on_device(self, observations: np.ndarray | dict[str, np.ndarray]) -> PyTorchObs:
        if isinstance(observations, dict):
            return {key: th.as_tensor(obs, device=self.device) for key, obs in observations.items()}
        return th.as_tensor(observations, device=self.device)
