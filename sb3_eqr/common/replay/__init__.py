"""
Replay of windows: ``buffers`` draws them, ``frame_store`` keeps every frame once, ``sum_tree`` draws by priority.
"""

from sb3_eqr.common.replay.buffers import PrioritizedSequenceReplayBuffer, SequenceReplayBuffer

__all__ = ["PrioritizedSequenceReplayBuffer", "SequenceReplayBuffer"]
