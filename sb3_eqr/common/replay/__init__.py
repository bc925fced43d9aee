"""
Replay of windows: ``buffers`` samples them, ``frame_store`` stores each frame once, ``sum_tree`` samples by priority.
"""

from sb3_eqr.common.replay.buffers import PrioritizedSequenceReplayBuffer, SequenceReplayBuffer

__all__ = ["PrioritizedSequenceReplayBuffer", "SequenceReplayBuffer"]
