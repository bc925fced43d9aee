"""
An update captured as one CUDA graph: augmentation, losses, gradients, clipping, optimiser, running means and targets are one
launch instead of about a thousand.

All code for CUDA graphs is in this file.
"""

import warnings
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any

import torch as th
from torch.utils._pytree import tree_map_only

from sb3_eqr.common.type_aliases import SequenceReplayBufferSamples

Update = Callable[[SequenceReplayBufferSamples], Any]


class CapturedUpdate:
    """
    An update that runs as a CUDA graph. On a GPU, the first calls run eagerly, while libraries allocate their workspaces; then
    one call is captured, and later calls replay it with their own samples and learning rates. Everything else that the graph
    depends on (settings, shapes, which parameters are trained, where they and the optimiser's state lie) is compared at each
    call, and the graph is captured again if it has changed. Without a GPU, or if a capture fails, all calls run eagerly, after
    one warning.

    The update must not read values back from the GPU, as a matrix exponential does.

    :param update: a function of samples that steps the optimiser; the tensors in its result are valid until the next call
    :param optimizer: a fused Adam or AdamW (the default), since others keep learning rates and steps outside the GPU
    :param settings: returns all numbers that ``update`` reads, which the graph keeps as constants
    """

    WARM_UP = 3  # eager calls before the capture

    def __init__(self, update: Update, optimizer: th.optim.Optimizer, settings: Callable[[], Hashable]):
        self._update = update
        self._optimizer = optimizer
        self._settings = settings
        self._parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
        self._device = self._parameters[0].device
        self._key: Hashable = None
        self._calls = 0  # number of calls with this key
        self._graph: th.cuda.CUDAGraph | None = None
        self.failure: str | None = None  # the reason why nothing is captured
        if self._device.type != "cuda":
            self._give_up(f"a CUDA graph needs a GPU, and the device is {self._device.type!r}")
        elif not isinstance(optimizer, th.optim.Adam) or not optimizer.defaults["fused"]:  # AdamW is one, too
            self._give_up("a CUDA graph needs a fused Adam or AdamW as optimiser")

    def __call__(self, samples: SequenceReplayBufferSamples) -> Any:
        """
        :param samples: B windows
        :return: the result of the update, valid until the next call
        """
        if self.failure is not None:
            return self._update(samples)
        key = self._key_of(samples)
        if key != self._key:
            self._key, self._calls, self._graph = key, 0, None
            self._inputs = tree_map_only(th.Tensor, th.clone, samples)  # which the graph reads
            self._rates = [th.empty((), device=self._device) for _ in self._optimizer.param_groups]
        th._foreach_copy_(list(_tensors(self._inputs)), list(_tensors(samples)))
        for rate, group in zip(self._rates, self._optimizer.param_groups, strict=True):
            rate.fill_(group["lr"])
        self._calls += 1
        if self._calls <= self.WARM_UP:
            return self._beside()
        if self._graph is None and not self._capture():
            return self._update(samples)
        assert self._graph is not None
        self._graph.replay()
        return self._result

    def _key_of(self, samples: SequenceReplayBufferSamples) -> Hashable:
        """Everything on which a captured graph depends."""
        state = self._optimizer.state
        moments = [state[parameter]["exp_avg"].data_ptr() if state.get(parameter) else 0 for parameter in self._parameters]
        return (
            self._settings(),
            tuple((tensor.shape, tensor.dtype) for tensor in _tensors(samples)),
            tuple((parameter.requires_grad, parameter.data_ptr()) for parameter in self._parameters),
            tuple(moments),
        )

    def _beside(self) -> Any:
        """Run eagerly on a side stream, as required for the calls before a capture."""
        current, beside = th.cuda.current_stream(self._device), th.cuda.Stream(self._device)
        beside.wait_stream(current)
        with th.cuda.stream(beside):
            result = self._update(self._inputs)
        current.wait_stream(beside)
        return result

    def _capture(self) -> bool:
        """Capture a call, without executing it, and return whether this succeeded."""
        graph = th.cuda.CUDAGraph()
        try:
            # A failed capture may leave its stream current, so the outer context restores this one.
            with th.cuda.device(self._device), th.cuda.stream(th.cuda.current_stream(self._device)), th.cuda.graph(graph):
                with self._capturable_optimizer():
                    self._result = self._update(self._inputs)
        except Exception as error:  # PyTorch raises several kinds
            while error.__context__ is not None:  # the first failure is the cause, later ones follow from it
                error = error.__context__  # type: ignore[assignment]
            for parameter in self._parameters:
                parameter.grad = None
            self._give_up(f"{type(error).__name__}: {str(error).partition(chr(10))[0]}")
            return False
        self._graph = graph
        return True

    @contextmanager
    def _capturable_optimizer(self) -> Iterator[None]:
        """Within this context, the optimiser reads learning rates from tensors, which each call fills."""
        groups = self._optimizer.param_groups
        before = [{name: group[name] for name in ("lr", "capturable")} for group in groups]
        try:
            for group, rate in zip(groups, self._rates, strict=True):
                group.update(lr=rate, capturable=True)
            yield
        finally:
            for group, values in zip(groups, before, strict=True):
                group.update(values)

    def _give_up(self, why: str) -> None:
        self.failure = why
        warnings.warn(f"cuda_graph: updates run eagerly, because {why}.")

    def __getstate__(self) -> dict[str, Any]:
        # A graph cannot be moved to another process.
        return {"update": self._update, "optimizer": self._optimizer, "settings": self._settings}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]


def _tensors(samples: SequenceReplayBufferSamples) -> Iterator[th.Tensor]:
    for field in samples:
        for value in field.values() if isinstance(field, dict) else [field]:
            if isinstance(value, th.Tensor):
                yield value
