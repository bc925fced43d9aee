"""The floor under a gradient step: the convolutions that it needs, and nothing else."""

from math import prod
from typing import NamedTuple

import torch as th
from torch import nn

from sb3_eqr.common.eqr_algorithm import EqRAlgorithm


class Convolution(NamedTuple):
    """A convolution of an encoder, and what goes through it for one image."""

    module: nn.Conv2d
    input_shape: tuple[int, ...]  # (C, H, W)
    output_shape: tuple[int, ...]
    takes_images: bool  # which need no gradient

    @property
    def flop(self) -> int:
        """Of the forward pass of one image, a multiplication and an addition being two."""
        fan_in = self.module.in_channels // self.module.groups * prod(self.module.kernel_size)
        return 2 * fan_in * prod(self.output_shape)

    @property
    def backward_flop(self) -> int:
        """Of the backward pass of one image: as much for the weights, and again for the inputs."""
        return self.flop * (1 if self.takes_images else 2)


def find_convolutions(encoder: nn.Module, image_shape: tuple[int, ...]) -> list[Convolution]:
    """
    :param encoder: from images to features
    :param image_shape: (C, H, W)
    :return: its convolutions in the order in which they run
    """
    found: list[Convolution] = []

    def note(module: nn.Module, inputs: tuple[th.Tensor, ...], output: th.Tensor) -> None:
        assert isinstance(module, nn.Conv2d)
        found.append(Convolution(module, tuple(inputs[0].shape[1:]), tuple(output.shape[1:]), takes_images=not found))

    convolutions = [module for module in encoder.modules() if isinstance(module, nn.Conv2d)]
    hooks = [module.register_forward_hook(note) for module in convolutions]
    with th.no_grad():
        encoder(th.zeros(1, *image_shape, device=next(encoder.parameters()).device))
    for hook in hooks:
        hook.remove()
    return found


class Work(NamedTuple):
    """A convolution and its inputs, made beforehand, channels last."""

    convolution: Convolution
    images: th.Tensor  # (n_forward, C, H, W)
    trained: th.Tensor  # (n_trained, C, H, W)
    gradient: th.Tensor  # of the outputs for ``trained``


class Floor:
    """
    The convolutions of one gradient step of an agent whose target is a copy of its online network: without gradient those
    of the observation after the transition and of the M observations of the rollout, with gradient those of the observation
    itself. Each runs on inputs of its own, float32, channels last.

    :param model: whose batch size, M and encoder these are
    """

    def __init__(self, model: EqRAlgorithm):
        encoder = model.policy.online.features_extractor
        self.convolutions = find_convolutions(getattr(encoder, "trunk", encoder), model.observation_space.shape or ())
        self.n_trained = model.batch_size
        self.n_forward = model.batch_size * (1 + (model.depth if model.aet_coef > 0 else 0))
        self._work = [self._work_of(convolution, model.device) for convolution in self.convolutions]

    def _work_of(self, convolution: Convolution, device: th.device) -> Work:
        images, trained, gradient = (
            th.rand(n_images, *shape, device=device).to(memory_format=th.channels_last)
            for n_images, shape in (
                (self.n_forward, convolution.input_shape),
                (self.n_trained, convolution.input_shape),
                (self.n_trained, convolution.output_shape),
            )
        )
        return Work(convolution, images, trained.requires_grad_(not convolution.takes_images), gradient)

    @property
    def flop(self) -> int:
        """Of one gradient step."""
        forward = sum(conv.flop for conv in self.convolutions) * (self.n_forward + self.n_trained)
        return forward + sum(conv.backward_flop for conv in self.convolutions) * self.n_trained

    def step(self) -> None:
        """The convolutions of one gradient step."""
        with th.no_grad():  # by ``forward``, past all hooks
            for work in self._work:
                work.convolution.module.forward(work.images)
        outputs = [work.convolution.module.forward(work.trained) for work in self._work]
        for work, output in zip(reversed(self._work), reversed(outputs), strict=True):
            wanted = [*work.convolution.module.parameters(), *([] if work.convolution.takes_images else [work.trained])]
            th.autograd.grad(output, wanted, work.gradient)

    def steps(self, n_steps: int) -> None:
        """
        :param n_steps: gradient steps
        """
        for _ in range(n_steps):
            self.step()

    def description(self) -> str:
        """One line."""
        return (
            f"floor: {len(self.convolutions)} convolutions, channels last, {self.n_forward} images forward, "
            f"{self.n_trained} forward and backward: {self.flop / 1e9:.3f} GFLOP a step"
        )
