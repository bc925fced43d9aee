"""Policies of EqRSAC: SB3's SAC policies, whose actor and critics also read a latent state."""

from typing import ClassVar

import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.sac.policies import Actor, SACPolicy

from sb3_eqr.common.actor_critic_policies import EqRActorCriticPolicy, PredictsState, ReadsLatent
from sb3_eqr.common.networks.encoders import ConvExtractor, DictExtractor
from sb3_eqr.common.type_aliases import PyTorchObs


class EqRSACActor(ReadsLatent, Actor):
    """SAC's actor, which reads the latent state."""


class EqRSACCritic(PredictsState, ContinuousCritic):
    """SAC's critics, which read the latent state and the predicted next one."""

    def q1_forward(self, obs: PyTorchObs, actions: th.Tensor) -> th.Tensor:  # type: ignore[override]
        return self(obs, actions)[0]


class EqRSACPolicy(EqRActorCriticPolicy, SACPolicy):
    """Policy of EqRSAC; the parameters are those of :class:`~sb3_eqr.common.actor_critic_policies.EqRActorCriticPolicy`."""

    actor_class = EqRSACActor
    critic_class = EqRSACCritic
    stock_extractor_class: ClassVar[type[BaseFeaturesExtractor]] = FlattenExtractor


MlpPolicy = EqRSACPolicy


class CnnPolicy(EqRSACPolicy):
    """:class:`EqRSACPolicy` for images: the encoder is the paper's three convolutions."""

    default_trunk_class: ClassVar[type[BaseFeaturesExtractor]] = ConvExtractor
    stock_extractor_class: ClassVar[type[BaseFeaturesExtractor]] = NatureCNN


class MultiInputPolicy(EqRSACPolicy):
    """:class:`EqRSACPolicy` for dict observations."""

    default_trunk_class: ClassVar[type[BaseFeaturesExtractor]] = DictExtractor
    stock_extractor_class: ClassVar[type[BaseFeaturesExtractor]] = CombinedExtractor
