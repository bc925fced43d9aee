"""EqR: equivariant representations for data-efficient reinforcement learning, on Stable-Baselines3."""

from sb3_eqr import envs as envs  # registers its environments
from sb3_eqr.common.groups import MatrixLieGroup, make_group
from sb3_eqr.common.networks.encoders import GroupFeaturesExtractor
from sb3_eqr.common.replay.buffers import PrioritizedSequenceReplayBuffer, SequenceReplayBuffer
from sb3_eqr.common.saving.checkpoints import ExactCheckpointCallback
from sb3_eqr.configurations import load_configuration
from sb3_eqr.eqr_qrdqn import EqRQRDQN
from sb3_eqr.eqr_rainbow import EqRRainbow

__version__ = "0.1.0"

AGENTS = {"eqr_qrdqn": EqRQRDQN, "eqr_rainbow": EqRRainbow}  # by their names in RL Zoo and on the command line

__all__ = [
    "EqRQRDQN",
    "EqRRainbow",
    "ExactCheckpointCallback",
    "GroupFeaturesExtractor",
    "MatrixLieGroup",
    "PrioritizedSequenceReplayBuffer",
    "SequenceReplayBuffer",
    "load_configuration",
    "make_group",
]
