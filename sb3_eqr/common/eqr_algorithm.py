"""The one training loop of every EqR agent (Algorithm 1)."""

import io
import pathlib
import warnings
from abc import abstractmethod
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule, TensorDict
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, unwrap_vec_wrapper
from torch import nn

from sb3_eqr.common.augmentations import ImageAugmentation
from sb3_eqr.common.buffers import PrioritizedSequenceReplayBuffer, SequenceReplayBuffer
from sb3_eqr.common.checks import check_finite, check_number
from sb3_eqr.common.policies import EqRPolicy
from sb3_eqr.common.safe_files import SafeFiles
from sb3_eqr.common.type_aliases import LatentLosses, PyTorchObs, SequenceReplayBufferSamples
from sb3_eqr.common.update_monitor import BadUpdateError, UpdateMonitor

SelfEqRAlgorithm = TypeVar("SelfEqRAlgorithm", bound="EqRAlgorithm")


class TDLoss(NamedTuple):
    """What a Q head makes of a batch of B samples."""

    loss: th.Tensor  # (B,)
    priorities: th.Tensor  # (B,), ≥ 0, no gradient
    q_values: th.Tensor  # (B,), Q(s_t, a_t), no gradient


# What of the replay buffer is set by an argument of the algorithm, which may move it later.
BUFFER_ARGUMENTS = {
    "n_steps": "n_steps",
    "gamma": "gamma",
    "prediction_depth": "prediction_depth",
    "alpha": "priority_alpha",
    "beta": "priority_beta",
}
METRICS = ("td_loss", "aet_loss", "get_loss", "reward_loss", "loss", "grad_norm", "mean_q_value")


