"""What all EqR agents share: environments, replay of windows, the log, and saving."""

import copy
import inspect
import io
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Self

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, TensorDict, TrainFreq
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, unwrap_vec_normalize, unwrap_vec_wrapper
from stable_baselines3.common.vec_env.patch_gym import _patch_env

from sb3_eqr.common.checks import validation
from sb3_eqr.common.checks.arguments import ALGORITHM, Rule, check, check_arguments, nearest, number
from sb3_eqr.common.checks.finite_data import FiniteData
from sb3_eqr.common.checks.update_monitor import UpdateMonitor
from sb3_eqr.common.replay.buffers import SequenceReplayBuffer
from sb3_eqr.common.saving.callbacks import restore_progress
from sb3_eqr.common.saving.models import SafeFiles, data_of, read_model

# Arguments of the replay buffer that the algorithm sets and changes.
SET_BY_ALGORITHM = ("n_steps", "gamma", "prediction_depth", "buffer_size", "device")


class EqROffPolicy(FiniteData, SafeFiles):
    """Mixin, listed before an off-policy algorithm of SB3, for an agent with a latent model that learns from windows."""

    policy: Any
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]]
    rules: ClassVar[Mapping[str, Rule]] = ALGORITHM  # the legal values of attributes
    _check_action_space: ClassVar[Callable[..., None]]  # raises AssertionError, as SB3 does
    replay_buffer: SequenceReplayBuffer | None
    replay_buffer_class: type[SequenceReplayBuffer] | None
    prediction_depth: int
    aet_coef: float
    symmetry_coef: float
    reward_coef: float
    policy_description: dict[str, str] = {}  # saved with the model, see EqRPolicy.description
    frame_stack = 1
    reward_mean = 0.0  # which the reward network's targets are standardised by: mean and standard deviation
    reward_scale = 1.0
    _dumped_steps = -1  # num_timesteps when the log was last written
    _monitor: UpdateMonitor

    @property
    def loss_coefs(self) -> dict[str, float]:
        """The weight λ of each loss by its name."""
        return {"aet": self.aet_coef, "symmetry": self.symmetry_coef, "reward": self.reward_coef}

    @property
    def depth(self) -> int:
        """The effective M: 0 if all auxiliary losses are disabled."""
        is_used = any(coef for name, coef in self.loss_coefs.items() if name != "td")
        return self.prediction_depth if is_used else 0

    def _check_attributes(self) -> None:
        """Check attributes, which may have been changed between two calls of ``learn``."""
        check_arguments(vars(self), self.rules)
        self._convert_train_freq()

    def _convert_train_freq(self) -> None:
        given = self.train_freq
        if not isinstance(given, TrainFreq):  # SB3 accepts neither lists nor NumPy's integers
            frequency, unit = given if isinstance(given, (tuple, list)) else (given, "step")
            self.train_freq = int(frequency), unit
        super()._convert_train_freq()  # type: ignore[misc]

    def _optimizers(self) -> list[th.optim.Optimizer]:
        saved = [recursive_getattr(self, name) for name in self._get_torch_save_params()[0]]
        return [part for part in saved if isinstance(part, th.optim.Optimizer)]

    def _check_arguments(self) -> None:
        validation.check_has_env(self)
        name, chosen, given = type(self).__name__, self.replay_buffer_class, self.replay_buffer_kwargs
        validation.check_policy(name, self.policy_class, self.policy_aliases, self.observation_space)
        check_arguments(vars(self), self.rules)  # after the class, because a file may be another agent's
        validation.check_normalization(self._vec_normalize_env, self.observation_space)
        validation.check_replay(name, chosen, SequenceReplayBuffer, given, SET_BY_ALGORITHM)

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        if policy_name not in self.policy_aliases:
            aliases = list(self.policy_aliases)
            raise ValueError(f"policy must be one of {aliases}, got {policy_name!r}.{nearest(policy_name, aliases)}")
        return super()._get_policy_from_name(policy_name)  # type: ignore[misc]

    @classmethod
    def _wrap_env(cls, env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        if any(kind.__module__.split(".")[0] == "gym" for kind in type(env).__mro__):
            env = _patch_env(env)  # environments of the old gym need shimmy, as in SB3
        validation.check_env(env)
        if isinstance(found := getattr(env, "observation_space", None), spaces.Space):
            validation.check_observation_space(found)
        with validation.environment_errors(0):
            wrapped = OffPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        cls._check_action_space(wrapped.action_space)
        return wrapped

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """As SB3's ``set_env``; raises ValueError if VecNormalize cannot be used with this environment."""
        normalize = unwrap_vec_normalize(env) if isinstance(env, VecEnv) else None
        validation.check_normalization(normalize, self.observation_space)
        super().set_env(env, force_reset)

    def _new_replay_buffer(self, buffer_class: type[SequenceReplayBuffer], n_steps: int) -> SequenceReplayBuffer:
        legal = inspect.signature(buffer_class).parameters
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in legal.values()):
            validation.check_names(f"replay_buffer_kwargs: {buffer_class.__name__}", self.replay_buffer_kwargs, legal)
        kwargs: dict[str, Any] = {"n_steps": n_steps, "gamma": self.gamma, "prediction_depth": self.depth}
        kwargs |= {**self.replay_buffer_kwargs, "frame_stack": self.frame_stack, "n_envs": self.n_envs}
        return buffer_class(self.buffer_size, self.observation_space, self.action_space, self.device, **kwargs)

    def _find_frame_stack(self) -> int:
        stack: Any = unwrap_vec_wrapper(self.env, VecFrameStack)  # type: ignore[arg-type]
        found = 1
        if stack is not None and is_image_space(self.observation_space):
            # The first axis consists of frames only if VecFrameStack stacked along the channels.
            if stack.stacked_obs.channels_first == is_image_space_channels_first(stack.venv.observation_space):
                found = stack.stacked_obs.n_stack
        return self.replay_buffer_kwargs.get("frame_stack", found)

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        total_timesteps, callback = super()._setup_learn(*args, **kwargs)  # type: ignore[misc]
        if self.num_timesteps == 0:
            self._dumped_steps = -1
        else:
            restore_progress(callback, self.callback_progress)
        self.callback_progress = {}
        return total_timesteps, callback

    def _log_last_round(self, check_model: bool = False) -> None:
        """Log the metrics of the last round, which are ready by now; raise if a metric or the model is not finite."""
        for update in self._monitor.collect(self.num_timesteps):  # each, because rounds may differ in their number of updates
            for name, value in update.items():
                self.logger.record_mean(f"train/{name}", value)
        if check_model:
            self._monitor.check_model(self._n_updates, self.num_timesteps)

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """
        As SB3's ``learn``, with the same parameters; ``tb_log_name`` defaults to the name of the class. At its end, it writes
        the log once more, with the last updates, unless it did at this step or ``log_interval`` is ``None``.
        """
        check("total_timesteps", total_timesteps, number(0))
        assert self.env is not None, "You must set the environment before calling learn(): pass env to load, or call set_env."
        log_name = tb_log_name or type(self).__name__
        super().learn(total_timesteps, callback, log_interval, log_name, reset_num_timesteps, progress_bar)
        self._log_last_round(check_model=True)
        if log_interval is not None and self._dumped_steps != self.num_timesteps:  # SB3 logs only at the end of episodes
            self.dump_logs()
        return self

    def dump_logs(self) -> None:
        """Write log data; losses are means over all updates since the last call."""
        self._log_last_round()
        self._dumped_steps = self.num_timesteps
        super().dump_logs()

    def set_parameters(
        self, load_path_or_dict: str | TensorDict, exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """
        As SB3's ``set_parameters``, and from a file also the scale of the rewards that the latent model predicts. Raises
        ValueError if a file is for another group or return distribution, or if the moments of the optimiser do not fit its
        parameters. After an error, all parameters are as before.
        """
        scale: dict[str, float] = {}
        if not isinstance(load_path_or_dict, dict):
            content = read_model(load_path_or_dict)
            saved = data_of(content)
            validation.check_same_parameters(self.policy_description, saved.get("policy_description", {}))
            scale = {name: float(saved[name]) for name in ("reward_mean", "reward_scale") if name in saved}
            load_path_or_dict = io.BytesIO(content)  # type: ignore[assignment]
        self._monitor.forget()
        before: Any = copy.deepcopy(self.get_parameters())
        try:
            super().set_parameters(load_path_or_dict, exact_match, device)
            for optimizer in self._optimizers():
                validation.check_moments(optimizer)
        except Exception:
            super().set_parameters(before)  # PyTorch copies the tensors that fit before it raises
            raise
        vars(self).update(scale)
        for parameter, state in (item for optimizer in self._optimizers() for item in optimizer.state.items()):
            for name, value in state.items():
                if isinstance(value, th.Tensor) and value.shape == parameter.shape and value.stride() != parameter.stride():
                    state[name] = th.empty_like(parameter).copy_(value)  # fused kernels need the same memory layout

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        super()._update_current_progress_remaining(num_timesteps, total_timesteps)  # type: ignore[misc]
        # The last rollout may exceed the total number of steps, where a linear schedule would give a negative learning rate.
        self._current_progress_remaining = max(self._current_progress_remaining, 0.0)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_monitor", "_trained", "objective", "_dumped_steps"]

    def _before_saving(self) -> None:
        self._log_last_round(check_model=True)  # which never writes a model that is not finite


def keep_freed_memory() -> None:
    """
    Make the C library keep freed memory. On Linux, it returns large blocks to the system and requests them again page by
    page, which causes thousands of page faults per update with Atari frames. Its threshold for large blocks adapts to the
    largest block freed so far (mallopt(3), M_MMAP_THRESHOLD; blocks above 32 MiB do not count), and it then keeps up to
    twice as much. This function therefore frees one such block.
    """
    np.empty(31 << 20, dtype=np.uint8)
