"""Layers that PyTorch does not have: noisy linear layers, the distributional head, whitening."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from math import sqrt
from typing import Any

import torch as th
from torch import nn
from torch.nn import functional as F

Noise = tuple[th.Tensor, th.Tensor]  # f(ε_out), (out_features,), and f(ε_in), (in_features,), of one layer


class NoisyLinear(nn.Module):
    """
    Linear layer with factorised Gaussian noise (Fortunato et al. 2018, Eq. 9 to 11, https://arxiv.org/abs/1706.10295):
    y = (μ_w + σ_w ⊙ f(ε_out) f(ε_in)ᵀ) x + μ_b + σ_b ⊙ f(ε_out), with f(ε) = sign(ε) √|ε|.

    Noise is given per call (:func:`draw_noise`): it does not depend on train or eval mode (SB3 explores in eval mode), and
    there is none to store. One draw serves the batch.

    :param in_features: size of the input
    :param out_features: size of the output
    :param sigma_init: σ₀, ≥ 0; 0.5 in the paper and in Table 5
    """

    SMALL_BATCH = 10  # below it, two products with vectors cost less than one with a noisy matrix, which has to be made

    def __init__(self, in_features: int, out_features: int, sigma_init: float = 0.5):
        super().__init__()
        bound = 1 / sqrt(in_features)
        self.weight = nn.Parameter(th.empty(out_features, in_features).uniform_(-bound, bound))
        self.bias = nn.Parameter(th.empty(out_features).uniform_(-bound, bound))
        self.weight_sigma = nn.Parameter(th.full((out_features, in_features), sigma_init * bound))
        self.bias_sigma = nn.Parameter(th.full((out_features,), sigma_init * bound))

    def forward(self, inputs: th.Tensor, noise: Noise | None = None) -> th.Tensor:
        """
        :param inputs: (B, in_features)
        :param noise: of this layer; ``None``: the mean weights
        :return: (B, out_features)
        """
        if noise is None:
            return F.linear(inputs, self.weight, self.bias)
        if len(inputs) < self.SMALL_BATCH:
            noise_out, noise_in = noise
            noisy = F.linear(inputs * noise_in, self.weight_sigma, self.bias_sigma)
            return th.addcmul(F.linear(inputs, self.weight, self.bias), noisy, noise_out)
        return _NoisyProduct.apply(inputs, self.weight, self.bias, self.weight_sigma, self.bias_sigma, *noise)

    def extra_repr(self) -> str:
        """As that of ``nn.Linear``."""
        return "in_features={1}, out_features={0}".format(*self.weight.shape)


class _NoisyProduct(th.autograd.Function):
    """
    The formula of :class:`NoisyLinear`. Its gradient by hand: that of σ_w is that of μ_w times the noise, one product, where
    autograd makes two and a copy of matrices that are larger than the batch.
    """

    @staticmethod
    def forward(
        ctx: Any,
        inputs: th.Tensor,
        weight: th.Tensor,
        bias: th.Tensor,
        weight_sigma: th.Tensor,
        bias_sigma: th.Tensor,
        noise_out: th.Tensor,
        noise_in: th.Tensor,
    ) -> th.Tensor:
        noise = th.outer(noise_out, noise_in)
        noisy_weight = th.addcmul(weight, weight_sigma, noise)
        ctx.save_for_backward(inputs, noisy_weight, noise, noise_out)
        return F.linear(inputs, noisy_weight, th.addcmul(bias, bias_sigma, noise_out))

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:
        inputs, noisy_weight, noise, noise_out = ctx.saved_tensors
        of_weight, of_bias = gradient.mT @ inputs, gradient.sum(dim=0)
        return gradient @ noisy_weight, of_weight, of_bias, of_weight * noise, of_bias * noise_out, None, None


def draw_noise(layers: Sequence[NoisyLinear]) -> list[Noise]:
    """
    Noise for one call of each layer, from torch's generator: f(ε) = sign(ε) √|ε| of all of them in one draw.

    :param layers: at least one
    """
    sizes = [size for layer in layers for size in layer.weight.shape]
    weight = layers[0].weight
    noise = th.randn(sum(sizes), device=weight.device, dtype=weight.dtype)
    pieces = th.copysign(noise.abs().sqrt_(), noise).split_with_sizes(sizes)
    return list(zip(pieces[::2], pieces[1::2], strict=True))


def make_linear(n_in: int, n_out: int, sigma_init: float | None) -> nn.Linear | NoisyLinear:
    """A noisy layer, or without ``sigma_init`` a plain one."""
    return nn.Linear(n_in, n_out) if sigma_init is None else NoisyLinear(n_in, n_out, sigma_init)


class MLP(nn.Sequential):
    """
    Linear layers with activations between them.

    :param sizes: input size, hidden sizes, output size
    :param activation_fn: activation after every layer but the last
    :param sigma_init: initial noise of noisy layers; ``None`` for plain ones
    """

    def __init__(self, sizes: list[int], activation_fn: type[nn.Module], sigma_init: float | None):
        modules: list[nn.Module] = []
        for n_in, n_out in pairwise(sizes):
            modules += [make_linear(n_in, n_out, sigma_init), activation_fn()]
        super().__init__(*modules[:-1])

    def forward(self, inputs: th.Tensor, noise: Iterator[Noise] | None = None) -> th.Tensor:
        """
        :param inputs: (B, sizes[0])
        :param noise: of the noisy layers one by one; ``None``: their mean weights
        :return: (B, sizes[-1])
        """
        for module in self:
            inputs = module(inputs) if noise is None or not isinstance(module, NoisyLinear) else module(inputs, next(noise))
        return inputs


class DistributionalHead(nn.Module):
    """
    State features to ``n_atoms`` numbers (quantiles or logits) per action.

    With ``dueling``, a value and an advantage stream (Wang et al. 2016, https://arxiv.org/abs/1511.06581); without it, the
    advantage stream alone is the head. The first layers of both are one layer, twice as wide: one product is faster than two.

    :param features_dim: D
    :param n_actions: A
    :param n_atoms: N
    :param net_arch: hidden sizes
    :param activation_fn: activation between layers
    :param dueling: whether to split value from advantage
    :param sigma_init: initial noise of noisy layers; ``None`` for plain ones
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
        self.projection_dim = sum(widths)  # P of :meth:`project`
        modules = [self.first, *streams]
        self._noisy_layers = [layer for module in modules for layer in module if isinstance(layer, NoisyLinear)]

    def forward(self, features: th.Tensor, noisy: bool = False) -> th.Tensor:
        """
        :param features: (B, D)
        :param noisy: draw noise in noisy layers; one draw serves the batch
        :return: (B, N, A)
        """
        noise = iter(draw_noise(self._noisy_layers)) if noisy and self._noisy_layers else None
        hidden = self.activation(self.first(features, noise)) if len(self.first) else features
        if self.value is None:
            return self.advantage(hidden, noise).view(-1, self.n_atoms, self.n_actions)
        of_advantage, of_value = hidden.chunk(2, dim=1) if len(self.first) else (hidden, hidden)
        advantage = self.advantage(of_advantage, noise).view(-1, self.n_atoms, self.n_actions)
        value = self.value(of_value, noise)[:, :, None]  # (B, N, 1)
        return value + advantage - advantage.mean(dim=2, keepdim=True)

    def project(self, features: th.Tensor) -> th.Tensor:
        """
        The projection p of the AET loss: the first layer of every stream, before its activation, noise off (appendix B.4).

        :param features: (N, D)
        :return: (N, P): P is the first hidden size, twice that if dueling
        """
        return self.first(features)


class Whitening(nn.Module):
    """
    Batch norm that looks at all features at once: mean 0, variance 1 and no correlation over the batch, by the Cholesky factor
    of the covariance (Siarohin et al. 2019, https://arxiv.org/abs/1806.00420). Without scale and offset, so that a collapse
    to a point is out of reach. A batch of B samples tells the covariance of D features only so well, so D / (D + B) of each
    correlation is not believed and stays: a feature that others explain keeps a variance of about that share of its own, not
    1. In eval mode the statistics are running means.

    :param n_features: D
    :param momentum: of the running means, as in PyTorch's batch norm
    """

    running_mean: th.Tensor  # (D,)
    running_covariance: th.Tensor  # (D, D)
    running_count: th.Tensor  # batches so far

    def __init__(self, n_features: int, momentum: float = 0.1):
        super().__init__()
        self.momentum = momentum
        self.register_buffer("running_mean", th.zeros(n_features))
        self.register_buffer("running_covariance", th.eye(n_features))
        self.register_buffer("running_count", th.zeros(()))

    def forward(self, features: th.Tensor) -> th.Tensor:
        """
        :param features: (B, D); B ≥ 2 in train mode
        :return: (B, D)
        """
        mean, covariance = self.running_mean, self.running_covariance
        if self.training:
            n, n_features = features.shape
            mean = features.mean(dim=0)
            centred = features - mean
            variances = th.diag(centred.square().mean(dim=0))
            covariance = th.lerp(centred.mT @ centred / n, variances, n_features / (n_features + n))
            with th.no_grad():
                self.running_count += 1
                weight = (1 / self.running_count).clamp(min=self.momentum)  # the first batch counts whole
                self.running_mean.lerp_(mean, weight)
                self.running_covariance.lerp_(covariance, weight)
        smallest = th.diag(1e-5 * covariance.diagonal() + 1e-12)  # relative: untrained features differ by very little
        factor, _ = th.linalg.cholesky_ex(covariance + smallest)
        return th.linalg.solve_triangular(factor, (features - mean).mT, upper=False).mT
