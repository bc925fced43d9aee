"""What an update does on a GPU, as one CUDA graph: a single launch in place of some two thousand."""

import warnings
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager

import numpy as np
import torch as th

Tensors = dict[str, th.Tensor]


class StaticInputs:
    """
    Arrays at one place on a device, which a graph reads: all of them cross in one copy.

    :param arrays: of the shapes and dtypes that every later call of :meth:`load` brings
    :param device: where they go
    """

    def __init__(self, arrays: dict[str, np.ndarray], device: th.device):
        self._places: dict[str, slice] = {}
        size = 0
        for name, array in arrays.items():
            self._places[name] = slice(size, size + array.nbytes)
            size += -(-array.nbytes // 16) * 16  # aligned for every dtype
        self._pinned = device.type == "cuda"
        self._buffer = th.empty(size, dtype=th.uint8, device=device)
        self.tensors: Tensors = {
            name: self._buffer[place].view(th.as_tensor(arrays[name]).dtype).view(arrays[name].shape)
            for name, place in self._places.items()
        }

    def load(self, arrays: dict[str, np.ndarray]) -> None:
        """
        :param arrays: by the same names, of the same shapes
        """
        # A fresh block each time: PyTorch does not hand out pinned memory again before the copy from it is done.
        host = th.empty(len(self._buffer), dtype=th.uint8, pin_memory=self._pinned)
        for name, place in self._places.items():
            host.numpy()[place] = np.ascontiguousarray(arrays[name]).view(np.uint8).ravel()
        self._buffer.copy_(host, non_blocking=True)


class _Capture:
    """One graph, its inputs and its outputs."""

    def __init__(self, arrays: dict[str, np.ndarray], device: th.device):
        self.inputs = StaticInputs(arrays, device)
        self.calls = 0
        self.graph: th.cuda.CUDAGraph | None = None
        self.outputs: Tensors = {}


class CapturedUpdate:
    """
    Runs a function of tensors on a GPU: its first calls as they are, while libraries and optimiser allocate what they keep,
    then captured. Where a call cannot be captured, ``failure`` says why, and from then on all run as they are.

    The function reads its inputs and a model and changes the model in place; it never waits for the GPU, makes no shape depend
    on a number, and draws from torch's generator of the device. The learning rate is read at each call.

    :param function: of the inputs, on the device; returns outputs on the device
    :param optimizer: what the function steps: fused, so that all its state is on the device
    :param device: a CUDA device
    """

    WARM_UP = 3
    KEPT = 4  # graphs; each has memory of its own

    def __init__(self, function: Callable[[Tensors], Tensors], optimizer: th.optim.Optimizer, device: th.device):
        self._function = function
        self._optimizer = optimizer
        self._device = device
        self._captures: dict[Hashable, _Capture] = {}
        self._learning_rate = th.zeros((), device=device)
        self._loaded_rate: float | None = None
        self._stream: th.cuda.Stream | None = None
        self.failure: str | None = None

    def forget(self) -> None:
        """The optimiser's state or the model's tensors are others now: capture again."""
        self._captures.clear()

    def give_up(self, error: BaseException) -> None:
        """
        :param error: why no call is captured any more
        """
        while error.__context__ is not None:  # CUDA tells the first failure, what comes after only that there was one
            error = error.__context__
        self.failure = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
        self.forget()
        warnings.warn(f"fast: updates cannot be captured and run as they are: {self.failure}")

    def __call__(self, key: Hashable, arrays: dict[str, np.ndarray]) -> Tensors:
        """
        :param key: whatever else the function depends on; another key is another graph
        :param arrays: the inputs, on the host
        :return: the outputs, on the device; valid until the next call
        """
        key = (key, *((name, array.shape, array.dtype) for name, array in arrays.items()))
        if key not in self._captures:
            while len(self._captures) >= self.KEPT:
                del self._captures[next(iter(self._captures))]  # the oldest
            self._captures[key] = _Capture(arrays, self._device)
        capture = self._captures[key]
        capture.inputs.load(arrays)
        capture.calls += 1
        if capture.graph is None and capture.calls > self.WARM_UP:
            self._capture(capture)
        if capture.graph is None:
            return self._run(capture)
        rate = self._optimizer.param_groups[0]["lr"]
        if rate != self._loaded_rate:
            self._learning_rate.fill_(rate)
            self._loaded_rate = rate
        capture.graph.replay()
        return capture.outputs

    def _run(self, capture: _Capture) -> Tensors:
        """As it is; beside the current stream, as a capture wants it to have been."""
        if self.failure is not None:
            return self._function(capture.inputs.tensors)
        now, aside = th.cuda.current_stream(self._device), self._aside()
        aside.wait_stream(now)
        with th.cuda.stream(aside):
            outputs = self._function(capture.inputs.tensors)
        now.wait_stream(aside)
        return outputs

    def _aside(self) -> th.cuda.Stream:
        if self._stream is None:
            self._stream = th.cuda.Stream(self._device)
        return self._stream

    def _capture(self, capture: _Capture) -> None:
        """Nothing runs yet."""
        graph = th.cuda.CUDAGraph()
        now = th.cuda.current_stream(self._device)
        try:
            # A capture that fails may leave its stream current: the outer context brings this one back.
            with th.cuda.device(self._device), th.cuda.stream(now), self._capturable_optimizer():
                with th.cuda.graph(graph, stream=self._aside()):
                    capture.outputs = self._function(capture.inputs.tensors)
        except Exception as error:  # torch raises several kinds
            self.give_up(error)
        else:
            capture.graph = graph

    @contextmanager
    def _capturable_optimizer(self) -> Iterator[None]:
        """The graph reads the learning rate from a tensor; files and schedules go on seeing a number."""
        groups = self._optimizer.param_groups
        before = [(group["lr"], group["capturable"]) for group in groups]
        for group in groups:
            group["lr"], group["capturable"] = self._learning_rate, True
        try:
            yield
        finally:
            for group, (rate, capturable) in zip(groups, before, strict=True):
                group["lr"], group["capturable"] = rate, capturable
