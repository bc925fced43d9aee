"""Target networks of Q-learning and of the latent model: copies that track the online networks."""

from collections.abc import Sequence

import torch as th
from torch import nn


class TargetCopy:
    """
    Networks and their target copies.

    :param pairs: each network with its copy, which has the same parameters and buffers
    """

    def __init__(self, pairs: Sequence[tuple[nn.Module, nn.Module]]):
        self.pairs = list(pairs)
        self.is_exact = True  # whether the copies currently equal the networks; False after a gradient step
        self._tensors: tuple[list[th.Tensor], ...] | None = None

    def update(self, tau: float) -> None:
        """Update the copies with coefficient ``tau`` in [0, 1]; 1 copies."""
        online, target, online_statistics, target_statistics = self._found()
        self.is_exact = tau == 1
        with th.no_grad():
            if tau < 1:
                th._foreach_mul_(target, 1 - tau)
                th._foreach_add_(target, online, alpha=tau)
                target, online = [], []
            target, online = target + target_statistics, online + online_statistics
            if target:  # statistics are always copied, see https://github.com/DLR-RM/stable-baselines3/issues/996
                th._foreach_copy_(target, online)

    def compare(self) -> None:
        """Check whether the copies are exact after loading parameters."""
        online, target, online_statistics, target_statistics = self._found()
        pairs = zip([*online, *online_statistics], [*target, *target_statistics], strict=True)
        self.is_exact = all(th.equal(*pair) for pair in pairs)

    def forget_tensors(self) -> None:
        """Call this when moving to another device, because buffers are then replaced by new tensors."""
        self._tensors = None

    def _found(self) -> tuple[list[th.Tensor], ...]:
        """Parameters of the networks and of their copies, then running statistics of both."""
        if self._tensors is None:
            sides = list(zip(*self.pairs, strict=True))
            parameters = [[p for module in side for p in module.parameters()] for side in sides]
            # The buffers themselves, because the tensors of a state dict stop sharing their memory once pickled.
            statistics = [[b for module in side for n, b in module.named_buffers() if "running_" in n] for side in sides]
            self._tensors = (*parameters, *statistics)
        return self._tensors
