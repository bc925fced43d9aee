"""Policies of EqRSAC: SB3's SAC policies, whose actor and critics also read a latent state."""

import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.sac.policies import Actor, SACPolicy

from sb3_eqr.common.actor_critic_policies import EqRActorCriticPolicy, ForDicts, ForImages, PredictsState, ReadsLatent
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


MlpPolicy = EqRSACPolicy


class CnnPolicy(ForImages, EqRSACPolicy):
    """:class:`EqRSACPolicy` for images: the encoder is the paper's three convolutions."""


class MultiInputPolicy(ForDicts, EqRSACPolicy):
    """:class:`EqRSACPolicy` for dict observations."""
