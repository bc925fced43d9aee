"""Target networks of Q-learning and of the latent model: copies that track the online networks."""

from collections.abc import Sequence
from itertools import chain

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
        self._of_features: list[tuple[th.Tensor, th.Tensor, th.Tensor]] = []  # count of the copy, statistic, copy

    def update(self, tau: float) -> None:
        """
        Update the copies with coefficient ``tau`` in [0, 1]; 1 copies.

        Batch norm's statistics are always copied (https://github.com/DLR-RM/stable-baselines3/issues/996). Statistics of
        features (``Centering``, ``Whitening``) belong to the weights that made the features, so they are averaged like the
        weights; the first ones are copied, in place of the initial zeros.
        """
        online, target, online_statistics, target_statistics = self._found()
        self.is_exact = tau == 1
        with th.no_grad():
            if tau < 1:
                th._foreach_mul_(target, 1 - tau)
                th._foreach_add_(target, online, alpha=tau)
                for count, of_online, of_target in self._of_features:
                    of_target.lerp_(of_online, th.where(count == 0, 1.0, tau))
                target, online = [], []
            else:
                online_statistics = [*online_statistics, *(of_online for _, of_online, _ in self._of_features)]
                target_statistics = [*target_statistics, *(of_target for _, _, of_target in self._of_features)]
            target, online = target + target_statistics, online + online_statistics
            if target:
                th._foreach_copy_(target, online)

    def compare(self) -> None:
        """Check whether the copies are exact after loading parameters."""
        online, target, online_statistics, target_statistics = self._found()
        pairs = zip([*online, *online_statistics], [*target, *target_statistics], strict=True)
        of_features = ((of_online, of_target) for _, of_online, of_target in self._of_features)
        self.is_exact = all(th.equal(*pair) for pair in chain(pairs, of_features))

    def forget_tensors(self) -> None:
        """Call this when moving to another device, because buffers are then replaced by new tensors."""
        self._tensors = None

    def _found(self) -> tuple[list[th.Tensor], ...]:
        """Parameters of the networks and of their copies, then the statistics of both that are copied."""
        if self._tensors is None:
            sides = list(zip(*self.pairs, strict=True))
            online, target = ([module for network in side for module in network.modules()] for side in sides)
            parameters = [[p for module in side for p in module.parameters()] for side in sides]
            copied: tuple[list[th.Tensor], list[th.Tensor]] = [], []
            self._of_features = []
            for module, its_copy in zip(online, target, strict=True):
                # The buffers themselves, because the tensors of a state dict stop sharing their memory once pickled.
                found, found_copies = dict(module.named_buffers(recurse=False)), dict(its_copy.named_buffers(recurse=False))
                for name in (name for name in found if "running_" in name):
                    if "running_count" in found and name != "running_count":
                        self._of_features.append((found_copies["running_count"], found[name], found_copies[name]))
                    else:
                        copied[0].append(found[name])
                        copied[1].append(found_copies[name])
            self._tensors = (*parameters, *copied)
        return self._tensors
