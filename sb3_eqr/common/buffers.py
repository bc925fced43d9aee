"""The replay buffers live in :mod:`sb3_eqr.common.replay`; this is their old import path."""

from sb3_eqr.common.replay.buffers import PrioritizedSequenceReplayBuffer, SequenceReplayBuffer

__all__ = ["PrioritizedSequenceReplayBuffer", "SequenceReplayBuffer"]
