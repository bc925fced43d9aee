"""Layers that PyTorch does not have: noisy linear layers, the distributional head, whitening."""

from itertools import pairwise
from math import sqrt

import torch as th
from torch import nn
from torch.nn import functional as F


class NoisyLinear(nn.Module):
    """
    Linear layer with factorised Gaussian noise (Fortunato et al. 2018, Eq. 9 to 11, https://arxiv.org/abs/1706.10295):
    y = (μ_w + σ_w ⊙ f(ε_out) f(ε_in)ᵀ) x + μ_b + σ_b ⊙ f(ε_out), with f(ε) = sign(ε) √|ε|.

    Noise is asked for per call and drawn afresh each time, from torch's generator: it does not depend on train or eval
    mode (SB3 explores in eval mode), and there is no noise to store. One draw serves the whole batch.

    :param in_features: size of the input
    :param out_features: size of the output
    :param sigma_init: σ₀, ≥ 0; 0.5 in the paper and in Table 5
    """

    def __init__(self, in_features: int, out_features: int, sigma_init: float = 0.5):
        super().__init__()
        bound = 1 / sqrt(in_features)
        self.weight = nn.Parameter(th.empty(out_features, in_features).uniform_(-bound, bound))
        self.bias = nn.Parameter(th.empty(out_features).uniform_(-bound, bound))
        self.weight_sigma = nn.Parameter(th.full((out_features, in_features), sigma_init * bound))
        self.bias_sigma = nn.Parameter(th.full((out_features,), sigma_init * bound))

    def forward(self, inputs: th.Tensor, noisy: bool = False) -> th.Tensor:
        """
        :param inputs: (..., in_features)
        :param noisy: whether to draw noise; without it, the mean weights
        :return: (..., out_features)
        """
        if not noisy:
            return F.linear(inputs, self.weight, self.bias)
        n_out, n_in = self.weight.shape
        noise = th.randn(n_out + n_in, device=inputs.device, dtype=inputs.dtype)
        noise_out, noise_in = th.copysign(noise.abs().sqrt(), noise).split([n_out, n_in])  # f(ε)
        # One product with the noisy matrix costs less than two with its parts, from a batch of some ten samples on.
        weight = th.addcmul(self.weight, self.weight_sigma, th.outer(noise_out, noise_in))
        return F.linear(inputs, weight, th.addcmul(self.bias, self.bias_sigma, noise_out))


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
            layer = nn.Linear(n_in, n_out) if sigma_init is None else NoisyLinear(n_in, n_out, sigma_init)
            modules += [layer, activation_fn()]
        super().__init__(*modules[:-1])

    def forward(self, inputs: th.Tensor, noisy: bool = False) -> th.Tensor:
        for module in self:
            inputs = module(inputs, noisy) if isinstance(module, NoisyLinear) else module(inputs)
        return inputs


class DistributionalHead(nn.Module):
    """
    State features to ``n_atoms`` numbers (quantiles or logits) per action.

    With ``dueling``, a value and an advantage stream, each an MLP of its own (Wang et al. 2016,
    https://arxiv.org/abs/1511.06581); without it, the advantage stream alone is the head.

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
        self.advantage = MLP([features_dim, *net_arch, n_actions * n_atoms], activation_fn, sigma_init)
        self.value = MLP([features_dim, *net_arch, n_atoms], activation_fn, sigma_init) if dueling else None

    def forward(self, features: th.Tensor, noisy: bool = False) -> th.Tensor:
        """
        :param features: (B, D)
        :param noisy: draw noise in noisy layers
        :return: (B, N, A)
        """
        advantage = self.advantage(features, noisy).view(-1, self.n_atoms, self.n_actions)
        if self.value is None:
            return advantage
        value = self.value(features, noisy)[:, :, None]  # (B, N, 1)
        return value + advantage - advantage.mean(dim=2, keepdim=True)

    def project(self, features: th.Tensor) -> th.Tensor:
        """
        The projection p of the AET loss: the first layer of every stream, before its activation, noise off (appendix B.4).

        :param features: (..., D)
        :return: (..., P): P is the first hidden size, twice that if dueling
        """
        streams = [self.advantage] if self.value is None else [self.value, self.advantage]
        rows = features.flatten(0, -2)  # a linear layer is slower on more than two dimensions
        return th.cat([stream[0](rows) for stream in streams], dim=-1).unflatten(0, features.shape[:-1])


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
