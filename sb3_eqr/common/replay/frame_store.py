"""Storage that keeps each frame once: frames in one array, on a GPU if the agent is there, and their indices for each pair."""

import warnings
from typing import Any

import numpy as np
import torch as th

SHARE_OF_GPU = 0.8  # of its free memory that frames may take; updates need the rest
_ZERO = 0  # slot 0 always holds the zeros with which VecFrameStack pads the first observations of an episode


class FrameStore:
    """
    A ring buffer of (observation, next observation) pairs for each environment that stores each frame once.

    An observation is a stack of ``n_stack`` frames along its first axis (1: no stacking). A pair holds the
    indices of its n_stack + 1 frames; consecutive pairs of an episode share all frames except the newest. Frames are
    reference-counted, so frames used only by an overwritten pair are reused. Frames are compared bit by bit before they are
    shared, so observations are always returned unchanged, however episodes are reset, padded or truncated.

    :param n_positions: length of the ring buffer
    :param n_envs: number of environments
    :param obs_shape: shape of one observation; the first axis must be divisible by ``n_stack``
    :param dtype: dtype of the observations
    :param n_stack: number of frames per observation
    :param device: where observations are returned. Frames are stored there, too, on a CPU or on a GPU that has room for them
    """

    def __init__(
        self,
        n_positions: int,
        n_envs: int,
        obs_shape: tuple[int, ...],
        dtype: np.dtype,
        n_stack: int = 1,
        device: th.device | str = "cpu",
    ):
        self.n_stack = n_stack
        self.device = th.device(device)
        self.obs_shape = obs_shape
        self._frame_shape = (obs_shape[0] // n_stack, *obs_shape[1:])
        self._ids = np.zeros((n_positions, n_envs, n_stack + 1), dtype=np.int32)
        self._n_used = 1  # slots below this have been used at some time
        self._n_free = 0  # number of these that are free again, listed in the first entries of _free
        self._allocate_arrays(np.dtype(dtype))

    def _allocate_arrays(self, dtype: np.dtype) -> None:
        self.dtype = dtype
        n = len(self._ids) * self._ids.shape[1]
        # One frame per transition, and one more per episode; the array grows if episodes are short.
        capacity = max(self._n_used, 1 + n + n // 64 + self._ids[0].size)
        self._references = np.zeros(capacity, dtype=np.int32)
        self._free = np.zeros(capacity, dtype=np.int32)
        self._last: np.ndarray | None = None  # the newest next observations, (n_envs, n_stack, *frame_shape)
        frames = np.zeros((capacity, *self._frame_shape), dtype=dtype)  # takes memory only as it is filled
        self._frames: np.ndarray | th.Tensor = frames  # a tensor on a GPU
        if self.device.type == "cuda":
            free, _ = th.cuda.mem_get_info(self.device)
            if frames.nbytes < SHARE_OF_GPU * free:
                self._frames = th.zeros_like(th.from_numpy(frames), device=self.device)
            else:
                warnings.warn(
                    f"The frames of the replay buffer need {frames.nbytes / 1e9:.2f} GB, and {self.device} has "
                    f"{free / 1e9:.2f} GB left, also for updates, so they stay in the computer's memory. Pass a smaller "
                    "buffer_size."
                )

    def emptied(self) -> "FrameStore":
        """An empty store of the same kind."""
        return FrameStore(*self._ids.shape[:2], self.obs_shape, self.dtype, self.n_stack, self.device)

    @property
    def nbytes(self) -> int:
        """Memory usage, in bytes."""
        return self._frames.nbytes + self._references.nbytes + self._free.nbytes + self._ids.nbytes

    def add(self, position: int, obs: np.ndarray, next_obs: np.ndarray, overwrite: bool) -> np.ndarray:
        """
        Store one pair per environment.

        :param position: position in the ring buffer; positions are written in order
        :param obs: (n_envs, *obs_shape)
        :param next_obs: (n_envs, *obs_shape)
        :param overwrite: whether this position holds an older pair
        :return: whether ``obs`` is the next observation of the previous pair, (n_envs,)
        :raises ValueError: if ``next_obs`` is not ``obs`` shifted by one frame
        """
        stacks, next_stacks = self._as_stacks(obs), self._as_stacks(next_obs)  # (n_envs, n_stack, *frame_shape)
        if not np.array_equal(_bits(stacks[:, 1:]), _bits(next_stacks[:, :-1])):
            raise ValueError(
                f"frame_stack={self.n_stack}: each observation must be the previous one with its oldest frame "
                "dropped and one frame appended along the first axis, got another order. Step and reset the training "
                "environment only in learn, and evaluate in another one; if its frames have another order, pass "
                'replay_buffer_kwargs={"frame_stack": 1} to store observations without splitting them into frames.'
            )
        if overwrite:
            old = self._ids[position].copy()
            self._ids[position] = _ZERO  # after Ctrl-C, they must not be released again
            self._release(old)
        before = self._ids[position - 1]
        last = self._gathered(before[:, 1:]).numpy(force=True) if self._last is None else self._last
        continues = (_bits(last) == _bits(stacks)).reshape(len(stacks), -1).all(axis=1)
        ids = np.empty_like(before)
        ids[:, :-1] = before[:, 1:]
        for env in np.flatnonzero(~continues):  # the first step of an episode
            ids[env, :-1] = self._store_stack(stacks[env])
        ids[:, -1] = self._take_slots(len(stacks))
        self._put(ids[:, -1], next_stacks[:, -1])
        np.add.at(self._references, ids, 1)
        self._ids[position] = ids
        self._last = next_stacks.copy()
        return continues

    def observations(self, positions: np.ndarray, envs: np.ndarray, following: bool) -> th.Tensor:
        """
        The observations, or with ``following`` the next observations, of the pairs of ``envs`` at ``positions``, both (...)
        and broadcast: a copy on the device, (..., *obs_shape).
        """
        ids = self._ids[positions, envs, 1:] if following else self._ids[positions, envs, :-1]  # (..., n_stack)
        return self._gathered(ids).view(*ids.shape[:-1], *self.obs_shape).to(self.device)

    def _gathered(self, ids: np.ndarray) -> th.Tensor:
        """A copy of the frames with these ids, (..., *frame_shape)."""
        if isinstance(self._frames, np.ndarray):  # a quarter faster than through PyTorch
            return th.from_numpy(self._frames[ids])
        index = th.from_numpy(ids.reshape(-1)).to(self.device, non_blocking=True)
        return self._frames.index_select(0, index).view(*ids.shape, *self._frame_shape)

    def _put(self, ids: np.ndarray, frames: np.ndarray) -> None:
        """Store frames, (N, *frame_shape), in these slots, (N,)."""
        if isinstance(self._frames, np.ndarray):
            self._frames[ids] = frames
        else:
            self._frames[th.from_numpy(ids).to(self.device)] = th.from_numpy(frames.copy()).to(self.device)

    def _as_stacks(self, obs: np.ndarray) -> np.ndarray:
        return np.asarray(obs, dtype=self.dtype).reshape(len(obs), self.n_stack, *self._frame_shape)

    def _store_stack(self, stack: np.ndarray) -> list[int]:
        ids: list[int] = []
        for k, frame in enumerate(stack):
            if self.n_stack > 1 and not _bits(frame).any():
                ids.append(_ZERO)
            elif k > 0 and np.array_equal(_bits(frame), _bits(stack[k - 1])):  # padding with the first frame
                ids.append(ids[-1])
            else:
                slot = self._take_slots(1)
                ids.append(int(slot[0]))
                self._put(slot, frame[None])
        return ids

    def _take_slots(self, count: int) -> np.ndarray:
        reused = min(count, self._n_free)
        self._n_free -= reused
        slots = self._free[self._n_free : self._n_free + reused].copy()  # a copy, because growing moves the array
        fresh = np.arange(self._n_used, self._n_used + count - reused, dtype=np.int32)
        self._n_used += count - reused
        if self._n_used > len(self._frames):
            self._grow()
        return np.concatenate([slots, fresh])

    def _grow(self) -> None:
        capacity = self._n_used + len(self._frames) // 16
        arrays = [self._references, self._free]
        if isinstance(self._frames, np.ndarray):
            arrays.append(self._frames)
        else:
            grown = self._frames.new_zeros(capacity, *self._frame_shape)
            grown[: len(self._frames)] = self._frames
            self._frames = grown
        for array in arrays:  # in place: the system moves pages, not bytes
            array.resize((capacity, *array.shape[1:]), refcheck=False)

    def _release(self, ids: np.ndarray) -> None:
        np.subtract.at(self._references, ids, 1)
        self._references[_ZERO] = 1
        unused = np.unique(ids[self._references[ids] == 0])
        self._free[self._n_free : self._n_free + len(unused)] = unused
        self._n_free += len(unused)

    def __getstate__(self) -> dict[str, Any]:
        """Save only used slots, so that the file size is proportional to the number of stored transitions."""
        state = self.__dict__.copy()
        for name in ("_last", "device", "dtype"):
            del state[name]
        for name in ("_frames", "_references", "_free"):
            used = state[name][: self._n_used]
            state[name] = used.numpy(force=True) if isinstance(used, th.Tensor) else used
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        saved = {name: state.pop(name) for name in ("_frames", "_references", "_free")}
        self.__dict__.update({"device": th.device("cpu"), **state})
        self._allocate_arrays(saved["_frames"].dtype)
        for name, array in saved.items():
            target = getattr(self, name)
            target[: len(array)] = th.from_numpy(array) if isinstance(target, th.Tensor) else array


def _bits(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array).view(np.uint8)
