"""Policies of EqRTQC: SB3-Contrib's TQC policies, whose actor and critics also read a latent state."""

from typing import ClassVar

from sb3_contrib.tqc.policies import Actor, Critic, TQCPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor, NatureCNN

from sb3_eqr.common.actor_critic_policies import EqRActorCriticPolicy, PredictsState, ReadsLatent
from sb3_eqr.common.networks.encoders import ConvExtractor, DictExtractor


class EqRTQCActor(ReadsLatent, Actor):
    """TQC's actor, which reads the latent state."""


class EqRTQCCritic(PredictsState, Critic):
    """TQC's critics, which read the latent state and the predicted next one."""


class EqRTQCPolicy(EqRActorCriticPolicy, TQCPolicy):
    """Policy of EqRTQC; the parameters are those of :class:`~sb3_eqr.common.actor_critic_policies.EqRActorCriticPolicy`."""

    actor_class = EqRTQCActor
    critic_class = EqRTQCCritic
    stock_extractor_class: ClassVar[type[BaseFeaturesExtractor]] = FlattenExtractor


MlpPolicy = EqRTQCPolicy


class CnnPolicy(EqRTQCPolicy):
    """:class:`EqRTQCPolicy` for images: the encoder is the paper's three convolutions."""

    default_trunk_class: ClassVar[type[BaseFeaturesExtractor]] = ConvExtractor
    stock_extractor_class: ClassVar[type[BaseFeaturesExtractor]] = NatureCNN


class MultiInputPolicy(EqRTQCPolicy):
    """:class:`EqRTQCPolicy` for dict observations."""

    default_trunk_class: ClassVar[type[BaseFeaturesExtractor]] = DictExtractor
    stock_extractor_class: ClassVar[type[BaseFeaturesExtractor]] = CombinedExtractor
