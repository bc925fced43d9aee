"""The one training loop of every EqR agent (Algorithm 1)."""

import io
import pathlib
from abc import abstractmethod
from collections.abc import Callable
from math import ceil
from typing import NamedTuple, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import MaybeCallback, TensorDict
from torch import nn

from sb3_eqr.common.buffers import PrioritizedSequenceReplayBuffer, SequenceReplayBuffer
from sb3_eqr.common.features_extractor import GroupFeaturesExtractor
from sb3_eqr.common.layers import Whitening
from sb3_eqr.common.networks import EqRNetwork
from sb3_eqr.common.preprocessing import ImageAugmentation
from sb3_eqr.common.schedules import anneal_gamma, anneal_n_steps
from sb3_eqr.common.transfer import load_representation, representation
from sb3_eqr.common.type_aliases import LatentLosses, PyTorchObs, SequenceReplayBufferSamples
from sb3_eqr.common.update_monitor import BadUpdateError, UpdateMonitor
from sb3_eqr.common.update_rounds import UpdateRounds

SelfEqRAlgorithm = TypeVar("SelfEqRAlgorithm", bound="EqRAlgorithm")


_PIECE = 2 << 20  # numbers in the observations of one pass on a CPU: 8 MiB as floats, 74 stacks of Atari frames


class TDLoss(NamedTuple):
    """What a Q head makes of a batch of B samples."""

    loss: th.Tensor  # (B,)
    priorities: th.Tensor  # (B,), ≥ 0, no gradient
    q_values: th.Tensor  # (B,), Q(s_t, a_t), no gradient