class EqRAlgorithm(SafeFiles):
    """
    Mixin, to stand before an SB3 Q-learning algorithm: replay of windows, the auxiliary losses beside the TD loss,
    one backward, one clip, one step, the target, the priorities. A subclass adds the Q head by :meth:`_td_loss`.

    For the parameters see :class:`~sb3_eqr.EqRQRDQN`, whose signature holds the defaults.
    """

    policy: EqRPolicy
    replay_buffer: SequenceReplayBuffer | None
    replay_buffer_class: type[SequenceReplayBuffer] | None
    target_update_interval: int | None
    max_grad_norm: float | None
    exploration_schedule: Schedule
    exploration_rate: float
    exploration_final_eps: float
    _n_calls: int

    def __init__(
        self,
        policy: str | type[EqRPolicy],
        env: GymEnv | str,
        *,
        prediction_depth: int,
        aet_coef: float,
        get_coef: float,
        reward_coef: float,
        reward_loss: str,
        double_q: bool,
        prioritized_replay: bool,
        priority_alpha: float,
        priority_beta: float,
        shift_pixels: int,
        intensity_scale: float,
        policy_kwargs: dict[str, Any] | None,
        replay_buffer_kwargs: dict[str, Any] | None,
        **base_kwargs: Any,
    ):
        # SB3 fills in the dictionaries that it is given: the caller's are left as they are.
        policy_kwargs = dict(policy_kwargs or {})
        if "optimizer_class" not in policy_kwargs:
            policy_kwargs["optimizer_class"] = th.optim.Adam
            policy_kwargs["optimizer_kwargs"] = {"eps": 1.5e-4, **(policy_kwargs.get("optimizer_kwargs") or {})}  # Table 5
        super().__init__(
            policy,
            env,
            policy_kwargs=policy_kwargs,
            replay_buffer_kwargs=dict(replay_buffer_kwargs or {}),
            _init_setup_model=False,  # type: ignore[call-arg]
            **base_kwargs,
        )
        self.prediction_depth = prediction_depth
        self.aet_coef = aet_coef
        self.get_coef = get_coef
        self.reward_coef = reward_coef
        self.reward_loss = reward_loss
        self.double_q = double_q
        self.prioritized_replay = prioritized_replay
        self.priority_alpha = priority_alpha
        self.priority_beta = priority_beta
        self.shift_pixels = shift_pixels
        self.intensity_scale = intensity_scale
        self.frame_stack = 1

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
            "policy_kwargs": {**self.policy_kwargs, "reward_loss": self.reward_loss},
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
        if self._uses_aet and self.policy.shared_projection and not self.policy.online.net_arch:
            raise ValueError(
                "net_arch: expected at least one hidden layer, because the AET loss projects with the first one; found []. "
                'Pass policy_kwargs={"net_arch": [256]} or {"shared_projection": False}, or aet_coef=0.'
            )
        if self.exploration_final_eps == 0 and not self.policy.noisy:
            warnings.warn(
                "exploration_final_eps=0 and noisy=False: after the first steps the agent acts greedily. "
                "Pass exploration_final_eps=0.01, say, or leave the noisy layers on."
            )
        self._trained = [p for group in self.policy.optimizer.param_groups for p in group["params"]]
        encoder_modules = self.policy.online.features_extractor.modules()
        depend_on_mode = (nn.modules.batchnorm._NormBase, nn.modules.dropout._DropoutNd)
        self._encoder_ignores_mode = not any(isinstance(module, depend_on_mode) for module in encoder_modules)
        self._target_is_copy = True  # it is built as one
        self._monitor = UpdateMonitor(METRICS, self.policy, self.policy.optimizer)
        obs_spaces = self.observation_space.spaces if isinstance(self.observation_space, spaces.Dict) else {}
        obs_spaces = obs_spaces or {"": self.observation_space}
        float_images = not self.policy.normalize_images
        image_keys = [k for k, space in obs_spaces.items() if is_image_space(space, normalized_image=float_images)]
        self._augment = ImageAugmentation(image_keys, self.shift_pixels, self.intensity_scale)

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

    def _check_numbers(self) -> None:
        if self.target_update_interval is not None:
            check_number("target_update_interval", self.target_update_interval, 1, whole=True)
        for name in ("prediction_depth", "shift_pixels"):
            check_number(name, getattr(self, name), 0, whole=True)
        for name in ("aet_coef", "get_coef", "reward_coef", "intensity_scale"):
            check_number(name, getattr(self, name), 0)
        check_number("tau", self.tau, 0, 1)
        check_number("batch_size", self.batch_size, 1, whole=True)
        if self.depth > 0 and self.batch_size < 2:
            raise ValueError(
                f"batch_size: the latent model's batch norm needs at least 2 samples, found {self.batch_size}. "
                "Pass a larger batch_size or prediction_depth=0."
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

    @property
    def depth(self) -> int:
        """M as it is used: 0 where no auxiliary loss is on."""
        return self.prediction_depth if self.aet_coef or self.get_coef or self.reward_coef else 0

    @property
    def _uses_aet(self) -> bool:
        return self.depth > 0 and self.aet_coef > 0

    @property
    def _target_is_online(self) -> bool:
        """Whether target features are online features, so that one pass serves for both."""
        return self._target_is_copy and self._encoder_ignores_mode

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
        kwargs: dict[str, Any] = {"n_steps": self.n_steps, "gamma": self.gamma, "prediction_depth": self.depth}
        if issubclass(buffer_class, PrioritizedSequenceReplayBuffer):
            kwargs.update(alpha=self.priority_alpha, beta=self.priority_beta)
        kwargs.update(self.replay_buffer_kwargs)
        kwargs["frame_stack"] = self.frame_stack
        return buffer_class(
            self.buffer_size, self.observation_space, self.action_space, self.device, n_envs=self.n_envs, **kwargs
        )

    def _on_step(self) -> None:
        """Called after each step of the environments: move the exploration rate, and the target if it goes by such steps."""
        self._n_calls += 1
        interval = self.target_update_interval
        if interval is not None and self._n_calls % max(interval // self.n_envs, 1) == 0:
            self.policy.update_target(self.tau)
        self.exploration_rate = self.exploration_schedule(self._current_progress_remaining)
        self.logger.record("rollout/exploration_rate", self.exploration_rate)

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """
        :param gradient_steps: number of updates
        :param batch_size: B
        """
        buffer = self.replay_buffer
        assert buffer is not None
        self._collect_metrics()
        # A schedule may have moved these since the last call.
        buffer.n_steps, buffer.gamma, buffer.prediction_depth = self.n_steps, self.gamma, self.depth
        if not buffer.can_sample():
            return  # the first window is not complete yet
        if isinstance(buffer, PrioritizedSequenceReplayBuffer):
            buffer.beta = 1.0 - (1.0 - self.priority_beta) * max(self._current_progress_remaining, 0.0)
            self.logger.record("train/beta", buffer.beta)
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        self._monitor.start_round(self._n_updates)
        for _ in range(gradient_steps):
            self._update(buffer.sample(batch_size, env=self._vec_normalize_env))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def _update(self, samples: SequenceReplayBufferSamples) -> None:
        """One gradient step, the target, the priorities."""
        td, auxiliary = self._compute_losses(samples)
        per_sample = td.loss  # (B,)
        for coef, part in zip((self.aet_coef, self.get_coef, self.reward_coef), auxiliary, strict=True):
            if part is not None and coef > 0:
                per_sample = per_sample + coef * part
        loss = (samples.weights * per_sample).mean()

        self.policy.optimizer.zero_grad()
        loss.backward()
        max_norm = float("inf") if self.max_grad_norm is None else self.max_grad_norm
        grad_norm = nn.utils.clip_grad_norm_(self._trained, max_norm)
        self.policy.optimizer.step()
        self._n_updates += 1
        self._target_is_copy = False
        if self.target_update_interval is None:
            self.policy.update_target(self.tau)
            self._target_is_copy = self.tau == 1.0
        if isinstance(self.replay_buffer, PrioritizedSequenceReplayBuffer):
            self.replay_buffer.update_priorities(samples.indices, td.priorities)
        with th.no_grad():
            losses = (td.loss, *(loss.new_zeros(1) if part is None else part for part in auxiliary))
            self._monitor.add([*(part.mean() for part in losses), loss.detach(), grad_norm, td.q_values.mean()])

    def _compute_losses(self, samples: SequenceReplayBufferSamples) -> tuple[TDLoss, LatentLosses]:
        """
        One features pass for s_t serves both; one target pass covers every other observation.

        :return: losses per sample
        """
        policy = self.policy
        batch_size = len(samples.actions)
        observations = self._augment(samples.observations)
        features = policy.online.features(observations)  # (B, D)
        with th.no_grad():
            others = [samples.next_observations]
            if samples.rollout_observations is not None and self._uses_aet:
                others.append(_map(lambda obs: obs.flatten(0, 1), samples.rollout_observations))  # (B * M, ...)
            other_observations = self._augment(_cat(others))
            other_features = policy.target.features(other_observations)  # (B + B * M, D)
            next_target = next_online = other_features[:batch_size]
            if self.double_q and not self._target_is_online:
                next_online = policy.online.features(_map(lambda obs: obs[:batch_size], other_observations))
        td = self._td_loss(samples, features, next_online, next_target)
        if samples.mask is None:
            return td, LatentLosses(None, None, None)
        with th.no_grad():
            target_states = features.detach() if self._target_is_online else policy.target.features(observations)
            target_states = target_states[:, None]
            if self._uses_aet:
                rollout = other_features[batch_size:].unflatten(0, samples.mask.shape)  # (B, M, D)
                target_states = th.cat([target_states, rollout], dim=1)  # (B, M + 1, D)
        auxiliary = policy.latent_model(
            features,
            samples.rollout_actions,
            samples.rollout_rewards if self.reward_coef > 0 else None,
            samples.mask,
            target_states,
            policy.latent_model_target if self.get_coef > 0 else None,
            policy.project if self._uses_aet else None,
            policy.target_project,
        )
        return td, auxiliary

    @abstractmethod
    def _td_loss(
        self,
        samples: SequenceReplayBufferSamples,
        features: th.Tensor,
        next_online: th.Tensor,
        next_target: th.Tensor,
    ) -> TDLoss:
        """
        The Q head's own loss.

        :param samples: the batch
        :param features: of s_t, online, (B, D)
        :param next_online: of the n-step transition's last observation, online, no gradient, (B, D): double Q chooses by it
        :param next_target: the same from the target, (B, D)
        """

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

    def learn(
        self: SelfEqRAlgorithm,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "EqR",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfEqRAlgorithm:
        """As SB3's ``learn``, with the same parameters."""
        super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        self._collect_metrics()
        return self

    def _collect_metrics(self) -> None:
        """Log the figures of the last round, which are computed by now; roll back if one is not finite."""
        try:
            for name, value in self._monitor.collect().items():
                self.logger.record_mean(f"train/{name}", value)
        except BadUpdateError as error:
            self._n_updates = error.n_updates
            self._target_is_copy = False
            raise

    def dump_logs(self) -> None:
        """Write log data; losses are means over all updates since the last time."""
        self._collect_metrics()
        super().dump_logs()

    def set_parameters(
        self, load_path_or_dict: str | TensorDict, exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """As SB3's ``set_parameters``, with the same parameters."""
        self._target_is_copy = False  # nothing is known of them
        super().set_parameters(load_path_or_dict, exact_match, device)

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        As SB3's ``save``, see :meth:`SafeFiles.save`. A model whose last update went wrong is put back and not saved.

        :param path: path to the file, or a file-like
        :param exclude: names of attributes to leave out beside the default ones
        :param include: names of attributes to save although they are left out by default
        """
        self._collect_metrics()
        super().save(path, exclude, include)

    def _excluded_save_params(self) -> list[str]:
        return [
            *super()._excluded_save_params(),
            "_monitor",
            "_trained",
            "_encoder_ignores_mode",
            "_target_is_copy",
            "_augment",
        ]


def _map(function: Callable[[th.Tensor], th.Tensor], observations: PyTorchObs) -> PyTorchObs:
    if isinstance(observations, dict):
        return {key: function(obs) for key, obs in observations.items()}
    return function(observations)


def _cat(observations: list[PyTorchObs]) -> PyTorchObs:
    if isinstance(observations[0], dict):
        return {key: th.cat([obs[key] for obs in observations]) for key in observations[0]}  # type: ignore[index, call-overload]
    return th.cat(observations)  # type: ignore[arg-type]
