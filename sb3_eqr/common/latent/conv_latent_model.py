"""The latent model of SPR (Schwarzer et al. 2021, https://arxiv.org/abs/2007.05929): convolutions predict the feature map."""

from math import prod

import torch as th
from torch import nn

from sb3_eqr.common.groups import NoGroup
from sb3_eqr.common.latent.latent_model import LatentModel
from sb3_eqr.common.latent.options import LatentOptions
from sb3_eqr.common.losses import rescaled


class ConvLatentModel(LatentModel):
    """
    Appends the action embedding to the C channels as constant planes, applies two 3×3 convolutions with ReLUs, with batch norm
    after the first, and rescales each sample to [0, 1] (SPR, §2.2 and appendix). It has no GET loss.

    :param map_shape: shape (C, H, W) of the trunk's features
    :param action_dim: as in :class:`~sb3_eqr.common.latent.latent_model.LatentModel`, like the next two
    :param options: all other options
    :param projection: p of the AET loss
    """

    def __init__(
        self,
        map_shape: tuple[int, int, int],
        action_dim: int,
        options: LatentOptions,
        projection: nn.Module | None = None,
    ):
        self.map_shape = map_shape
        super().__init__(nn.Identity(), NoGroup(prod(map_shape)), 1, action_dim, options, projection)

    def _make_transition(self, width: int, norm: str) -> None:
        channels = self.map_shape[0]
        self.transition = nn.Sequential(
            nn.Conv2d(channels + self.action_dim, channels, 3, padding=1),
            nn.ReLU(),
            nn.BatchNorm2d(channels),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.ReLU(),
        )

    def action_element(self, state: th.Tensor, action: th.Tensor) -> th.Tensor:
        """The next state, (B, 1, D), of states, (B, D), and action embeddings, (B, A): without a group, it is κ(x, a)."""
        planes = action[..., None, None].expand(-1, -1, *self.map_shape[1:])  # (B, A, H, W)
        moved = self.transition(th.cat([state.view(-1, *self.map_shape), planes], dim=1))
        return rescaled(moved.flatten(1))[:, None]
