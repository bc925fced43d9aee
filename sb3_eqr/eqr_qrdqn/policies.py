"""Policies of EqRQRDQN: ``sb3_contrib.QRDQN``'s policies with a group encoder, a dueling noisy head and a latent model."""

from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from sb3_contrib.qrdqn.policies import QRDQNPolicy, QuantileNetwork
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule

from sb3_eqr.common.losses import quantile_huber_loss
from sb3_eqr.common.networks.encoders import ConvExtractor, DictExtractor
from sb3_eqr.common.networks.q_networks import EqRNetwork
from sb3_eqr.common.policies import EqRPolicy


class EqRQuantileNetwork(EqRNetwork, QuantileNetwork):
    """Features extractor and quantile head. See :class:`~sb3_eqr.common.networks.q_networks.EqRNetwork` for the parameters."""

    def forward(self, obs: PyTorchObs) -> th.Tensor:
        """Quantiles, (B, n_quantiles, n_actions), of observations, (B, *obs_shape) or a dict of these, without noise."""
        return self.head(self.features(obs))

    @property
    def n_quantiles(self) -> int:  # type: ignore[override]
        """As in ``sb3_contrib``'s network."""
        return self.head.n_atoms

    def expectation(self, outputs: th.Tensor) -> th.Tensor:
        return outputs.mean(dim=1)

    def td_loss(
        self, current: th.Tensor, next_outputs: th.Tensor, rewards: th.Tensor, discounts: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """The quantile Huber loss, which is also the priority."""
        loss = quantile_huber_loss(current, rewards + discounts * next_outputs)
        return loss, loss.detach()


class EqRQRDQNPolicy(EqRPolicy, QRDQNPolicy):
    """
    Policy of EqRQRDQN.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param n_quantiles: number of quantiles; the support in Table 5 has 51 atoms
    :param kwargs: the parameters of :class:`~sb3_eqr.common.policies.EqRPolicy`
    :raises ValueError: if an argument is out of range
    """

    network_name = "quantile_net"
    quantile_net: EqRQuantileNetwork
    quantile_net_target: EqRQuantileNetwork

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Discrete,
        lr_schedule: Schedule,
        n_quantiles: int = 51,
        **kwargs: Any,
    ):
        super().__init__(observation_space, action_space, lr_schedule, n_quantiles=n_quantiles, **kwargs)

    def make_quantile_net(self) -> EqRQuantileNetwork:
        return self._make_network(EqRQuantileNetwork, self.n_quantiles)


MlpPolicy = EqRQRDQNPolicy


class CnnPolicy(EqRQRDQNPolicy):
    """:class:`EqRQRDQNPolicy` for images: the trunk is the paper's three convolutions. Same parameters."""

    default_trunk_class: ClassVar[type[BaseFeaturesExtractor]] = ConvExtractor


class MultiInputPolicy(EqRQRDQNPolicy):
    """:class:`EqRQRDQNPolicy` for dict observations: each image has the paper's convolutions. Same parameters."""

    default_trunk_class: ClassVar[type[BaseFeaturesExtractor]] = DictExtractor
