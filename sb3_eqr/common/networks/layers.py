"""Layers that PyTorch lacks: noisy linear layers, the distributional head, centring."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from math import sqrt
from typing import Any, NamedTuple

import torch as th
from torch import nn
from torch.nn import functional as F


class Noise(NamedTuple):
    """The noise for one layer."""

    out: th.Tensor  # f(ε_out), (out_features,)
    into: th.Tensor  # f(ε_in), (in_features,)


class NoisyWeights(NamedTuple):
    """The weights of one layer with its noise, for several calls."""

    weight: th.Tensor  # (out_features, in_features)
    bias: th.Tensor  # (out_features,)


class NoisyLinear(nn.Module):
    """
    Linear layer with factorised Gaussian noise (Fortunato et al. 2018, Eq. 9 to 11, https://arxiv.org/abs/1706.10295):
    y = (μ_w + σ_w ⊙ f(ε_out) f(ε_in)ᵀ) x + μ_b + σ_b ⊙ f(ε_out), with f(ε) = sign(ε) √|ε|.

    Noise is passed to each call (:func:`draw_noise`), so it is independent of train or eval mode (SB3 explores in eval mode)
    and is never stored. All samples of a batch share one draw.

    :param in_features: size of the input
    :param out_features: size of the output
    :param sigma_init: σ₀, ≥ 0; 0.5 in the paper and in Table 5
    """

    SMALL_BATCH = 10  # for smaller batches, two products cost less than building a noisy weight matrix for one product

    def __init__(self, in_features: int, out_features: int, sigma_init: float = 0.5):
        super().__init__()
        bound = 1 / sqrt(in_features)
        self.weight = nn.Parameter(th.empty(out_features, in_features).uniform_(-bound, bound))
        self.bias = nn.Parameter(th.empty(out_features).uniform_(-bound, bound))
        self.weight_sigma = nn.Parameter(th.full((out_features, in_features), sigma_init * bound))
        self.bias_sigma = nn.Parameter(th.full((out_features,), sigma_init * bound))

    def forward(self, inputs: th.Tensor, noise: Noise | NoisyWeights | None = None) -> th.Tensor:
        """
        :param inputs: (B, in_features)
        :param noise: noise for this layer, or its weights with noise; ``None``: use the mean weights
        :return: (B, out_features)
        """
        if noise is None:
            return F.linear(inputs, self.weight, self.bias)
        if isinstance(noise, Noise) and len(inputs) < self.SMALL_BATCH:
            noisy = F.linear(inputs * noise.into, self.weight_sigma, self.bias_sigma)
            return th.addcmul(F.linear(inputs, self.weight, self.bias), noisy, noise.out)
        return F.linear(inputs, *(self.with_noise(noise) if isinstance(noise, Noise) else noise))

    def with_noise(self, noise: Noise) -> NoisyWeights:
        """The weights with this noise."""
        weight = th.addcmul(self.weight, self.weight_sigma, th.outer(noise.out, noise.into))
        return NoisyWeights(weight, th.addcmul(self.bias, self.bias_sigma, noise.out))

    def extra_repr(self) -> str:
        """As in ``nn.Linear``."""
        return "in_features={1}, out_features={0}".format(*self.weight.shape)


def draw_noise(layers: Sequence[NoisyLinear]) -> list[Noise]:
    """
    Draw the noise f(ε) = sign(ε) √|ε| for one call of each layer, from torch's generator, in a single draw.

    :param layers: at least one layer
    :return: the noise for each layer
    """
    sizes = [size for layer in layers for size in layer.weight.shape]
    weight = layers[0].weight
    noise = th.randn(sum(sizes), device=weight.device, dtype=weight.dtype)
    pieces = th.copysign(noise.abs().sqrt_(), noise).split_with_sizes(sizes)
    return list(map(Noise, pieces[::2], pieces[1::2]))


class MLP(nn.Sequential):
    """
    Linear layers with activations between them.

    :param sizes: input size, hidden sizes, output size
    :param activation_fn: activation after every layer except the last
    :param sigma_init: initial noise of noisy layers; ``None`` for plain layers
    """

    def __init__(self, sizes: list[int], activation_fn: type[nn.Module], sigma_init: float | None):
        modules: list[nn.Module] = []
        for n_in, n_out in pairwise(sizes):
            linear = nn.Linear(n_in, n_out) if sigma_init is None else NoisyLinear(n_in, n_out, sigma_init)
            modules += [linear, activation_fn()]
        super().__init__(*modules[:-1])

    def forward(self, inputs: th.Tensor, noise: Iterator[Noise | NoisyWeights] | None = None) -> th.Tensor:
        """
        :param inputs: (B, sizes[0])
        :param noise: noise for the noisy layers, in order; ``None``: use their mean weights
        :return: (B, sizes[-1])
        """
        for module in self:
            inputs = module(inputs) if noise is None or not isinstance(module, NoisyLinear) else module(inputs, next(noise))
        return inputs


class DistributionalHead(nn.Module):
    """
    Map features to ``n_atoms`` numbers (quantiles or logits) per action.

    With ``dueling``, the head has a value and an advantage stream (Wang et al. 2016, https://arxiv.org/abs/1511.06581);
    otherwise only the advantage stream. The first layers of both streams are merged into one layer of twice the width, because
    one product is faster than two.

    :param features_dim: D
    :param n_actions: A
    :param n_atoms: N
    :param net_arch: hidden sizes
    :param activation_fn: activation between layers
    :param dueling: whether to use separate value and advantage streams
    :param sigma_init: initial noise of noisy layers; ``None`` for plain layers
    """

    def __init__(
        self,
        features_dim: int,
        n_actions: int,
        n_atoms: int,
        net_arch: list[int],
        activation_fn: type[nn.Module],
        dueling: bool,
        sigma_init: float | None,
    ):
        super().__init__()
        self.n_atoms = n_atoms
        self.n_actions = n_actions
        sizes = [n_actions * n_atoms, n_atoms] if dueling else [n_actions * n_atoms]  # of the streams' outputs
        widths = [width * len(sizes) for width in net_arch[:1]]
        self.first = MLP([features_dim, *widths], activation_fn, sigma_init)
        streams = [MLP([*(net_arch or [features_dim]), size], activation_fn, sigma_init) for size in sizes]
        self.advantage, self.value = streams[0], streams[1] if dueling else None
        self.activation = activation_fn()
        modules = [self.first, *streams]
        self._noisy_layers = [layer for module in modules for layer in module if isinstance(layer, NoisyLinear)]

    def draw_noise(self) -> list[Noise] | None:
        """Draw noise for one call; ``None`` without noisy layers."""
        return draw_noise(self._noisy_layers) if self._noisy_layers else None

    def with_noise(self, noise: list[Noise] | None) -> list[NoisyWeights] | None:
        """The weights with this noise, for several calls."""
        return None if noise is None else [layer.with_noise(n) for layer, n in zip(self._noisy_layers, noise, strict=True)]

    def forward(self, features: th.Tensor, noise: Sequence[Noise | NoisyWeights] | None = None) -> th.Tensor:
        """
        :param features: (B, D)
        :param noise: from :meth:`draw_noise` or :meth:`with_noise`, for all samples; ``None``: use the mean weights
        :return: (B, N, A)
        """
        left = None if noise is None else iter(noise)  # for the layers to come
        hidden = self.activation(self.first(features, left)) if len(self.first) else features
        if self.value is None:
            return self.advantage(hidden, left).view(-1, self.n_atoms, self.n_actions)
        of_advantage, of_value = hidden.chunk(2, dim=1) if len(self.first) else (hidden, hidden)
        advantage = self.advantage(of_advantage, left).view(-1, self.n_atoms, self.n_actions)
        value = self.value(of_value, left)[:, :, None]  # (B, N, 1)
        return value + advantage - advantage.mean(dim=2, keepdim=True)

    @th.no_grad()
    def shift(self, outputs: th.Tensor) -> None:
        """
        Add to the biases of the last layer, so that the outputs for every action change by the same numbers.

        :param outputs: (N,)
        """
        last: Any = (self.advantage if self.value is None else self.value)[-1]
        last.bias += outputs.repeat_interleave(len(last.bias) // self.n_atoms)  # (N * A,) or (N,)


class Centering(nn.Module):
    """
    Subtract the running mean of the features, the part that is the same for all observations. A call in train mode that
    records gradients notes the mean of its batch, and :meth:`update` moves the running mean towards that one, so all calls of
    the same update subtract the same mean.

    The gradient is centred as well, as if the mean of the batch were subtracted. Otherwise the loss would ask, at each
    update, for a constant that the running mean then removes, and the features would grow without bound (Ioffe and Szegedy
    2015, section 2, https://arxiv.org/abs/1502.03167).

    The weight of a batch is 1 - 3 e / d, at least 0.01. d is the squared distance of its mean from the running mean; e, the
    variance of the features divided by the size of the batch, is how large d is by chance, on average; three times as much is
    rare. So the running mean averages over batches, unless the features have moved. With a fixed weight it lags behind
    features that move fast, which leaves a constant (docs/gradients.md). With 1 in place of 3 this would be the estimator of
    James and Stein (Efron and Morris 1973, https://doi.org/10.1080/01621459.1973.10481350), which also follows some chance.

    A batch of one observation has no variance: it does not move the running mean, and its gradient is not centred.

    :param n_features: D
    """

    SMALLEST_WEIGHT = 0.01  # at rest, average over 100 batches or more
    BY_CHANCE = 3.0  # a batch that is further away than this times e has moved

    running_mean: th.Tensor  # (D,)
    running_count: th.Tensor  # batches so far
    batch_mean: th.Tensor  # (D,)
    batch_error: th.Tensor  # (), e

    def __init__(self, n_features: int):
        super().__init__()
        self.register_buffer("running_mean", th.zeros(n_features))
        self.register_buffer("running_count", th.zeros(()))
        self.register_buffer("batch_mean", th.zeros(n_features), persistent=False)
        self.register_buffer("batch_error", th.zeros(()), persistent=False)

    def forward(self, features: th.Tensor) -> th.Tensor:
        """
        :param features: (B, D)
        :return: (B, D)
        """
        if self.training and th.is_grad_enabled() and len(features) > 1:
            mean = features.mean(dim=0)
            deviations = features.detach() - mean.detach()
            self.batch_mean.copy_(mean.detach())  # th.var_mean takes 10 to 20 times as long as this along the first dimension
            self.batch_error.copy_(deviations.square().sum() / ((len(features) - 1) * len(features)))
            features = features - (mean - mean.detach())  # subtracts 0; the gradient loses its mean
        elif self.training and th.is_grad_enabled():
            self.batch_mean.copy_(self.running_mean)  # update then moves nothing
        return features - self.running_mean

    def update(self) -> None:
        """Called after each gradient step; without effect in eval mode."""
        if self.training:
            self.running_count += 1
            distance = (self.batch_mean - self.running_mean).square().sum().clamp(min=1e-30)
            weight = (1 - self.BY_CHANCE * self.batch_error / distance).clamp(min=self.SMALLEST_WEIGHT)
            self.running_mean.lerp_(self.batch_mean, weight)
