"""What an EqR agent is made of: environment, replay buffer and policy, checked and built."""

import warnings
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, unwrap_vec_wrapper

from sb3_eqr.common.buffers import PrioritizedSequenceReplayBuffer, SequenceReplayBuffer
from sb3_eqr.common.checks import check_finite
from sb3_eqr.common.eqr_arguments import EqRArguments
from sb3_eqr.common.policies import EqRPolicy

# What of the replay buffer is set by an argument of the algorithm, which may move it later.
BUFFER_ARGUMENTS = {
    "n_steps": "n_steps",
    "gamma": "gamma",
    "prediction_depth": "prediction_depth",
    "alpha": "priority_alpha",
    "beta": "priority_beta",
}


class EqRSetup(EqRArguments):
    """
    Mixin, to stand before an SB3 Q-learning algorithm: its environment, its replay buffer and its policy.
    :class:`~sb3_eqr.common.eqr_algorithm.EqRAlgorithm` adds the training loop.
    """

    frame_stack = 1

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        wrapped = OffPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        if not isinstance(wrapped.action_space, spaces.Discrete):
            raise AssertionError(  # SB3's type for an unsupported action space
                f"The algorithm only supports {spaces.Discrete} as action space, because the Q head has one output per "
                f"action, but {wrapped.action_space} was provided. Wrap the environment with discrete actions, "
                "or use an algorithm for that space (SAC, TQC, PPO)."
            )
        if wrapped.action_space.start != 0:
            raise AssertionError(
                f"The algorithm only supports actions that count from 0, but {wrapped.action_space} was provided. "
                "Wrap the environment with gymnasium.wrappers.TransformAction."
            )
        return wrapped

    def _setup_model(self) -> None:
        self._check_policy_and_spaces()
        self._check_numbers()
        self._check_replay_arguments()
        _keep_freed_memory()
        if self.env is not None:
            self.frame_stack = self._find_frame_stack()
        buffer_class = self.replay_buffer_class or (
            PrioritizedSequenceReplayBuffer if self.prioritized_replay else SequenceReplayBuffer
        )
        if self.replay_buffer is None:
            self.replay_buffer = self._make_replay_buffer(buffer_class)
        # SB3's set-up rejects n-step Dict replay, knows no target per gradient step and no latent model:
        # it is shown values that it can take, and gets the true ones back.
        shown = {
            "n_steps": 1,
            "replay_buffer_class": buffer_class,
            "target_update_interval": self.target_update_interval or self.n_envs,
            "policy_kwargs": self._all_policy_kwargs,
        }
        true = {name: getattr(self, name) for name in shown}
        self.__dict__.update(shown)
        super()._setup_model()
        self.__dict__.update(true)

        if self.depth > 0 and self.get_coef > 0 and not self.policy.latent_model.group.has_inverse:
            raise ValueError(
                f"get_coef: the GET loss needs a group with inverses, found group={self.policy.group!r}. "
                "Pass get_coef=0 or another group."
            )
        if self._uses_aet and self.policy.projection == "head" and not self.policy.online.net_arch:
            raise ValueError(
                "net_arch: expected at least one hidden layer, because the AET loss projects with the first one; found []. "
                'Pass policy_kwargs={"net_arch": [256]} or {"projection": "own"}, or aet_coef=0.'
            )
        if self.exploration_final_eps == 0 and not self.policy.noisy and self.reset_interval is None:  # resets explore, too
            warnings.warn(
                "exploration_final_eps=0 and noisy=False: after the first steps the agent acts greedily. "
                "Pass exploration_final_eps=0.01, say, or leave the noisy layers on."
            )

    @property
    def _all_policy_kwargs(self) -> dict[str, Any]:
        return {**self.policy_kwargs, "reward_loss": self.reward_loss, "aet_loss": self.aet_loss}

    def _make_policy(self) -> EqRPolicy:
        """A policy as :meth:`_setup_model` builds it, freshly drawn."""
        policy = self.policy_class(self.observation_space, self.action_space, self.lr_schedule, **self._all_policy_kwargs)
        assert isinstance(policy, EqRPolicy)
        return policy.to(self.device)

    def _check_policy_and_spaces(self) -> None:
        base = self.policy_aliases["MlpPolicy"]
        if not (isinstance(self.policy_class, type) and issubclass(self.policy_class, base)):
            raise ValueError(
                f"{type(self).__name__}: expected a policy derived from {base.__name__}, found {self.policy_class}. "
                f"Use one of {list(self.policy_aliases)}; a file is loaded by the class that saved it."
            )
        is_dict = isinstance(self.observation_space, spaces.Dict)
        if issubclass(self.policy_class, self.policy_aliases["MultiInputPolicy"]) and not is_dict:
            raise ValueError(
                f"MultiInputPolicy: expected a Dict observation space, found {self.observation_space}. "
                "Use MlpPolicy for vectors, CnnPolicy for images."
            )
        normalize = self._vec_normalize_env
        if normalize is not None and normalize.observation_space != self.observation_space:
            raise ValueError(
                f"VecNormalize: expected it outside every wrapper that changes observations, so that it can hand out their "
                f"originals; found {normalize.observation_space} there, {self.observation_space} outside. "
                "Use VecNormalize(VecTransposeImage(env)), for images."
            )

    def _check_replay_arguments(self) -> None:
        chosen = self.replay_buffer_class
        if chosen is not None and not (isinstance(chosen, type) and issubclass(chosen, SequenceReplayBuffer)):
            raise ValueError(
                f"replay_buffer_class: expected SequenceReplayBuffer or a class derived from it, found {chosen}. "
                "Leave it out to get the one that prioritized_replay asks for."
            )
        for name, argument in BUFFER_ARGUMENTS.items():
            if name in self.replay_buffer_kwargs:
                raise ValueError(
                    f"replay_buffer_kwargs: expected arguments that {type(self).__name__} does not set itself, found "
                    f"{name!r}. Pass {argument}={self.replay_buffer_kwargs[name]!r} to {type(self).__name__}."
                )

    def _find_frame_stack(self) -> int:
        found = 1
        stack = unwrap_vec_wrapper(self.env, VecFrameStack)  # type: ignore[arg-type]
        if isinstance(stack, VecFrameStack) and is_image_space(self.observation_space):
            # Frames lie side by side along the first axis only if channels were what was stacked.
            channels_first = is_image_space_channels_first(stack.venv.observation_space)  # type: ignore[arg-type]
            if stack.stacked_obs.channels_first == channels_first:
                found = stack.stacked_obs.n_stack
        return self.replay_buffer_kwargs.get("frame_stack", found)

    def _make_replay_buffer(self, buffer_class: type[SequenceReplayBuffer]) -> SequenceReplayBuffer:
        longest = max(self.n_steps, self.initial_n_steps or 0)  # the buffer must hold it; the loop sets n before it samples
        kwargs: dict[str, Any] = {"n_steps": longest, "gamma": self.gamma, "prediction_depth": self.depth}
        if issubclass(buffer_class, PrioritizedSequenceReplayBuffer):
            kwargs.update(alpha=self.priority_alpha, beta=self.priority_beta)
        kwargs.update(self.replay_buffer_kwargs)
        kwargs["frame_stack"] = self.frame_stack
        return buffer_class(
            self.buffer_size, self.observation_space, self.action_space, self.device, n_envs=self.n_envs, **kwargs
        )

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        super()._update_current_progress_remaining(num_timesteps, total_timesteps)
        # The last round may end beyond the total. A schedule that is a line, such as RL Zoo's, would give a learning rate
        # below 0 there: gradient ascent, to the end.
        self._current_progress_remaining = max(self._current_progress_remaining, 0.0)

    def _setup_learn(self, *args: Any, **kwargs: Any) -> Any:
        result = super()._setup_learn(*args, **kwargs)
        check_finite("observation", self._last_obs, self.num_timesteps)  # before the first step
        return result

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        # What VecNormalize has clipped may hide an infinity: its originals are looked at.
        normalize, step = self._vec_normalize_env, self.num_timesteps
        try:
            check_finite("observation", new_obs if normalize is None else normalize.get_original_obs(), step)
            check_finite("reward", reward if normalize is None else normalize.get_original_reward(), step)
            for info in infos:
                check_finite("terminal observation", info.get("terminal_observation", 0), step)
            super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        except ValueError:
            self._last_obs = None  # the environment has moved on: another call of learn must reset it
            raise


def _keep_freed_memory() -> None:
    """
    The C library of Linux gives large blocks back to the system and takes them again page by page, thousands of page faults
    per update of Atari frames. It learns what is large from the largest block freed so far (mallopt(3), M_MMAP_THRESHOLD;
    blocks above 32 MiB do not count), and then keeps up to twice as much. So one such is freed.
    """
    np.empty(31 << 20, dtype=np.uint8)
