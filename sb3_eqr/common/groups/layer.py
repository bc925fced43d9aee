"""The layer that maps features to group elements (Eq. 13, appendix B.4)."""

from math import prod

import torch as th
from torch import nn

from sb3_eqr.common.groups.base import Group
from sb3_eqr.common.groups.matrix import NoGroup, T
from sb3_eqr.common.groups.product import ProductGroup, make_group

DEFAULT_GROUP = "SE(2)"  # §7 and Table 5
DEFAULT_N_BLOCKS = 12  # Table 5, for SE(2) and GL(2)
DEFAULT_N_TRANSLATED = 64  # Table 5: 32 blocks of T(2)


class GroupLayer(nn.Module):
    """
    One linear layer to the Lie algebra, then K group elements, flattened (Eq. 13, appendix B.4).

    :param features_dim: F
    :param group: see :func:`~sb3_eqr.common.groups.make_group`
    :param n_blocks: K ≥ 1; ``None``: 12 (Table 5), or for T(n) as many as make 64 numbers, at least one (32 of T(2), Table 5),
        or 1 if the name contains the number of blocks ("SE(2)^8 x SO(3)^4"), which K multiplies, or is "none"
    :param parameterization: parameterization of rotations, "euler", "exp" or "gram-schmidt"
    :param whiten: whether to whiten the algebra parameters over the batch
        (:class:`~sb3_eqr.common.groups.layer.Whitening`): states cannot collapse to a point, and blocks are decorrelated
    :raises ValueError: if the group is unknown or ``n_blocks`` is below 1
    """

    def __init__(
        self,
        features_dim: int,
        group: str | Group = DEFAULT_GROUP,
        n_blocks: int | None = None,
        parameterization: str = "euler",
        whiten: bool = False,
    ):
        super().__init__()
        made = make_group(group, parameterization)
        if type(made) is ProductGroup and len(made.factors) == 1:  # "SE(2)^8": its blocks need not be split and joined
            made, count = made.factors[0]
            n_blocks = count * (n_blocks or 1)
        if n_blocks is None:
            n_blocks = max(DEFAULT_N_TRANSLATED // made.num_params, 1) if isinstance(made, T) else DEFAULT_N_BLOCKS
            n_blocks = 1 if isinstance(made, (ProductGroup, NoGroup)) else n_blocks
        if n_blocks < 1:
            raise ValueError(f"n_blocks must be an integer >= 1, got {n_blocks!r}.")
        self.group = made
        self.n_blocks = n_blocks
        self.state_dim = n_blocks * prod(made.element_shape)  # D
        factors = [factor for factor, _ in made.factors] if isinstance(made, ProductGroup) else [made]
        named = {factor.parameterization for factor in factors if hasattr(factor, "parameterization")}  # of objects, too
        parameterization = ", ".join(sorted(named)) or parameterization
        self.description = f"{made}^{n_blocks}, {parameterization}"  # the parameters' shapes do not determine the group
        n_params = n_blocks * made.num_params
        self.to_algebra: nn.Module = nn.Linear(features_dim, n_params)
        if whiten:
            self.to_algebra = nn.Sequential(self.to_algebra, Whitening(n_params))

    def extra_repr(self) -> str:
        """Group, number of blocks and size of the state."""
        return f"{self.group}, n_blocks={self.n_blocks}, state_dim={self.state_dim}"

    def forward(self, features: th.Tensor) -> th.Tensor:
        """Map features, (B, F), to K flattened elements, (B, D)."""
        device = features.device.type
        if th.amp.is_autocast_available(device) and th.is_autocast_enabled(device):
            with th.autocast(device, enabled=False):  # bfloat16 has no kernels for some maps, and no precision for others
                return self(features.float())
        params = self.to_algebra(features)  # (B, K * num_params)
        return self.group.element(params.view(-1, self.n_blocks, self.group.num_params)).flatten(1)


class Whitening(nn.Module):
    """
    Batch norm over all features jointly: mean 0, variance 1 and no correlations over the batch, using the Cholesky factor of
    the covariance (Siarohin et al. 2019, https://arxiv.org/abs/1806.00420). It has no scale and offset, so features cannot
    collapse to a point. A batch of B samples gives only a noisy estimate of the covariance of D features, so the estimated
    correlations are shrunk by the fraction D / (D + B), which is therefore not removed: a feature that is determined by the
    others keeps a variance of about half this fraction instead of 1. Eval mode uses running means of the statistics.

    :param n_features: D
    :param momentum: momentum of the running means, as in PyTorch's batch norm
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
        :param features: (B, D); B ≥ 2 in train mode, where statistics are those of the batch if a gradient is recorded
        :return: (B, D)
        """
        mean, covariance = self.running_mean, self.running_covariance
        if self.training and th.is_grad_enabled():
            n, n_features = features.shape
            mean = features.mean(dim=0)
            centred = features - mean
            variances = th.diag(centred.square().mean(dim=0))
            covariance = th.lerp(centred.mT @ centred / n, variances, n_features / (n_features + n))
            with th.no_grad():
                self.running_count += 1
                weight = (1 / self.running_count).clamp(min=self.momentum)  # the first batch has weight 1
                self.running_mean.lerp_(mean, weight)
                self.running_covariance.lerp_(covariance, weight)
        smallest = th.diag(1e-5 * covariance.diagonal() + 1e-12)  # relative, because untrained features vary very little
        factor, _ = th.linalg.cholesky_ex(covariance + smallest)
        return th.linalg.solve_triangular(factor, (features - mean).mT, upper=False).mT
