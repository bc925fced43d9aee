"""Policies of EqRTQC: SB3-Contrib's TQC policies, whose actor and critics also read a latent state."""

from sb3_contrib.tqc.policies import Actor, Critic, TQCPolicy

from sb3_eqr.common.actor_critic_policies import EqRActorCriticPolicy, ForDicts, ForImages, PredictsState, ReadsLatent


class EqRTQCActor(ReadsLatent, Actor):
    """TQC's actor, which reads the latent state."""


class EqRTQCCritic(PredictsState, Critic):
    """TQC's critics, which read the latent state and the predicted next one."""


class EqRTQCPolicy(EqRActorCriticPolicy, TQCPolicy):
    """Policy of EqRTQC; the parameters are those of :class:`~sb3_eqr.common.actor_critic_policies.EqRActorCriticPolicy`."""

    actor_class = EqRTQCActor
    critic_class = EqRTQCCritic


MlpPolicy = EqRTQCPolicy


class CnnPolicy(ForImages, EqRTQCPolicy):
    """:class:`EqRTQCPolicy` for images: the encoder is the paper's three convolutions."""


class MultiInputPolicy(ForDicts, EqRTQCPolicy):
    """:class:`EqRTQCPolicy` for dict observations."""
