"""The algorithm: arguments, components and training loop of all EqR agents (Algorithm 1)."""

import io
import math
import pathlib
import warnings
from collections.abc import Callable
from typing import Any, Self

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import GymEnv, Schedule, TrainFrequencyUnit
from stable_baselines3.common.utils import LinearSchedule, get_device

from sb3_eqr.common.checks import validation
from sb3_eqr.common.checks.arguments import ALGORITHM, check_arguments, plain
from sb3_eqr.common.checks.update_monitor import UpdateMonitor
from sb3_eqr.common.cuda_graph import CapturedUpdate
from sb3_eqr.common.networks.optimizers import clip_grad_norm, set_adam_defaults
from sb3_eqr.common.objective import Objective
from sb3_eqr.common.off_policy import EqROffPolicy, keep_freed_memory
from sb3_eqr.common.policies import EqRPolicy
from sb3_eqr.common.replay.buffers import PrioritizedSequenceReplayBuffer, SequenceReplayBuffer
from sb3_eqr.common.resets import Resets, ResetSchedule
from sb3_eqr.common.saving.transfer import load_representation, representation
from sb3_eqr.common.type_aliases import SequenceReplayBufferSamples

MAX_LEARNING_STARTS = 2_000  # Table 5, of 100,000 steps


class EqRAlgorithm(EqROffPolicy):
    """
    Mixin, listed before an SB3 Q-learning algorithm. Each update samples windows, adds the auxiliary losses to the TD loss,
    makes one backward pass, clips the gradients, makes one optimiser step, and updates targets and priorities. The policy's
    networks define the Q head and its loss.
    """

    policy: EqRPolicy
    target_update_interval: int | None
    max_grad_norm: float | None
    exploration_schedule: Schedule
    exploration_rate: float
    exploration_initial_eps: float
    exploration_final_eps: float
    exploration_fraction: float
    _n_calls: int
    _create_aliases: Callable[[], None]  # from the SB3 algorithm: its own names of the networks
    _check_action_space = staticmethod(validation.check_action_space)

    @validation.answers_misspelt(policy_kwargs=EqRPolicy, replay_buffer_kwargs=PrioritizedSequenceReplayBuffer)
    def __init__(
        self,
        policy: str | type[EqRPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-4,
        buffer_size: int = 100_000,
        learning_starts: int | None = None,
        batch_size: int = 32,
        tau: float = 1.0,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 2,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 10,
        target_update_interval: int | None = None,
        exploration_fraction: float = 0.02,
        exploration_initial_eps: float = 1.0,
        exploration_final_eps: float = 0.0,
        max_grad_norm: float | None = 10.0,
        prediction_depth: int = 5,
        aet_coef: float = 1.0,
        symmetry_coef: float = 1.0,
        reward_coef: float = 5.0,
        td_coef: float = 1.0,
        aux_gradient_share: float | None = 1.0,
        double_q: bool = True,
        prioritized_replay: bool = True,
        shift_pixels: int = 4,
        intensity_scale: float = 0.05,
        resets: ResetSchedule | dict[str, Any] | None = None,
        cuda_graph: bool = False,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        """
        The defaults are the paper's hyperparameters for Atari 100K (Table 5; losses are sums over 5 steps there, means here),
        except for those of docs/differences.md.

        :param policy: The policy model to use, by its name ("MlpPolicy", "CnnPolicy", "MultiInputPolicy") or its class
        :param env: The environment to learn from (if registered in Gym, can be str); actions must be Discrete
        :param learning_rate: The learning rate, it can be a function of the current progress remaining (from 1 to 0)
        :param buffer_size: size of the replay buffer, over all environments; per environment at least n + M + 1
        :param learning_starts: how many steps of the model to collect transitions for before learning starts; ``None``: a
            tenth of the steps of the first call of ``learn``, at most the paper's 2,000 (Table 5)
        :param batch_size: Minibatch size for each gradient update
        :param tau: the update coefficient of the target networks, in [0, 1]; 1 copies the online networks
        :param gamma: the discount factor
        :param train_freq: Update the model every ``train_freq`` steps. Alternatively pass a tuple of frequency and unit
            like ``(5, "step")`` or ``(2, "episode")``.
        :param gradient_steps: How many gradient steps to do after each rollout; -1: as many as steps done in the environment
        :param replay_buffer_class: a subclass of ``SequenceReplayBuffer``; ``None``: ``prioritized_replay`` selects it
        :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation: ``alpha``, ``beta`` and
            ``final_beta`` of :class:`~sb3_eqr.common.replay.buffers.PrioritizedSequenceReplayBuffer`; ``frame_stack``, how
            many frames an image observation stacks (detected if ``VecFrameStack`` is used)
        :param optimize_memory_usage: has no effect and causes a warning: each frame is always stored only once
        :param n_steps: n of the n-step return
        :param target_update_interval: environment steps between target updates, as in QRDQN; ``None``: every gradient step
        :param exploration_fraction: fraction of training over which the exploration rate is reduced; then noisy layers explore
        :param exploration_initial_eps: initial value of random action probability; above 1: all actions are random until it
            falls below 1
        :param exploration_final_eps: final value of random action probability
        :param max_grad_norm: The maximum value for the gradient clipping (if None, no clipping), for the network with its Q
            head and for the latent model separately
        :param prediction_depth: M, number of steps that the latent model predicts; 0 disables the auxiliary losses
        :param aet_coef: λ₂ ≥ 0, weight of the action-equivariant transition loss, a mean over steps; 0 disables it
        :param symmetry_coef: λ₃ ≥ 0, weight of the group-equivariant transition loss; 0 disables it
        :param reward_coef: λ₁ ≥ 0, weight of the reward loss, a mean over steps; 0 disables it
        :param td_coef: weight of the TD loss, ≥ 0; 0: train only the representation, without Q-learning and with constant
            priorities
        :param aux_gradient_share: maximum norm of the auxiliary losses' gradient at the features, as a share of the TD
            gradient's norm, ≥ 0; a larger gradient is scaled down. ``None``: no cap. Without effect if td_coef=0, and on
            the first layer of the Q head, which the AET loss trains with projection="head"
        :param double_q: whether the online network chooses the next action (van Hasselt et al. 2016)
        :param prioritized_replay: whether to sample by priority and weight all losses (Schaul et al. 2016), or uniformly
        :param shift_pixels: random shift of images, in pixels, at most one for each 16 of the smaller side; 0 disables it.
            Neither this nor the next applies where the trunk flattens images ("mlp", "flatten")
        :param intensity_scale: random intensity of images; 0 disables it
        :param resets: periodic resets, and annealing of n and γ: a :class:`~sb3_eqr.common.resets.ResetSchedule`, or
            its fields as a dictionary; ``None``: neither
        :param cuda_graph: on a GPU, capture an update as one CUDA graph, with the same results up to rounding
            (:mod:`sb3_eqr.common.cuda_graph`, docs/gpu.md); warns if it runs eagerly instead
        :param stats_window_size: Window size for the rollout logging
        :param tensorboard_log: the log location for tensorboard (if None, no logging)
        :param policy_kwargs: additional arguments to be passed to the policy on creation, see
            :class:`~sb3_eqr.common.policies.EqRPolicy`
        :param verbose: the verbosity level: 0 no output, 1 info, 2 debug
        :param seed: Seed for the pseudo random generators
        :param device: Device (cpu, cuda, ...) on which the code should be run.
            Setting it to auto, the code will be run on the GPU if possible.
        :param _init_setup_model: Whether or not to build the network at the creation of the instance
        :raises ValueError: if an argument is out of range
        :raises TypeError: if an argument is unknown; the message suggests the nearest name
        :raises AssertionError: if the action space is not Discrete (as in SB3)
        """
        check_arguments(locals(), ALGORITHM)
        validation.check_device(device)
        validation.warn_of_memory_option(optimize_memory_usage)
        policy_kwargs = dict(policy_kwargs or {})  # a copy, because SB3 changes it
        set_adam_defaults(policy_kwargs, get_device(device))
        super().__init__(  # type: ignore[call-arg]
            policy,
            env,
            learning_rate=plain(learning_rate),
            buffer_size=buffer_size,
            learning_starts=learning_starts,  # type: ignore[arg-type]
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=dict(replay_buffer_kwargs or {}),
            n_steps=n_steps,
            target_update_interval=target_update_interval,
            exploration_fraction=exploration_fraction,
            exploration_initial_eps=exploration_initial_eps,
            exploration_final_eps=exploration_final_eps,
            max_grad_norm=max_grad_norm,
            stats_window_size=plain(stats_window_size),
            tensorboard_log=plain(tensorboard_log),
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=plain(seed),
            device=device,
            _init_setup_model=False,
        )
        self.prediction_depth = prediction_depth
        self.aet_coef = aet_coef
        self.symmetry_coef = symmetry_coef
        self.reward_coef = reward_coef
        self.td_coef = td_coef
        self.aux_gradient_share = aux_gradient_share
        self.double_q = double_q
        self.prioritized_replay = prioritized_replay
        self.shift_pixels = shift_pixels
        self.intensity_scale = intensity_scale
        self.resets = resets
        self.cuda_graph = cuda_graph
        self.representation_frozen = False  # set by load_representation; saved with the model
        self._resets = Resets(ResetSchedule.of(resets))  # saved with the model
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        """As SB3's, but supports n-step replay of dicts and a target update per gradient step."""
        self._check_arguments()
        self._resets.schedule = self.resets = ResetSchedule.of(self.resets)
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        if self.env is not None:
            self.frame_stack = self._find_frame_stack()
        if self.replay_buffer is None:
            self.replay_buffer = self._make_replay_buffer()
        self.policy = self._make_policy()
        self._check_losses()
        saved, self.policy_description = self.policy_description, self.policy.description
        validation.check_same_parameters(self.policy_description, saved)
        self._convert_train_freq()
        self._create_aliases()
        self._make_exploration_schedule()
        if self.target_update_interval and self.n_envs > self.target_update_interval:
            warnings.warn(
                f"target_update_interval={self.target_update_interval} is smaller than the number of environments, "
                f"{self.n_envs}, so the target is updated at every call of env.step. Pass at least {self.n_envs}."
            )
        if self.representation_frozen:
            self.policy.freeze(list(representation(self.policy).values()))
        self._trained = [p for group in self.policy.optimizer.param_groups for p in group["params"]]
        of_network = {*self.policy.online.parameters()}  # the others are the latent model's own
        self._clipped = [[p for p in self._trained if (p in of_network) == is_network] for is_network in (True, False)]
        self._monitor = UpdateMonitor(self.policy)
        self._set_up_objective()
        keep_freed_memory()

    def _make_exploration_schedule(self) -> None:
        ends = self.exploration_initial_eps, self.exploration_final_eps
        self.exploration_schedule = LinearSchedule(*ends, self.exploration_fraction)

    def _set_up_objective(self) -> None:
        if self.policy.bfloat16_targets:
            validation.warn_of_slow_bfloat16(self.device)
        self._objective_options = self._options_of_objective()
        self.objective = Objective(self.policy, **self._objective_options)
        graph = (self._update, self.policy.optimizer, self._settings_of_update)
        self._captured = CapturedUpdate(*graph) if self.cuda_graph else None

    def _follow_options(self) -> None:
        """Set up the objective again if its options have changed, by the user or by a callback."""
        if self._objective_options != self._options_of_objective() or self.cuda_graph != (self._captured is not None):
            self._set_up_objective()

    def _options_of_objective(self) -> dict[str, Any]:
        names = ("double_q", "shift_pixels", "intensity_scale", "aux_gradient_share")
        options = {name: getattr(self, name) for name in names}
        return {**options, "target_is_copied": self.tau == 1 and self.target_update_interval is None}

    def _check_losses(self) -> None:
        whiten, schedule = self.policy.options.whiten, self._resets.schedule
        validation.check_losses(self.td_coef, self.depth, self.batch_size, whiten, self.gamma, schedule.initial_gamma)
        explores = self.policy.noisy or schedule.interval is not None  # resets also cause exploration
        if self.exploration_final_eps == 0 and not explores:
            warnings.warn(
                "exploration_final_eps=0 and noisy=False: after the first steps, the agent acts greedily. "
                "Pass, for example, exploration_final_eps=0.01, or keep noisy=True."
            )
        self.policy.check_losses(aet=self.depth > 0 and self.aet_coef > 0, symmetry=self.depth > 0 and self.symmetry_coef > 0)
        if self.representation_frozen:
            self._check_losses_of_frozen()

    def _check_losses_of_frozen(self) -> None:
        if self.td_coef == 0 and (self.reward_coef == 0 or self.depth == 0):
            raise ValueError(
                "td_coef must be > 0 with a frozen representation and no reward loss, because nothing that uses the "
                "representation would be trained, got 0. Pass td_coef > 0, or freeze=False."
            )

    @property
    def loss_coefs(self) -> dict[str, float]:
        """The weight λ of each loss by its name."""
        return {"td": self.td_coef, **super().loss_coefs}

    def _make_policy(self) -> EqRPolicy:
        policy: Any = self.policy_class(self.observation_space, self.action_space, self.lr_schedule, **self.policy_kwargs)
        return policy.to(self.device)

    def _make_replay_buffer(self) -> SequenceReplayBuffer:
        default = PrioritizedSequenceReplayBuffer if self.prioritized_replay else SequenceReplayBuffer
        longest = max(self.n_steps, self._resets.schedule.initial_n_steps or 0)  # the buffer must be able to hold it
        return self._new_replay_buffer(self.replay_buffer_class or default, longest)

    def _setup_learn(self, *args: Any, **kwargs: Any) -> Any:
        self._check_attributes()
        is_prioritized = isinstance(self.replay_buffer, PrioritizedSequenceReplayBuffer)
        if self.replay_buffer_class is None and is_prioritized != self.prioritized_replay:
            raise ValueError(
                f"prioritized_replay must be {is_prioritized}, as when the replay buffer was made, got "
                f"{self.prioritized_replay}. Pass it to the constructor, or to load."
            )
        self._resets.schedule = self.resets = ResetSchedule.of(self.resets)
        self._check_losses()
        self._make_exploration_schedule()
        self._follow_options()
        result = super()._setup_learn(*args, **kwargs)
        if self.learning_starts is None and self._total_timesteps > 0:
            self.learning_starts = min(int(self._total_timesteps) // 10, MAX_LEARNING_STARTS)
        validation.warn_of_idle_training(self._total_timesteps, self.learning_starts, self._n_updates, self.replay_buffer)
        interval, done = self._resets.schedule.interval, self._resets.done
        if interval is not None and not done and self._updates_left() < max(interval - self._n_updates, 0) + interval:
            warnings.warn(
                f"resets: interval={interval} is too long for a reset in this call of learn, because a full interval of "
                "updates must be left after it. Pass a smaller interval, or learn all steps in one call."
            )
        return result

    def _on_step(self) -> None:
        """Called after each environment step: update the exploration rate, and the target if its interval is in such steps."""
        self._n_calls += 1
        if self.target_update_interval and self._n_calls % max(self.target_update_interval // self.n_envs, 1) == 0:
            self.policy.update_target(self.tau)
        self.exploration_rate = self.exploration_schedule(self._current_progress_remaining)
        self.logger.record("rollout/exploration_rate", self.exploration_rate)

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """
        Make a round of updates (Algorithm 1).

        :param gradient_steps: number of updates
        :param batch_size: B
        """
        self._follow_options()
        buffer, update = self.replay_buffer, self._captured or self._update
        assert buffer is not None
        self._start_round(buffer)
        for i in range(gradient_steps):
            if self._resets.is_due(self._n_updates, gradient_steps - i + self._updates_left()):
                self._reset()
            buffer.n_steps, buffer.gamma = self._resets.annealed(self._n_updates, self.n_steps, self.gamma)
            buffer.prediction_depth = self.depth
            if not buffer.can_sample():
                break  # the first window is not complete yet
            samples = buffer.sample(batch_size, env=self._vec_normalize_env)
            priorities, metrics = update(samples)
            if self.target_update_interval is not None and self._resets.updates_since(self._n_updates) == 0:
                self.policy.update_target(0.0)  # only statistics: until now zeros, or those of the features before a reset
            self._n_updates += 1
            if priorities is not None:
                buffer.update_priorities(samples.indices, priorities)
            self._monitor.add(metrics)
        self._log_counts(buffer)

    def _update(self, samples: SequenceReplayBufferSamples) -> tuple[th.Tensor | None, dict[str, th.Tensor]]:
        """
        One update of parameters and targets. It reads nothing back from the device, so that it can be captured as a graph.

        :param samples: B windows
        :return: new priorities of the samples, (B,), if the TD loss is used; metrics by name, () each
        """
        terms = self.objective(samples, self.loss_coefs)
        self.policy.optimizer.zero_grad()
        terms.loss.backward()
        grad_norm = self._clip_gradients()
        self.policy.optimizer.step()
        self.policy.after_gradient_step()
        if self.target_update_interval is None:
            self.policy.update_target(self.tau)
        return terms.priorities, {**terms.metrics(), "grad_norm": grad_norm}

    def _settings_of_update(self) -> tuple[Any, ...]:
        """All numbers that ``_update`` reads, except for the learning rate."""
        return *self.loss_coefs.values(), self.max_grad_norm, self.tau, self.target_update_interval

    def _clip_gradients(self) -> th.Tensor:
        """
        Clip the gradients of the network and those of the latent model, each to ``max_grad_norm``. That of the reward loss
        grows with the square of the rewards, that of Q-learning in proportion: one clip would leave nothing of Q-learning.

        :return: the norm of all gradients before clipping, ()
        """
        norms = [clip_grad_norm(part, self.max_grad_norm) for part in self._clipped if any(p.grad is not None for p in part)]
        return norms[0] if len(norms) == 1 else th.linalg.vector_norm(th.stack(norms))

    def _updates_left(self) -> float:
        """How many updates later rounds of this call of ``learn`` will make; expected if rounds are episodes, at first NaN."""
        frequency: Any = self.train_freq
        steps = max(self._total_timesteps - max(self.num_timesteps, self.learning_starts or 0), 0)
        if frequency.unit is TrainFrequencyUnit.STEP:
            per_round = frequency.frequency * self.n_envs  # the last round is whole, too
            return math.ceil(steps / per_round) * (per_round if self.gradient_steps < 0 else self.gradient_steps)
        if self.gradient_steps < 0:
            return steps
        if self.num_timesteps == 0:
            return np.nan  # the length of episodes is not known
        episodes = steps * self._episode_num / self.num_timesteps
        return self.gradient_steps * math.ceil(episodes / frequency.frequency)

    def _start_round(self, buffer: SequenceReplayBuffer) -> None:
        self._log_last_round()
        if isinstance(buffer, PrioritizedSequenceReplayBuffer):
            buffer.anneal_beta(self._current_progress_remaining)
            self.logger.record("train/beta", buffer.beta)
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        self._monitor.start_round(self._n_updates)

    def _reset(self) -> None:
        self.policy.reset_parameters(self._make_policy(), self._resets.schedule.shrink_factor)
        self._resets.done.append(self._n_updates)

    def _log_counts(self, buffer: SequenceReplayBuffer) -> None:
        schedule = self._resets.schedule
        if schedule.initial_n_steps is not None:
            self.logger.record("train/n_steps", buffer.n_steps)
        if schedule.initial_gamma is not None:
            self.logger.record("train/gamma", buffer.gamma)
        if schedule.interval is not None:
            self.logger.record("train/n_resets", len(self._resets.done))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def load_representation(self, path: str | pathlib.Path | io.BufferedIOBase, freeze: bool = False) -> Self:
        """
        Load encoder, κ, ρ and b of another run with the same observations and actions (paper, §4).

        :param path: file written by ``save`` of either agent
        :param freeze: whether to freeze them; ``aet_coef=0, symmetry_coef=0`` then saves computing time
        :return: the agent
        :raises ValueError: if the group, the trunk or the number of actions differs, or ``freeze`` leaves nothing to train;
            nothing is changed in this case
        """
        if freeze:
            self._check_losses_of_frozen()
        self._log_last_round()
        load_representation(self.policy, path)
        self.representation_frozen = freeze
        self.policy.freeze(list(representation(self.policy).values()) if freeze else [])
        return self

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_clipped", "_objective_options", "_captured"]
