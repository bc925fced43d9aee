"""Data types shared by the components of EqR. B is the batch size, M the prediction depth, D the flat state's size."""

from typing import NamedTuple

import numpy as np
import torch as th

PyTorchObs = th.Tensor | dict[str, th.Tensor]


class SequenceReplayBufferSamples(NamedTuple):
    """
    One window per sample: its n-step transition and its M-step rollout.
    The first six fields are those of SB3's ``ReplayBufferSamples``, with the same shapes.
    The rollout's fields are ``None`` if M = 0. Dict observations hold one tensor per key.
    """

    observations: PyTorchObs  # (B, *obs_shape): s_t
    actions: th.Tensor  # a_t: (B, 1), int64, or (B, action_dim) for Box actions
    next_observations: PyTorchObs  # (B, *obs_shape): the last observation of the n-step transition
    dones: th.Tensor  # (B, 1): 1 where that transition ended in a terminal state; 0 for time-outs
    rewards: th.Tensor  # (B, 1): the discounted n-step return
    discounts: th.Tensor  # (B, 1): γ to the power of the number of steps in that return
    indices: np.ndarray  # (B,), int64: leaves of the sum tree, position * n_envs + environment
    weights: th.Tensor  # (B,): importance weights, 1 for uniform replay
    rollout_observations: PyTorchObs | None = None  # (B, M, *obs_shape): s_{t+1} ... s_{t+M}
    rollout_actions: th.Tensor | None = None  # a_t ... a_{t+M-1}: (B, M), int64, or (B, M, action_dim) for Box actions
    rollout_rewards: th.Tensor | None = None  # (B, M): r_{t+1} ... r_{t+M}, one-step rewards
    mask: th.Tensor | None = None  # (B, M): 1 where the episode had not ended before step t+m
