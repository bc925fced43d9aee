"""Policies of EqRRainbow: SB3's DQN policies with a group encoder, a dueling noisy categorical head and a latent model."""

from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.dqn.policies import DQNPolicy, QNetwork

from sb3_eqr.common.checks.arguments import POLICY, check_arguments
from sb3_eqr.common.losses import categorical_loss, categorical_projection
from sb3_eqr.common.networks.encoders import ConvExtractor, DictExtractor
from sb3_eqr.common.networks.q_networks import EqRNetwork
from sb3_eqr.common.policies import EqRPolicy


class EqRCategoricalNetwork(EqRNetwork, QNetwork):
    """
    Features extractor and categorical head: for each action, the probabilities of N evenly spaced returns (C51).

    :param v_min: the lowest return
    :param v_max: the highest return
    :param kwargs: the parameters of :class:`~sb3_eqr.common.networks.q_networks.EqRNetwork`
    """

    support: th.Tensor  # (N,)

    def __init__(self, *args: Any, v_min: float, v_max: float, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.v_min = v_min
        self.v_max = v_max
        self.register_buffer("support", th.linspace(v_min, v_max, self.head.n_atoms), persistent=False)

    def forward(self, obs: PyTorchObs) -> th.Tensor:
        """Q values, (B, n_actions), of observations, (B, *obs_shape) or a dict of these, without noise."""
        return self.expectation(self.head(self.features(obs)))

    def expectation(self, outputs: th.Tensor) -> th.Tensor:
        support = self.support.view(-1, *[1] * (outputs.ndim - 2))  # (N, 1) or (N,)
        return (outputs.softmax(dim=1) * support).sum(dim=1)

    def td_loss(
        self, current: th.Tensor, next_outputs: th.Tensor, rewards: th.Tensor, discounts: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """The cross-entropy with the projected target distribution; the priority is the KL divergence between the two."""
        with th.no_grad():
            values = th.addcmul(rewards, discounts, self.support)  # (B, N)
            target = categorical_projection(values, next_outputs.softmax(dim=1), self.v_min, self.v_max)
        return categorical_loss(current, target)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "v_min": self.v_min, "v_max": self.v_max}


class EqRRainbowPolicy(EqRPolicy, DQNPolicy):
    """
    Policy of EqRRainbow.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param n_atoms: number of atoms of the return distribution, ≥ 2; 51 in Table 5
    :param v_min: the lowest return; -10 for rewards clipped to [-1, 1] (Bellemare et al. 2017)
    :param v_max: the highest return, > ``v_min``; 10 for rewards clipped to [-1, 1]
    :param spread_init: spread of the returns that an untrained head predicts, > 0, as a share of ``v_max - v_min``; with s
        this share times the range, p(z) is proportional to 1 / (1 + (z / s)²), a Cauchy distribution around 0, or around the
        return nearest to 0. 0.05 is 1 on the default range. ``None``: all returns are about equally likely, as in C51, and
        priorities then hardly depend on rewards (docs/gradients.md)
    :param kwargs: the parameters of :class:`~sb3_eqr.common.policies.EqRPolicy`
    :raises ValueError: if an argument is out of range
    """

    network_name = "q_net"
    q_net: EqRCategoricalNetwork
    q_net_target: EqRCategoricalNetwork

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Discrete,
        lr_schedule: Schedule,
        n_atoms: int = 51,
        v_min: float = -10.0,
        v_max: float = 10.0,
        spread_init: float | None = 0.05,
        **kwargs: Any,
    ):
        check_arguments({"n_atoms": n_atoms, "v_min": v_min, "v_max": v_max, "spread_init": spread_init}, POLICY)
        if v_min >= v_max:
            raise ValueError(f"v_min must be a finite number < v_max = {v_max}, got {v_min}. Pass the lowest possible return.")
        self.n_atoms = n_atoms
        self.v_min = v_min
        self.v_max = v_max
        self.spread_init = spread_init
        super().__init__(observation_space, action_space, lr_schedule, **kwargs)

    @property
    def description(self) -> dict[str, str]:
        return {**super().description, "support": f"[{float(self.v_min)}, {float(self.v_max)}]"}

    def make_q_net(self) -> EqRCategoricalNetwork:
        network = self._make_network(EqRCategoricalNetwork, self.n_atoms, v_min=self.v_min, v_max=self.v_max)
        if self.spread_init is not None:
            centre = network.support[network.support.abs().argmin()]
            scale = self.spread_init * (self.v_max - self.v_min)
            network.head.shift(-((network.support - centre) / scale).square().log1p())  # Cauchy, up to a constant
        return network


MlpPolicy = EqRRainbowPolicy


class CnnPolicy(EqRRainbowPolicy):
    """:class:`EqRRainbowPolicy` for images: the trunk is the paper's three convolutions. Same parameters."""

    default_trunk_class: ClassVar[type[BaseFeaturesExtractor]] = ConvExtractor


class MultiInputPolicy(EqRRainbowPolicy):
    """:class:`EqRRainbowPolicy` for dict observations: each image has the paper's convolutions. Same parameters."""

    default_trunk_class: ClassVar[type[BaseFeaturesExtractor]] = DictExtractor
