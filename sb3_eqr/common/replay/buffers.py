"""Replay of windows: n-step transitions and M-step rollouts that start at the same step, from one storage."""

import warnings
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_eqr.common.checks.arguments import BUFFER, check_arguments
from sb3_eqr.common.checks.validation import check_transition
from sb3_eqr.common.replay.frame_store import FrameStore
from sb3_eqr.common.replay.sum_tree import SumTree
from sb3_eqr.common.type_aliases import PyTorchObs, SequenceReplayBufferSamples

try:
    import psutil
except ImportError:
    psutil = None  # type: ignore[assignment]


class SequenceReplayBuffer(ReplayBuffer):
    """
    Uniform replay of n-step transitions with M-step rollouts.

    ``add`` and ``sample`` have SB3's interface. Each observation, and each frame of a stack, is stored once (see
    :class:`~sb3_eqr.common.replay.frame_store.FrameStore`). Terminal observations are kept. ``n_steps``, ``gamma`` and
    ``prediction_depth`` are read at each call of ``sample``, so a schedule may change them.

    Without a rollout (M = 0), samples are identical to those of SB3's ``NStepReplayBuffer``, for the same random numbers: a
    return that would cross the write position is truncated there and bootstraps from the newest observation. With a rollout,
    starts whose window of max(n, M) transitions would cross the write position are not drawn.

    :param buffer_size: number of transitions, over all environments; per environment at least n + M + 1
    :param observation_space: any space that SB3 supports
    :param action_space: Discrete, or Box
    :param device: device of the samples
    :param n_envs: number of parallel environments
    :param optimize_memory_usage: ignored, because the memory usage is always optimised
    :param handle_timeout_termination: whether to distinguish time-outs (``TimeLimit.truncated``) from terminal states
    :param n_steps: n ≥ 1
    :param gamma: γ in [0, 1]
    :param prediction_depth: M ≥ 0
    :param frame_stack: number of frames stacked along the first axis of a channels-first image; 1: no stacking
    :raises ValueError: if an argument is out of range
    """

    timeouts: np.ndarray

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        n_steps: int = 1,
        gamma: float = 0.99,
        prediction_depth: int = 0,
        frame_stack: int = 1,
    ):
        # Not ReplayBuffer.__init__: it would allocate every observation twice, and every frame of a stack eight times.
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs=n_envs)
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination
        self.n_steps = n_steps
        self.gamma = gamma
        self.prediction_depth = prediction_depth
        self._check_arguments(frame_stack)

        is_dict = isinstance(observation_space, spaces.Dict)
        obs_spaces = observation_space.spaces if is_dict else {"": observation_space}  # type: ignore[attr-defined]
        obs_shapes = self.obs_shape if isinstance(self.obs_shape, dict) else {"": self.obs_shape}
        self._stores = {
            key: FrameStore(self.buffer_size, n_envs, obs_shapes[key], space.dtype, frame_stack, self.device)  # type: ignore[arg-type]
            for key, space in obs_spaces.items()
        }
        shape = (self.buffer_size, n_envs)
        is_discrete = isinstance(action_space, spaces.Discrete)  # an index of PyTorch must be int64
        # SB3 scales actions of a Box to [-1, 1], which integers cannot hold.
        self.actions = np.zeros((*shape, self.action_dim), dtype=np.int64 if is_discrete else np.float32)
        self.rewards = np.zeros(shape, dtype=np.float32)
        self.dones = np.zeros(shape, dtype=np.float32)
        self.timeouts = np.zeros(shape, dtype=np.float32)
        self._episode_starts = np.ones(n_envs, dtype=bool)
        available = np.inf if psutil is None else psutil.virtual_memory().available
        if (needed := SequenceReplayBuffer.nbytes.fget(self)) > available:  # type: ignore[attr-defined]
            warnings.warn(  # SB3's sentence
                "This system does not have apparently enough memory to store the complete replay buffer "
                f"{needed / 1e9:.2f}GB > {available / 1e9:.2f}GB"
            )

    def _check_arguments(self, frame_stack: int) -> None:
        check_arguments({**vars(self), "frame_stack": frame_stack}, BUFFER)
        needed = self.n_steps + self.prediction_depth + 1
        if self.buffer_size < needed:
            raise ValueError(
                f"buffer_size must be at least n_steps + prediction_depth + 1 = {needed} transitions per environment, "
                f"got {self.buffer_size} ({self.n_envs} environments). Pass buffer_size={needed * self.n_envs} or more."
            )
        channels = self.obs_shape[0] if isinstance(self.observation_space, spaces.Box) and self.obs_shape else 1
        if channels % frame_stack != 0:
            raise ValueError(
                f"frame_stack must divide the first axis of the observations (channels first), got {frame_stack} for "
                f"{self.observation_space}. Pass frame_stack=1 to store observations without splitting them into frames."
            )

    @property
    def nbytes(self) -> int:
        """Memory usage, in bytes."""
        arrays = (self.actions, self.rewards, self.dones, self.timeouts)
        return sum(store.nbytes for store in self._stores.values()) + sum(array.nbytes for array in arrays)

    @property
    def window(self) -> int:
        """Number of transitions in a window, including the one at its start."""
        return max(self.n_steps, self.prediction_depth)

    def can_sample(self) -> bool:
        """
        Whether the buffer holds enough transitions to sample.

        :raises ValueError: if the buffer is too small for the current ``n_steps`` or ``prediction_depth``
        """
        self._check_arguments(frame_stack=1)
        return self.size() >= (self.window if self.prediction_depth > 0 else 1)

    def add(  # type: ignore[override]
        self,
        obs: np.ndarray | dict[str, np.ndarray],
        next_obs: np.ndarray | dict[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Store one transition per environment; every array is (n_envs, ...).

        :param obs: s_t
        :param next_obs: s_{t+1}; at the end of an episode, the terminal observation
        :param action: a_t
        :param reward: r_{t+1}
        :param done: whether the episode ended, by a terminal state or a time-out
        :param infos: one dict per environment; ``TimeLimit.truncated`` marks a time-out
        :raises ValueError: if an action is out of range, a number is not finite or ``done`` is neither true nor false; nothing
            is stored in this case
        """
        check_transition(self.action_space, obs, next_obs, action, reward, done)
        checked = []
        for key, store in self._stores.items():
            now, then = (part[key] if isinstance(part, dict) else part for part in (obs, next_obs))
            checked.append((store, self._shaped(now, store), self._shaped(then, store)))
        follows = np.ones(self.n_envs, dtype=bool)
        for store, first, second in checked:
            follows &= store.add(self.pos, first, second, overwrite=self.full)
        # A reset in the middle of an episode (by a second call of learn) counts as a time-out.
        self.timeouts[self.pos - 1, ~follows & ~self._episode_starts] = 1.0

        self.actions[self.pos] = np.reshape(action, (self.n_envs, self.action_dim))
        self.rewards[self.pos] = reward
        self.dones[self.pos] = done
        self.timeouts[self.pos] = 0.0
        if self.handle_timeout_termination:
            self.timeouts[self.pos] = [bool(info.get("TimeLimit.truncated", False)) for info in infos]
        self._episode_starts = np.array(done, dtype=bool)
        self.pos += 1
        if self.pos == self.buffer_size:
            self.full = True
            self.pos = 0

    def reset(self) -> None:
        """Remove all transitions."""
        super().reset()
        self._stores = {key: store.emptied() for key, store in self._stores.items()}
        self._episode_starts[:] = True

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> SequenceReplayBufferSamples:  # type: ignore[override]
        """
        Sample windows uniformly.

        :param batch_size: B
        :param env: if given, normalises observations and one-step rewards
        :return: B windows, drawn with NumPy's global generator (which ``set_random_seed`` seeds)
        """
        if self.prediction_depth == 0:  # the same draws as SB3
            positions = np.random.randint(0, self.size(), size=batch_size)
        else:
            self._check_filled()
            positions = self._positions(np.random.randint(0, self.n_starts, size=batch_size))
        return self._windows(positions, np.random.randint(0, self.n_envs, size=batch_size), env)

    def _check_filled(self) -> None:
        if self.n_starts < 1:
            raise ValueError(f"The buffer must hold {self.window} steps, a whole window, got {self.size()}. Add more first.")

    def update_priorities(self, indices: np.ndarray, priorities: th.Tensor) -> None:
        """Do nothing: uniform replay has no priorities; see :class:`PrioritizedSequenceReplayBuffer`."""

    @property
    def n_starts(self) -> int:
        """Number of steps per environment at which a complete window starts."""
        return self.size() - self.window + 1

    def windows(self, starts: np.ndarray, envs: np.ndarray, env: VecNormalize | None = None) -> SequenceReplayBufferSamples:
        """
        Return the windows with the given starts.

        :param starts: steps below ``n_starts``, where 0 is the oldest stored step, (B,)
        :param envs: environments, (B,)
        :param env: as for :meth:`sample`
        :return: B windows
        """
        return self._windows(self._positions(starts), envs, env)

    def _positions(self, starts: np.ndarray) -> np.ndarray:
        return (starts + (self.pos if self.full else 0)) % self.buffer_size  # counted from the oldest step

    def _windows(self, positions: np.ndarray, envs: np.ndarray, env: VecNormalize | None) -> SequenceReplayBufferSamples:
        """The windows of environments ``envs``, (B,), that start at ``positions``, (B,)."""
        columns = envs[:, None]
        window = (positions[:, None] + np.arange(self.window)) % self.buffer_size  # (B, W)
        # The newest transition ends a window, because the oldest data follow the write position.
        is_end = (self.dones[window, columns] + self.timeouts[window, columns] > 0) | (
            window == (self.pos - 1) % self.buffer_size
        )
        is_end[:, -1] = True
        first_end = is_end.argmax(axis=1)  # (B,)
        rewards = self._normalize_reward(self.rewards[window, columns], env)  # (B, W)
        samples = self._transitions(positions, envs, first_end, rewards, env)
        if self.prediction_depth == 0:
            return samples
        return samples._replace(**self._rollouts(positions, columns, first_end, rewards, env))

    def _transitions(
        self, positions: np.ndarray, envs: np.ndarray, first_end: np.ndarray, rewards: np.ndarray, env: VecNormalize | None
    ) -> SequenceReplayBufferSamples:
        """The n-step transitions: rewards up to the end, and the next observation for bootstrapping."""
        n = self.n_steps
        last_step = np.minimum(first_end, n - 1)
        included = np.arange(n) <= last_step[:, None]  # (B, n)
        powers = self.gamma ** np.arange(n, dtype=np.float32)
        returns = (rewards[:, :n] * powers * included).sum(axis=1, keepdims=True)  # (B, 1)
        discounts = self.gamma ** (last_step[:, None] + 1).astype(np.float32)  # (B, 1)
        last = (positions + last_step) % self.buffer_size
        dones = (self.dones[last, envs] * (1 - self.timeouts[last, envs]))[:, None]  # (B, 1)
        return SequenceReplayBufferSamples(
            observations=self._observations(positions, envs, env),
            actions=self._tensor(self.actions[positions, envs]),
            next_observations=self._observations(last, envs, env, following=True),
            dones=self._tensor(dones),
            rewards=self._tensor(returns.astype(np.float32, copy=False)),
            discounts=self._tensor(discounts.astype(np.float32, copy=False)),
            indices=positions * self.n_envs + envs,
            weights=self._tensor(np.ones(len(positions), dtype=np.float32)),
        )

    def _rollouts(
        self, positions: np.ndarray, columns: np.ndarray, first_end: np.ndarray, rewards: np.ndarray, env: VecNormalize | None
    ) -> dict[str, Any]:
        """The M steps of the rollouts. Beyond the end, they repeat the last: no data of another episode, masked or not."""
        steps, depth = np.arange(self.prediction_depth), self.prediction_depth
        mask = steps <= first_end[:, None]  # (B, M)
        rollout = (positions[:, None] + np.minimum(steps, first_end[:, None])) % self.buffer_size
        actions = self.actions[rollout, columns]  # (B, M, action_dim)
        return {
            "rollout_observations": self._observations(rollout, columns, env, following=True),
            "rollout_actions": self._tensor(actions[..., 0] if isinstance(self.action_space, spaces.Discrete) else actions),
            "rollout_rewards": self._tensor((rewards[:, :depth] * mask).astype(np.float32, copy=False)),
            "mask": self._tensor(mask.astype(np.float32)),
        }

    def _observations(
        self, positions: np.ndarray, envs: np.ndarray, env: VecNormalize | None, following: bool = False
    ) -> PyTorchObs:
        """As :meth:`FrameStore.observations`, normalised and moved to the device, for each key of a dict."""
        found = {  # a copied store has its frames in the computer's memory
            key: store.observations(positions, envs, following).to(self.device) for key, store in self._stores.items()
        }
        is_dict = isinstance(self.observation_space, spaces.Dict)
        if env is None:
            return found if is_dict else found[""]
        arrays = {key: obs.numpy(force=True) for key, obs in found.items()}
        observations = self._normalize_obs(arrays if is_dict else arrays[""], env)
        if isinstance(observations, dict):
            return {key: self._tensor(obs) for key, obs in observations.items()}
        return self._tensor(observations)

    def _tensor(self, array: np.ndarray) -> th.Tensor:
        return self.to_torch(array, copy=False)  # these arrays are already copies

    def _shaped(self, obs: np.ndarray, store: FrameStore) -> np.ndarray:
        shape = (self.n_envs, *store.obs_shape)
        if obs.shape == shape[:1]:  # Discrete
            return obs.reshape(shape)
        if obs.shape != shape:
            raise ValueError(
                f"observations must have the replay buffer's shape {shape}, got {obs.shape}. "
                "Put wrappers that change the shape (VecTransposeImage, VecFrameStack) inside VecNormalize."
            )
        return obs


class PrioritizedSequenceReplayBuffer(SequenceReplayBuffer):
    """
    Proportional prioritised replay (Schaul et al. 2016, https://arxiv.org/abs/1511.05952) of the same windows:
    P(i) ∝ p_i^α over all environments, weights w_i = (N P(i))^−β divided by their maximum in the batch.

    A new transition gets the largest priority so far, as soon as its window is complete.
    See :class:`SequenceReplayBuffer` for the other parameters.

    :param alpha: α ≥ 0; 0 gives uniform replay; 0.5 in Table 5
    :param beta: β in [0, 1] at the start of training, 0.4 in Table 5; the attribute is read at each call of ``sample``
    :param final_beta: β in [0, 1] at the end of training, annealed linearly; 1 in Table 5. 0.5 with ``alpha=0.5, beta=0.5``
        gives the weights 1/√P of BBF (https://arxiv.org/abs/2305.19452)
    """

    PRIORITY_EPS = 1e-6  # so that samples with zero error can still be drawn

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        n_steps: int = 1,
        gamma: float = 0.99,
        prediction_depth: int = 0,
        frame_stack: int = 1,
        alpha: float = 0.5,
        beta: float = 0.4,
        final_beta: float = 1.0,
    ):
        super().__init__(
            buffer_size,
            observation_space,
            action_space,
            device,
            n_envs,
            optimize_memory_usage,
            handle_timeout_termination,
            n_steps,
            gamma,
            prediction_depth,
            frame_stack,
        )
        check_arguments({"alpha": alpha, "beta": beta, "final_beta": final_beta}, BUFFER)
        self.alpha = alpha
        self.beta = self.initial_beta = beta
        self.final_beta = final_beta
        self._tree = SumTree(self.buffer_size * n_envs)
        self._max_priority = 1.0  # p^α of the largest priority so far
        self._tree_window = self.window  # the window size for which incomplete starts have priority 0 in the tree

    @property
    def nbytes(self) -> int:
        """Memory usage, in bytes."""
        return super().nbytes + self._tree.nbytes

    def can_sample(self) -> bool:
        return super().can_sample() and self.size() >= self.window

    def reset(self) -> None:
        super().reset()
        self._tree = SumTree(self.buffer_size * self.n_envs)
        self._max_priority = 1.0

    def add(self, *args, **kwargs) -> None:
        self._follow_window()
        super().add(*args, **kwargs)
        self._set_ages(0, 1, 0.0)  # the overwritten start
        self._set_ages(self._tree_window - 1, self._tree_window, self._max_priority)

    def anneal_beta(self, progress_remaining: float) -> None:
        """Set β for the remaining fraction of training, which goes from 1 to 0."""
        self.beta = self.final_beta + (self.initial_beta - self.final_beta) * progress_remaining

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> SequenceReplayBufferSamples:  # type: ignore[override]
        """As :class:`SequenceReplayBuffer`, but stratified by priority; pass ``indices`` to :meth:`update_priorities`."""
        self._check_filled()
        self._follow_window()
        leaves = self._tree.sample(batch_size, np.random.random_sample(batch_size))
        priorities = self._tree.get(leaves)
        # (N P(i))^-β divided by its maximum: N and the sum of priorities cancel.
        weights = (priorities.min() / priorities) ** self.beta
        samples = self._windows(*np.divmod(leaves, self.n_envs), env)
        return samples._replace(weights=self._tensor(weights.astype(np.float32)))

    def update_priorities(self, indices: np.ndarray, priorities: th.Tensor) -> None:
        """
        Set the priorities p ≥ 0, (B,), of the samples with these ``indices``, (B,). Priorities that are not finite and
        samples that can no longer be drawn are ignored.
        """
        scaled = (priorities.numpy(force=True).astype(np.float64) + self.PRIORITY_EPS) ** self.alpha
        # The priority stays 0 for a start that was overwritten, or whose window is no longer complete.
        takes_part = np.isfinite(scaled) & (self._tree.get(indices) > 0)
        if not takes_part.all():
            indices, scaled = indices[takes_part], scaled[takes_part]
        if len(scaled) > 0:
            self._tree.set(indices, scaled)
            self._max_priority = max(self._max_priority, float(scaled.max()))

    def _follow_window(self) -> None:
        """Enable or disable the youngest starts if n or M has changed."""
        if self.window < self._tree_window:
            self._set_ages(self.window - 1, self._tree_window - 1, self._max_priority)
        elif self.window > self._tree_window:
            self._set_ages(self._tree_window - 1, self.window - 1, 0.0)
        self._tree_window = self.window

    def _set_ages(self, youngest: int, end: int, priority: float) -> None:
        """Set the priority of the transitions with ages ``youngest`` to ``end`` - 1; the newest has age 0."""
        ages = np.arange(youngest, min(end, self.size()))
        positions = (self.pos - 1 - ages) % self.buffer_size
        leaves = (positions[:, None] * self.n_envs + np.arange(self.n_envs)).ravel()
        self._tree.set(leaves, priority)
