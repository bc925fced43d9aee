"""Policies of EqRQRDQN: those of ``sb3_contrib.QRDQN`` with a group encoder, a dueling noisy head and a latent model."""

from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from sb3_contrib.qrdqn.policies import QRDQNPolicy, QuantileNetwork
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_eqr.common.checks import check_number
from sb3_eqr.common.features_extractor import DEFAULT_GROUP, ConvExtractor
from sb3_eqr.common.groups import Group
from sb3_eqr.common.layers import DistributionalHead
from sb3_eqr.common.policies import EqRNetwork, EqRPolicy

DEFAULT_NET_ARCH = (256,)  # appendix B.4


class EqRQuantileNetwork(EqRNetwork, QuantileNetwork):
    """
    Features extractor and quantile head.

    :param observation_space: Observation space
    :param action_space: Action space
    :param features_extractor: the group encoder
    :param features_dim: D
    :param n_quantiles: N
    :param net_arch: hidden sizes of the head
    :param activation_fn: Activation function
    :param normalize_images: Whether to divide images by 255
    :param dueling: whether the head splits value from advantage
    :param sigma_init: initial noise of noisy layers; ``None`` for plain ones
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Discrete,
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        n_quantiles: int,
        net_arch: list[int],
        activation_fn: type[nn.Module],
        normalize_images: bool,
        dueling: bool,
        sigma_init: float | None,
    ):
        # Not QuantileNetwork.__init__: it would build a head that is thrown away.
        BasePolicy.__init__(
            self,
            observation_space,
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
        )
        self.net_arch = net_arch
        self.activation_fn = activation_fn
        self.features_dim = features_dim
        self.n_quantiles = n_quantiles
        self.dueling = dueling
        self.sigma_init = sigma_init
        self.head = DistributionalHead(
            features_dim, int(action_space.n), n_quantiles, net_arch, activation_fn, dueling, sigma_init
        )

    def forward(self, obs: PyTorchObs, noisy: bool = False) -> th.Tensor:
        """
        :param obs: (B, *obs_shape), or a dict of these
        :param noisy: whether to draw noise in noisy layers
        :return: quantiles, (B, n_quantiles, n_actions)
        """
        return self.head(self.features(obs), noisy)

    def _predict(self, observation: PyTorchObs, deterministic: bool = True) -> th.Tensor:
        return self(observation, noisy=not deterministic).mean(dim=1).argmax(dim=1).reshape(-1)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "dueling": self.dueling, "sigma_init": self.sigma_init}


class EqRQRDQNPolicy(EqRPolicy, QRDQNPolicy):
    """
    Policy of EqRQRDQN. The parameters up to ``optimizer_kwargs`` are those of ``sb3_contrib``'s QRDQN policy.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param n_quantiles: number of quantiles; Table 5's support has 51
    :param net_arch: hidden sizes of the Q head; ``None``: [256] (appendix B.4)
    :param activation_fn: Activation function of the Q head
    :param features_extractor_class: the trunk; the group encoder is put behind it. ``None``: SB3's ``FlattenExtractor``
        (MlpPolicy), the paper's three convolutions (CnnPolicy), SB3's ``CombinedExtractor`` (MultiInputPolicy)
    :param features_extractor_kwargs: its keyword arguments
    :param normalize_images: Whether to divide images by 255 (True by default)
    :param optimizer_class: The optimizer to use, Adam by default
    :param optimizer_kwargs: its keyword arguments, excluding the learning rate
    :param group: what the blocks of the state are elements of, see :func:`~sb3_eqr.common.groups.make_group`;
        "none" for free vectors, ``None`` to take the trunk's features as they are (no encoder); both need ``get_coef=0``
    :param n_blocks: K; ``None``: 12, for T(n) 32 (Table 5), and 1 where the group's name counts its own blocks
    :param parameterization: of rotations, "euler" or "exp"
    :param dueling: value and advantage streams
    :param noisy: factorised noisy layers in the head
    :param sigma_init: their initial noise σ₀
    :param latent_hidden_dim: width of the hidden layers of κ, r_ψ, ρ and of the projection b
    :param shared_projection: whether the AET loss projects with the first layer of the Q head; else with a layer of its own
    :param reward_loss: set by the algorithm, see there
    :raises ValueError: for an argument out of its range
    """

    default_trunk_class: ClassVar[type[BaseFeaturesExtractor]] = FlattenExtractor
    quantile_net: EqRQuantileNetwork
    quantile_net_target: EqRQuantileNetwork

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Discrete,
        lr_schedule: Schedule,
        n_quantiles: int = 51,
        net_arch: list[int] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        group: str | Group | None = DEFAULT_GROUP,
        n_blocks: int | None = None,
        parameterization: str = "euler",
        dueling: bool = True,
        noisy: bool = True,
        sigma_init: float = 0.5,
        latent_hidden_dim: int = 256,
        shared_projection: bool = True,
        reward_loss: str = "mse",
    ):
        net_arch = list(DEFAULT_NET_ARCH) if net_arch is None else net_arch
        check_number("n_quantiles", n_quantiles, 1, whole=True)
        self._configure(
            group=group,
            n_blocks=n_blocks,
            parameterization=parameterization,
            dueling=dueling,
            noisy=noisy,
            sigma_init=sigma_init,
            latent_hidden_dim=latent_hidden_dim,
            shared_projection=shared_projection,
            reward_loss=reward_loss,
        )
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            n_quantiles,
            net_arch,
            activation_fn,
            features_extractor_class or self.default_trunk_class,
            features_extractor_kwargs,
            normalize_images,
            optimizer_class,
            optimizer_kwargs,
        )

    @property
    def online(self) -> EqRQuantileNetwork:
        return self.quantile_net

    @property
    def target(self) -> EqRQuantileNetwork:
        return self.quantile_net_target

    def make_quantile_net(self) -> EqRQuantileNetwork:
        net_args = self._update_features_extractor(self.net_args, features_extractor=None)
        sigma_init = self.sigma_init if self.noisy else None
        return EqRQuantileNetwork(**net_args, dueling=self.dueling, sigma_init=sigma_init).to(self.device)


MlpPolicy = EqRQRDQNPolicy


class CnnPolicy(EqRQRDQNPolicy):
    """:class:`EqRQRDQNPolicy` for images: the trunk is the paper's three convolutions. Same parameters."""

    default_trunk_class = ConvExtractor


class MultiInputPolicy(EqRQRDQNPolicy):
    """:class:`EqRQRDQNPolicy` for dict observations: the trunk is SB3's ``CombinedExtractor``. Same parameters."""

    default_trunk_class = CombinedExtractor
