"""Base class of the online and target networks of all EqR agents."""

from abc import abstractmethod
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_eqr.common.networks.layers import DistributionalHead
from sb3_eqr.common.type_aliases import PyTorchObs


class EqRNetwork(BasePolicy):
    """
    A features extractor and a distributional head: an online or a target network.

    :param observation_space: Observation space
    :param action_space: Action space
    :param features_extractor: the trunk, or the group encoder with ``head_input="state"``
    :param head: the Q head, which takes its features
    :param normalize_images: Whether to divide images by 255
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Discrete,
        features_extractor: BaseFeaturesExtractor,
        head: DistributionalHead,
        normalize_images: bool,
    ):
        # Skip the constructor of the stock network, which would build another head.
        BasePolicy.__init__(
            self, observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images
        )
        self.head = head

    def features(self, obs: PyTorchObs) -> th.Tensor:
        """Features, (B, D), of observations, (B, *obs_shape) or a dict of these."""
        return self.extract_features(obs, self.features_extractor)

    @abstractmethod
    def expectation(self, outputs: th.Tensor) -> th.Tensor:
        """
        :param outputs: outputs of the head, (B, N, A), or those for one action, (B, N)
        :return: Q values, (B, A), or (B,)
        """

    @abstractmethod
    def td_loss(
        self, current: th.Tensor, next_outputs: th.Tensor, rewards: th.Tensor, discounts: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        The TD loss of this kind of head.

        :param current: outputs of the online head for (s_t, a_t), (B, N)
        :param next_outputs: outputs of the target head after the n-step transition, for the best action, no gradient, (B, N)
        :param rewards: the n-step return, (B, 1)
        :param discounts: 0 where the transition ended in a terminal state, otherwise γ to the power of its length, (B, 1)
        :return: loss, (B,), and priorities ≥ 0 without gradient, (B,)
        """

    def _predict(self, observation: PyTorchObs, deterministic: bool = True) -> th.Tensor:
        outputs = self.head(self.features(observation), None if deterministic else self.head.draw_noise())
        return self.expectation(outputs).argmax(dim=1)  # (B,)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = BasePolicy._get_constructor_parameters(self)
        return {**data, "features_extractor": self.features_extractor, "head": self.head}
