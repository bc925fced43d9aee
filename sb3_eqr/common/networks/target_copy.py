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
        self._parameters: tuple[list[th.Tensor], list[th.Tensor]] | None = None  # of the networks, and of their copies
        self._buffers: list[tuple[nn.Module, str, th.Tensor]] = []  # those that are copied: module, name, copy
        self._of_features: list[tuple[th.Tensor, th.Tensor, th.Tensor]] = []  # count of the copy, statistic, its copy

    def update(self, tau: float) -> None:
        """
        Update the copies with coefficient ``tau`` in [0, 1]; 1 copies.

        Persistent buffers, as batch norm's statistics, are always copied (https://github.com/DLR-RM/stable-baselines3/issues/996).
        Statistics of features (``Centering``, ``Whitening``) belong to the weights that made the features, so they are
        averaged, too; the first ones are copied, in place of the initial zeros.
        """
        online, target = self._found()
        with th.no_grad():
            if tau < 1:
                th._foreach_mul_(target, 1 - tau)
                th._foreach_add_(target, online, alpha=tau)
            else:
                th._foreach_copy_(target, online)
            for count, statistic, copy in self._of_features:
                copy.lerp_(statistic, th.where(count == 0, 1.0, tau))
            if self._buffers:  # a module may have replaced its tensor
                copies = [copy for _, _, copy in self._buffers]
                th._foreach_copy_(copies, [module.get_buffer(name) for module, name, _ in self._buffers])

    def forget_tensors(self) -> None:
        """Call this when moving to another device, because buffers are then replaced by new tensors."""
        self._parameters = None

    def _found(self) -> tuple[list[th.Tensor], list[th.Tensor]]:
        if self._parameters is None:
            modules = [pair for a, b in self.pairs for pair in zip(a.modules(), b.modules(), strict=True)]
            parameters = [pair for a, b in self.pairs for pair in zip(a.parameters(), b.parameters(), strict=True)]
            self._parameters = [own for own, _ in parameters], [copy for _, copy in parameters]
            self._buffers, self._of_features = [], []
            for module, its_copy in modules:
                # The buffers themselves, because the tensors of a state dict stop sharing their memory once pickled.
                found, copies = dict(module.named_buffers(recurse=False)), dict(its_copy.named_buffers(recurse=False))
                for name in (name for name in found if name in module.state_dict()):
                    if "running_count" in found and "running_" in name and name != "running_count":
                        self._of_features.append((copies["running_count"], found[name], copies[name]))
                    else:
                        self._buffers.append((module, name, copies[name]))
        return self._parameters