class EqRAlgorithm(UpdateRounds):
    """
    Mixin, to stand before an SB3 Q-learning algorithm: replay of windows, the auxiliary losses beside the TD loss,
    one backward, one clip, one step, the target, the priorities. A subclass adds the Q head by :meth:`_td_loss`.
    """

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.representation_frozen:
            self.policy.freeze(list(representation(self.policy).values()))
        self._trained = [p for group in self.policy.optimizer.param_groups for p in group["params"]]
        encoder_modules = self.policy.online.features_extractor.modules()
        depend_on_mode = (nn.modules.batchnorm._NormBase, nn.modules.dropout._DropoutNd, Whitening)
        self._encoder_ignores_mode = not any(isinstance(module, depend_on_mode) for module in encoder_modules)
        self._target_is_copy = True  # it is built as one
        self._monitor = UpdateMonitor(self.policy, self.policy.optimizer)
        self._augment = ImageAugmentation(
            self.observation_space, self.policy.normalize_images, self.shift_pixels, self.intensity_scale
        )

    @property
    def _target_is_online(self) -> bool:
        """Whether target features are online features, so that one pass serves for both."""
        return self._target_is_copy and self._encoder_ignores_mode

    def _on_step(self) -> None:
        """Called after each step of the environments: move the exploration rate, and the target if it goes by such steps."""
        self._n_calls += 1
        interval = self.target_update_interval
        if interval is not None and self._n_calls % max(interval // self.n_envs, 1) == 0:
            self.policy.update_target(self.tau)
        self.exploration_rate = self.exploration_schedule(self._current_progress_remaining)
        self.logger.record("rollout/exploration_rate", self.exploration_rate)

    def _train(self, gradient_steps: int, batch_size: int) -> None:
        buffer = self.replay_buffer
        assert buffer is not None
        captures = self._captures()
        self._late.write_back()
        self._collect_metrics()
        remaining = self._current_progress_remaining
        if isinstance(buffer, PrioritizedSequenceReplayBuffer):
            buffer.beta = self.priority_final_beta + (self.priority_beta - self.priority_final_beta) * remaining
            self.logger.record("train/beta", buffer.beta)
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        self._monitor.start_round(self._n_updates)
        for _ in range(gradient_steps):
            if self._reset_is_due():
                self._reset()
            self._set_window(buffer)
            if not buffer.can_sample():
                break  # the first window is not complete yet
            self._late.write_back(but=1)
            if captures:
                self._run_captured(buffer.draw(batch_size))
            else:
                self._update(buffer.sample(batch_size, env=self._vec_normalize_env))
        if self.reset_interval is not None:
            self.logger.record("train/n_resets", len(self._resets))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def _set_window(self, buffer: SequenceReplayBuffer) -> None:
        """n, γ and M as they are now: a schedule or a callback may have moved them."""
        progress = min(self._updates_since_reset / self.annealing_steps, 1.0)
        buffer.n_steps = anneal_n_steps(self.initial_n_steps, self.n_steps, progress)
        buffer.gamma = anneal_gamma(self.initial_gamma, self.gamma, progress)
        buffer.prediction_depth = self.depth
        for name in ("n_steps", "gamma"):
            if getattr(self, f"initial_{name}") is not None:
                self.logger.record(f"train/{name}", getattr(buffer, name))

    @property
    def _updates_since_reset(self) -> int:
        return self._n_updates - (self._resets[-1] if self._resets else 0)

    def _reset_is_due(self) -> bool:
        over = 1.0 - self._current_progress_remaining >= self.reset_fraction
        return self.reset_interval is not None and self._updates_since_reset >= self.reset_interval and not over

    def _reset(self) -> None:
        self._captured.forget()
        self.policy.reset_parameters(self._make_policy(), self.reset_shrink_factor)
        self._target_is_copy = True
        self._resets.append(self._n_updates)

    def _update(self, samples: SequenceReplayBufferSamples) -> None:
        """One gradient step, the target, the priorities."""
        self._record(samples.indices, self._update_networks(samples))

    def _update_networks(self, samples: SequenceReplayBufferSamples) -> dict[str, th.Tensor]:
        """
        All of an update that the device does.

        :return: what the monitor shows, scalars by name, and new "priorities", (B,), where there is a TD loss
        """
        td, auxiliary = self._compute_losses(samples)
        parts = {"td": None if td is None else td.loss, **auxiliary._asdict()}
        weighted = [getattr(self, f"{name}_coef") * part for name, part in parts.items() if part is not None]
        loss = (samples.weights * sum(weighted[1:], weighted[0])).mean()

        self.policy.optimizer.zero_grad()
        loss.backward()
        max_norm = float("inf") if self.max_grad_norm is None else self.max_grad_norm
        grad_norm = nn.utils.clip_grad_norm_(self._trained, max_norm)
        self.policy.optimizer.step()
        if self.target_update_interval is None:
            self.policy.update_target(self.tau)
        with th.no_grad():
            figures = {f"{name}_loss": part.mean() for name, part in parts.items() if part is not None}
            figures.update(loss=loss.detach(), grad_norm=grad_norm)
            if td is not None:
                figures["mean_q_value"] = td.q_values.mean()
        return figures if td is None else {**figures, "priorities": td.priorities}

    def _record(self, indices: np.ndarray, outputs: dict[str, th.Tensor]) -> None:
        """
        All of an update that the host does.

        :param indices: of the samples in the replay buffer, (B,)
        :param outputs: of :meth:`_update_networks`
        """
        self._n_updates += 1
        self._target_is_copy = self.target_update_interval is None and self.tau == 1.0
        self._monitor.add({name: figure for name, figure in outputs.items() if name != "priorities"})
        if "priorities" in outputs and isinstance(self.replay_buffer, PrioritizedSequenceReplayBuffer):
            self._late.add(self.replay_buffer, indices, outputs["priorities"])
            if self.fast != "overlap":
                self._late.write_back()

    def _compute_losses(self, samples: SequenceReplayBufferSamples) -> tuple[TDLoss | None, LatentLosses]:
        """
        One features pass for s_t serves both.

        :return: losses per sample; no TD loss where it is off
        """
        policy = self.policy
        observations = self._augment(samples.observations)
        features = self._encode(policy.online, observations)  # (B, D)
        td = self._q_learning(samples, features) if self.td_coef > 0 else None
        if samples.mask is None:
            return td, LatentLosses(None, None, None)
        with th.no_grad():
            target_states = features.detach() if self._target_is_online else self._encode(policy.target, observations)
            target_states = target_states[:, None]
            if samples.rollout_observations is not None and self._uses_aet:
                flat = _map(lambda obs: obs.flatten(0, 1), samples.rollout_observations)  # (B * M, ...)
                pieces = [self._encode(policy.target, self._augment(piece)) for piece in self._pieces(flat)]
                rollout = th.cat(pieces).unflatten(0, samples.mask.shape)  # (B, M, D)
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

    def _encode(self, network: EqRNetwork, observations: PyTorchObs) -> th.Tensor:
        if not self.bf16:
            return network.encode(observations)
        encoder = network.features_extractor
        trunk = encoder.trunk if isinstance(encoder, GroupFeaturesExtractor) else encoder
        with th.autocast(self.device.type, th.bfloat16, cache_enabled=False):
            features = trunk(observations).float()
        # Angles and their products need all their digits.
        return encoder.elements(features) if isinstance(encoder, GroupFeaturesExtractor) else features

    def _pieces(self, observations: PyTorchObs) -> list[PyTorchObs]:
        """
        What a pass without gradient takes at a time: on a CPU so much as its caches hold, in blocks of memory that the C
        library keeps, whatever M; elsewhere everything.

        :param observations: (N, ...)
        """
        if self.device.type != "cpu":
            return [observations]
        tensors = list(observations.values()) if isinstance(observations, dict) else [observations]
        n_pieces = ceil(sum(tensor.numel() for tensor in tensors) / _PIECE)
        at_a_time = ceil(len(tensors[0]) / n_pieces)
        if isinstance(observations, dict):
            pieces = zip(*(tensor.split(at_a_time) for tensor in tensors), strict=True)
            return [dict(zip(observations, piece, strict=True)) for piece in pieces]
        return list(observations.split(at_a_time))

    def _q_learning(self, samples: SequenceReplayBufferSamples, features: th.Tensor) -> TDLoss:
        """
        :param samples: the batch
        :param features: of s_t, online, (B, D)
        """
        online, target = self.policy.online, self.policy.target
        with th.no_grad():
            next_observations = self._augment(samples.next_observations)
            next_target = next_online = self._encode(target, next_observations)  # (B, D)
            if self.double_q and not self._target_is_online:
                next_online = self._encode(online, next_observations)
            next_outputs = target.head(next_target, noisy=True)  # (B, N, A)
            chooser = online.head(next_online, noisy=True) if self.double_q else next_outputs
            next_actions = online.expectation(chooser).argmax(dim=1, keepdim=True)  # (B, 1)
            following = _of_actions(next_outputs, next_actions)  # (B, N)
            discounts = (1 - samples.dones) * samples.discounts  # (B, 1)
        current = _of_actions(online.head(features, noisy=True), samples.actions.long())  # (B, N)
        loss, priorities = self._td_loss(current, following, samples.rewards, discounts)
        return TDLoss(loss, priorities, online.expectation(current.detach()))

    @abstractmethod
    def _td_loss(
        self, current: th.Tensor, following: th.Tensor, rewards: th.Tensor, discounts: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        The Q head's own loss.

        :param current: outputs of the online head for (s_t, a_t), (B, N)
        :param following: those of the target head after the n-step transition, for the best action, no gradient, (B, N)
        :param rewards: the n-step return, (B, 1)
        :param discounts: 0 where the transition ended in a terminal state, γ to its length elsewhere, (B, 1)
        :return: loss, (B,), and priorities ≥ 0 without gradient, (B,)
        """

    def learn(
        self: SelfEqRAlgorithm,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfEqRAlgorithm:
        """As SB3's ``learn``, with the same parameters; ``tb_log_name`` is the name of the class where not given."""
        tb_log_name = tb_log_name or type(self).__name__
        with self._rounds_may_wait():
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
            self._resets = [reset for reset in self._resets if reset < error.n_updates]  # later ones were put back, too
            self._target_is_copy = False
            self._captured.forget()
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
        self._captured.forget()
        self._monitor.forget()
        super().set_parameters(load_path_or_dict, exact_match, device)
        for parameter, state in self.policy.optimizer.state.items():
            for name, value in state.items():
                if isinstance(value, th.Tensor) and value.shape == parameter.shape and value.stride() != parameter.stride():
                    state[name] = th.empty_like(parameter).copy_(value)  # fused kernels read both in one order

    def load_representation(
        self: SelfEqRAlgorithm, path: str | pathlib.Path | io.BufferedIOBase, freeze: bool = False
    ) -> SelfEqRAlgorithm:
        """
        Start from the representation of another run: encoder, κ, ρ and b are taken from its file, the Q head and the reward
        predictor stay this agent's own. The tasks must have the same observations and actions (paper, §4).

        :param path: what ``save`` of either agent wrote, or of :func:`~sb3_eqr.representation.train_representation`
        :param freeze: whether they stay as they are from now on; ``aet_coef=0, get_coef=0`` then saves their time
        :return: this agent
        :raises ValueError: if it does not fit: another group, trunk or number of actions; nothing is changed then
        """
        if freeze and self.td_coef == 0 and (self.reward_coef == 0 or self.depth == 0):
            raise ValueError(
                "freeze: expected a loss that trains something else, found td_coef=0 and no reward loss. Pass freeze=False."
            )
        self._collect_metrics()
        self._captured.forget()
        load_representation(self.policy, path)
        self.representation_frozen = freeze
        self.policy.freeze(list(representation(self.policy).values()) if freeze else [])
        self._monitor = UpdateMonitor(self.policy, self.policy.optimizer)  # no way back to before
        return self

    def _before_saving(self) -> None:
        self._late.write_back()
        self._collect_metrics()  # a model whose last update went wrong is put back and not saved

    def _excluded_save_params(self) -> list[str]:
        return [
            *super()._excluded_save_params(),
            "_monitor",
            "_trained",
            "_encoder_ignores_mode",
            "_target_is_copy",
            "_augment",
        ]


def _of_actions(outputs: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """
    :param outputs: of a head, (B, N, A)
    :param actions: (B, 1), int64
    :return: (B, N)
    """
    return outputs.gather(dim=2, index=actions[..., None].expand(-1, outputs.shape[1], 1)).squeeze(dim=2)


def _map(function: Callable[[th.Tensor], th.Tensor], observations: PyTorchObs) -> PyTorchObs:
    if isinstance(observations, dict):
        return {key: function(obs) for key, obs in observations.items()}
    return function(observations)
