"""The latent model of SPR (Schwarzer et al. 2021, https://arxiv.org/abs/2007.05929): convolutions predict the feature map."""

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_eqr.common.latent.latent_model import LatentModel
from sb3_eqr.common.losses import rescaled


class ConvLatentModel(LatentModel):
    """
    Appends the action to the C channels as constant planes, applies two 3×3 convolutions with ReLUs, with batch norm after
    the first, and rescales each sample to [0, 1] (SPR, §2.2 and appendix). It has no GET loss.

    :param map_shape: shape (C, H, W) of the trunk's features
    :param n_actions: A
    :param hidden_dim: width of the hidden layer of r_ψ
    :param reward_loss: as in :class:`~sb3_eqr.common.latent.latent_model.LatentModel`
    :param aet_loss: as in :class:`~sb3_eqr.common.latent.latent_model.LatentModel`; SPR uses "distance"
    :param norm: of r_ψ, as in :class:`~sb3_eqr.common.latent.latent_model.LatentModel`
    """

    def __init__(
        self,
        map_shape: tuple[int, int, int],
        n_actions: int,
        hidden_dim: int = 256,
        reward_loss: str = "mse",
        aet_loss: str = "distance",
        norm: str = "layer",
    ):
        channels, height, width = map_shape
        super().__init__(channels * height * width, n_actions, hidden_dim, reward_loss, aet_loss, norm=norm)
        self.map_shape = map_shape
        self.transition = nn.Sequential(
            nn.Conv2d(channels + n_actions, channels, 3, padding=1),
            nn.ReLU(),
            nn.BatchNorm2d(channels),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.ReLU(),
        )
        self.projection = nn.Identity()  # no GET loss

    def rollout(self, state: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Predict x̂_1 ... x̂_M, (B, M, C * H * W), from x₀, (B, C * H * W), and actions, int64, (B, M)."""
        one_hot = F.one_hot(actions, self.n_actions).to(state.dtype)  # (B, M, A)
        planes = one_hot[..., None, None].expand(-1, -1, -1, *self.map_shape[1:])  # (B, M, A, H, W)
        states = [state]
        for plane in planes.unbind(1):
            moved = self.transition(th.cat([states[-1].view(-1, *self.map_shape), plane], dim=1))
            states.append(rescaled(moved.flatten(1)))
        return th.stack(states[1:], dim=1)
