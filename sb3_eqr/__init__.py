"""EqR: equivariant representations for data-efficient reinforcement learning, on Stable-Baselines3."""

from sb3_eqr import envs as envs  # registers its environments
from sb3_eqr.common.actor_critic import EqRActorCritic
from sb3_eqr.common.eqr_algorithm import EqRAlgorithm
from sb3_eqr.common.groups import MatrixLieGroup, make_group
from sb3_eqr.common.networks.encoders import GroupFeaturesExtractor
from sb3_eqr.common.off_policy import EqROffPolicy
from sb3_eqr.common.replay.buffers import PrioritizedSequenceReplayBuffer, SequenceReplayBuffer
from sb3_eqr.common.saving.checkpoints import ExactCheckpointCallback
from sb3_eqr.configurations import load_configuration
from sb3_eqr.eqr_qrdqn import EqRQRDQN
from sb3_eqr.eqr_rainbow import EqRRainbow
from sb3_eqr.eqr_sac import EqRSAC
from sb3_eqr.eqr_tqc import EqRTQC

__version__ = "0.1.0"

# Agents by their names in RL Zoo and on the command line: for discrete and for continuous actions.
DISCRETE: dict[str, type[EqRAlgorithm]] = {"eqr_qrdqn": EqRQRDQN, "eqr_rainbow": EqRRainbow}
CONTINUOUS: dict[str, type[EqRActorCritic]] = {"eqr_sac": EqRSAC, "eqr_tqc": EqRTQC}
AGENTS: dict[str, type[EqROffPolicy]] = {**DISCRETE, **CONTINUOUS}

__all__ = [
    "EqRQRDQN",
    "EqRRainbow",
    "EqRSAC",
    "EqRTQC",
    "ExactCheckpointCallback",
    "GroupFeaturesExtractor",
    "MatrixLieGroup",
    "PrioritizedSequenceReplayBuffer",
    "SequenceReplayBuffer",
    "load_configuration",
    "make_group",
]
