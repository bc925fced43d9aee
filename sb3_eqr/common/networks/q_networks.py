"""What online and target networks of every EqR agent have in common."""

from abc import abstractmethod
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_eqr.common.networks.layers import DistributionalHead
from sb3_eqr.common.type_aliases import PyTorchObs


class EqRNetwork(BasePolicy):
    """
    A features extractor and a distributional head: an online or a target network.

    :param observation_space: Observation space
    :param action_space: Action space
    :param features_extractor: the group encoder
    :param features_dim: D
    :param net_arch: hidden sizes of the head
    :param activation_fn: Activation function of the head
    :param normalize_images: Whether to divide images by 255
    :param n_atoms: N, how many numbers the head has per action: quantiles or atoms
    :param dueling: whether the head splits value from advantage
    :param sigma_init: initial noise of noisy layers; ``None`` for plain ones
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Discrete,
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        net_arch: list[int],
        activation_fn: type[nn.Module],
        normalize_images: bool,
        n_atoms: int,
        dueling: bool,
        sigma_init: float | None,
    ):
        # Not the constructor of the stock network beside it: that would build a head that is thrown away.
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
        self.n_atoms = n_atoms
        self.dueling = dueling
        self.sigma_init = sigma_init
        self.head = DistributionalHead(
            features_dim, int(action_space.n), n_atoms, net_arch, activation_fn, dueling, sigma_init
        )

    def features(self, obs: PyTorchObs) -> th.Tensor:
        """
        :param obs: (B, *obs_shape), or a dict of these
        :return: (B, D)
        """
        return self.extract_features(obs, self.features_extractor)

    def encode(self, preprocessed_obs: PyTorchObs) -> th.Tensor:
        """
        :meth:`features` of observations that have been through SB3's ``preprocess_obs``.

        :param preprocessed_obs: floats, (B, ...), or a dict of these
        :return: (B, D)
        """
        return self.features_extractor(preprocessed_obs)

    @abstractmethod
    def expectation(self, outputs: th.Tensor) -> th.Tensor:
        """
        :param outputs: of the head, (B, N, A), or those of one action, (B, N)
        :return: Q values, (B, A), or (B,)
        """

    @abstractmethod
    def td_loss(
        self, current: th.Tensor, following: th.Tensor, rewards: th.Tensor, discounts: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        The head's own loss.

        :param current: outputs of the online head for (s_t, a_t), (B, N)
        :param following: those of the target head after the n-step transition, for the best action, no gradient, (B, N)
        :param rewards: the n-step return, (B, 1)
        :param discounts: 0 where the transition ended in a terminal state, γ to its length elsewhere, (B, 1)
        :return: loss, (B,), and priorities ≥ 0 without gradient, (B,)
        """

    def _predict(self, observation: PyTorchObs, deterministic: bool = True) -> th.Tensor:
        outputs = self.head(self.features(observation), noisy=not deterministic)
        return self.expectation(outputs).argmax(dim=1)  # (B,)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **BasePolicy._get_constructor_parameters(self),
            "features_extractor": self.features_extractor,
            "features_dim": self.features_dim,
            "net_arch": self.net_arch,
            "activation_fn": self.activation_fn,
            "n_atoms": self.n_atoms,
            "dueling": self.dueling,
            "sigma_init": self.sigma_init,
        }
