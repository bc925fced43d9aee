"""
Loss terms and gradients of an update captured as one CUDA graph: one launch instead of about a thousand.

All code for CUDA graphs is in this file.
"""

import warnings
from collections.abc import Callable, Hashable, Iterator
from typing import Any

import torch as th
from torch import nn

from sb3_eqr.common.networks.optimizers import assign_gradients
from sb3_eqr.common.type_aliases import SequenceReplayBufferSamples


class CapturedGradients:
    """
    Computes an objective and its gradients. On a GPU, the first calls run eagerly, while libraries allocate their workspaces;
    then one call is captured, and later calls replay it with their own samples. Everything else that the graph depends on
    (weights of the loss terms, shapes, which parameters are trained) is compared at each call, and the graph is captured
    again if it has changed. Without a GPU, or if a capture fails, all calls run eagerly, after one warning.

    The objective must not read values back from the GPU, as a matrix exponential does.

    :param objective: a function of samples and coefficients; its result has the scalar ``loss``, which is minimised
    :param parameters: the trained parameters; each call overwrites their ``grad``
    """

    WARM_UP = 3  # eager calls before the capture

    def __init__(
        self,
        objective: Callable[[SequenceReplayBufferSamples, Any], Any],
        parameters: list[nn.Parameter],
    ):
        self._objective = objective
        self._parameters = parameters
        self._device = parameters[0].device
        self._key: Hashable = None
        self._calls = 0  # number of calls with this key
        self._graph: th.cuda.CUDAGraph | None = None
        self.failure: str | None = None  # the reason why nothing is captured
        if self._device.type != "cuda":
            self._give_up(f"a CUDA graph needs a GPU, and the device is {self._device.type!r}")

    def __call__(self, samples: SequenceReplayBufferSamples, coefs: dict[str, float]) -> Any:
        """
        :param samples: B windows
        :param coefs: weights of the loss terms
        :return: the loss terms, valid until the next call; the gradients are in the parameters' ``grad``
        """
        if self.failure is not None:
            return self._eager(samples, coefs)
        key = self._key_of(samples, coefs)
        if key != self._key:
            self._key, self._calls, self._graph = key, 0, None
            self._inputs = _copied(samples)
        th._foreach_copy_(list(_tensors(self._inputs)), list(_tensors(samples)))
        self._calls += 1
        if self._calls <= self.WARM_UP:
            return self._beside(coefs)
        if self._graph is None and not self._capture(coefs):
            return self._eager(samples, coefs)
        assert self._graph is not None
        self._graph.replay()
        for parameter, gradient in zip(self._parameters, self._gradients, strict=True):
            parameter.grad = gradient
        return self._terms

    def _key_of(self, samples: SequenceReplayBufferSamples, coefs: dict[str, float]) -> Hashable:
        """Everything on which a captured graph depends."""
        return (
            tuple(coefs.items()),
            tuple((tensor.shape, tensor.dtype) for tensor in _tensors(samples)),
            tuple((parameter.requires_grad, parameter.data_ptr()) for parameter in self._parameters),
        )

    def _eager(self, samples: SequenceReplayBufferSamples, coefs: dict[str, float]) -> Any:
        terms = self._objective(samples, coefs)
        assign_gradients(terms.loss, self._parameters)
        return terms

    def _beside(self, coefs: dict[str, float]) -> Any:
        """Run eagerly on a side stream, as required for the calls before a capture."""
        current, beside = th.cuda.current_stream(self._device), th.cuda.Stream(self._device)
        beside.wait_stream(current)
        with th.cuda.stream(beside):
            terms = self._eager(self._inputs, coefs)
        current.wait_stream(beside)
        return terms

    def _capture(self, coefs: dict[str, float]) -> bool:
        """Capture a call, without executing it, and return whether this succeeded."""
        graph = th.cuda.CUDAGraph()
        try:
            # A failed capture may leave its stream current, so the outer context restores this one.
            with th.cuda.device(self._device), th.cuda.stream(th.cuda.current_stream(self._device)), th.cuda.graph(graph):
                self._terms = self._eager(self._inputs, coefs)
        except Exception as error:  # PyTorch raises several kinds
            while error.__context__ is not None:  # the first failure is the cause, later ones follow from it
                error = error.__context__  # type: ignore[assignment]
            for parameter in self._parameters:
                parameter.grad = None
            self._give_up(f"{type(error).__name__}: {str(error).partition(chr(10))[0]}")
            return False
        self._gradients = [parameter.grad for parameter in self._parameters]
        self._graph = graph
        return True

    def _give_up(self, why: str) -> None:
        self.failure = why
        warnings.warn(f"cuda_graph: updates run eagerly, because {why}.")

    def __getstate__(self) -> dict[str, Any]:
        # A graph cannot be moved to another process.
        return {"objective": self._objective, "parameters": self._parameters}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]


def _tensors(samples: SequenceReplayBufferSamples) -> Iterator[th.Tensor]:
    for field in samples:
        for value in field.values() if isinstance(field, dict) else [field]:
            if isinstance(value, th.Tensor):
                yield value


def _copied(samples: SequenceReplayBufferSamples) -> SequenceReplayBufferSamples:
    """A copy of the samples in separate tensors, which the graph reads."""
    copies: dict[str, Any] = {}
    for name, field in samples._asdict().items():
        if isinstance(field, dict):
            copies[name] = {key: value.clone() for key, value in field.items()}
        elif isinstance(field, th.Tensor):
            copies[name] = field.clone()
    return samples._replace(**copies)
