"""The algorithm of actor-critic agents with a latent model: before each update of SB3's, the latent model makes one."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.utils import update_learning_rate
from stable_baselines3.common.vec_env import VecNormalize

from sb3_eqr.common.actor_critic_policies import EqRActorCriticPolicy
from sb3_eqr.common.checks import validation
from sb3_eqr.common.checks.arguments import ALGORITHM, FLAG, NONE, Rule, a, check_arguments, integer, number, one_of, plain
from sb3_eqr.common.checks.update_monitor import UpdateMonitor
from sb3_eqr.common.objective import LatentObjective
from sb3_eqr.common.off_policy import EqROffPolicy, keep_freed_memory
from sb3_eqr.common.replay.buffers import PrioritizedSequenceReplayBuffer, SequenceReplayBuffer
from sb3_eqr.common.saving.random_state import preserved_rng_state
from sb3_eqr.common.type_aliases import SequenceReplayBufferSamples


def is_entropy_coefficient(value: Any) -> bool:
    """As SB3's SAC reads it: a number, also as text, or "auto", also with an initial value above 0."""
    text = str(value)
    start = text.removeprefix("auto_")
    try:
        return 0 <= float(start) < np.inf and (start == text or (float(start) > 0 and "_" not in start))
    except ValueError:
        return value == "auto"


RULES = {
    **ALGORITHM,
    "ent_coef": Rule('a number >= 0, "auto", or "auto_" with a number > 0', is_entropy_coefficient),
    "action_noise": a(ActionNoise, "an action noise of SB3") | NONE,
    "use_sde": FLAG,
    "sde_sample_freq": integer(-1),
    "use_sde_at_warmup": FLAG,
    "target_entropy": number() | one_of(["auto"]),
    "learning_starts": integer(0),
    "latent_batch_size": integer(2) | NONE,
    "target_update_interval": integer(1),
    "top_quantiles_to_drop_per_net": integer(0),  # of TQC
}
LOSSES = ("train/critic_loss", "train/actor_loss", "train/ent_coef_loss")  # of SB3, means over a round
SCALE_INTERVAL = 1_000  # updates or steps between two estimates of the rewards' spread, each of which takes all rewards
MIN_REWARDS = 100  # for an estimate
MIN_SPREAD = 1e-4  # as a share of the largest reward; below, it may be rounding
MAX_REWARD = 10.0  # spreads from the mean, as VecNormalize's clip_reward: a first rare reward is far beyond the last estimate


class EqRActorCritic(EqROffPolicy):
    """
    Mixin, listed before an actor-critic algorithm of SB3, whose ``train`` samples once before each gradient step. There, the
    latent model makes an update of its own, with windows and an optimiser of its own; then the algorithm makes its own update,
    unchanged, with networks that read the moving average of the latent model.
    """

    policy: EqRActorCriticPolicy
    _scaled_at: int | None = None  # the step of the last estimate of the rewards' spread
    rules = RULES
    _check_action_space = staticmethod(validation.check_continuous_actions)

    def __init__(
        self,
        policy: str | type[EqRActorCriticPolicy],
        env: Any,
        *,
        prediction_depth: int,
        aet_coef: float,
        symmetry_coef: float,
        reward_coef: float,
        latent_batch_size: int | None,
        policy_kwargs: dict[str, Any] | None,
        _init_setup_model: bool,
        **kwargs: Any,
    ):
        check_arguments({**kwargs, **locals()}, RULES)
        validation.check_device(kwargs["device"])
        validation.warn_of_memory_option(kwargs.pop("optimize_memory_usage"))
        policy_kwargs = dict(policy_kwargs or {})  # a copy, because SB3 changes it
        if "use_sde" in policy_kwargs:
            raise TypeError("policy_kwargs: 'use_sde' is an argument of the agent. Pass use_sde=... beside policy_kwargs.")
        kwargs = {name: plain(value) for name, value in kwargs.items()}
        super().__init__(policy, env, policy_kwargs=policy_kwargs, **kwargs, _init_setup_model=False)  # type: ignore[call-arg]
        self.prediction_depth = prediction_depth
        self.aet_coef = aet_coef
        self.symmetry_coef = symmetry_coef
        self.reward_coef = reward_coef
        self.latent_batch_size = latent_batch_size
        if _init_setup_model:
            self._setup_model()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if issubclass(self.replay_buffer_class or SequenceReplayBuffer, PrioritizedSequenceReplayBuffer):
            name = type(self).__name__
            raise ValueError(f"replay_buffer_class must sample uniformly, because {name} computes no priorities.")

    def _check_attributes(self) -> None:
        super()._check_attributes()
        with preserved_rng_state(self.action_space):
            validation.check_noise(self.action_noise, self.action_space.shape)
        agent: Any = self
        made = {"use_sde": agent.actor.use_sde, "ent_coef": agent.ent_coef_optimizer is not None}
        found = {"use_sde": agent.use_sde, "ent_coef": str(agent.ent_coef).startswith("auto")}
        for name in (name for name in made if made[name] != found[name]):
            raise ValueError(
                f"{name} must be of the same kind as when the agent was made, got {getattr(self, name)!r}. "
                "Pass it to the constructor of a new agent."
            )

    def _setup_learn(self, *args: Any, **kwargs: Any) -> Any:
        self._check_attributes()
        self._check_losses()
        result = super()._setup_learn(*args, **kwargs)
        validation.warn_of_idle_training(self._total_timesteps, self.learning_starts, self._n_updates, self.replay_buffer)
        return result

    def _check_losses(self) -> None:
        validation.check_losses(1.0, self.depth, self.latent_batch_size or self.batch_size, False, self.gamma, None)
        self.policy.check_losses(self.depth, self.symmetry_coef)

    def _setup_model(self) -> None:
        self._check_arguments()
        if self.env is not None:
            self.frame_stack = self._find_frame_stack()
        self.replay_buffer_class = self.replay_buffer_class or SequenceReplayBuffer
        if self.replay_buffer is None:
            self.replay_buffer = self._make_replay_buffer()
        n_steps, self.n_steps = self.n_steps, 1  # of SB3's own buffers
        super()._setup_model()
        self.n_steps = n_steps
        saved, self.policy_description = self.policy_description, self.policy.description
        validation.check_same_parameters(self.policy_description, saved)
        self._check_losses()
        self._monitor = UpdateMonitor(self.policy)
        if self.policy.has_latent:
            policy = self.policy
            self.objective = LatentObjective(policy, policy.encoder, policy.latent_encoder, policy.augment)
        keep_freed_memory()

    def _make_replay_buffer(self) -> SequenceReplayBuffer:
        return self._new_replay_buffer(self.replay_buffer_class or SequenceReplayBuffer, self.n_steps)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """
        Make a round of updates.

        :param gradient_steps: number of updates
        :param batch_size: B
        """
        buffer, policy = self.replay_buffer, self.policy
        assert buffer is not None
        buffer.n_steps, buffer.gamma, buffer.prediction_depth = self.n_steps, self.gamma, self.depth  # may have been changed
        if self.depth > 0:
            self._log_last_round()
            self._monitor.start_round(self._n_updates)
            if not buffer.can_sample():
                return
            self._find_reward_scale(buffer, gradient_steps)
            update_learning_rate(policy.latent_optimizer, self.lr_schedule(self._current_progress_remaining))
            self.replay_buffer = BeforeSamples(buffer, self._update_latent_model, self.latent_batch_size or batch_size)  # type: ignore[assignment]
        with policy.reader.updating() if policy.has_latent else nullcontext():
            try:
                with self._infinity_named():
                    super().train(gradient_steps, batch_size)  # type: ignore[misc]
            finally:
                self.replay_buffer = buffer
        recorded = self.logger.name_to_value
        losses = {name: recorded[name] for name in LOSSES if name in recorded}
        self._monitor.check_losses(losses, self._n_updates, self.num_timesteps)

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> Any:
        """As SB3's ``collect_rollouts``; raises FloatingPointError if an update made the networks infinite or NaN."""
        with self._infinity_named():
            return super().collect_rollouts(*args, **kwargs)

    @contextmanager
    def _infinity_named(self) -> Iterator[None]:
        """PyTorch's distributions raise ValueError if the networks are not finite: raise the error of the update instead."""
        try:
            yield
        except ValueError:
            self._log_last_round(check_model=True)
            raise

    def _update_latent_model(self, samples: SequenceReplayBufferSamples) -> None:
        """One update of encoder and latent model, and of their moving averages."""
        policy, objective = self.policy, self.objective
        if policy.options.reward_loss == "mse":  # the other loss needs their signs
            rewards: Any = samples.rollout_rewards
            scaled = ((rewards - self.reward_mean) / self.reward_scale).clamp(-MAX_REWARD, MAX_REWARD)
            samples = samples._replace(rollout_rewards=scaled)
        observations = objective.augment(samples.observations)
        features = policy.encoder(observations)
        names = [name for name, coef in self.loss_coefs.items() if coef > 0]
        losses = objective.latent_losses(names, samples, observations, features)
        means = {name: loss.mean() for name, loss in losses.items()}
        policy.latent_optimizer.zero_grad()
        sum(self.loss_coefs[name] * mean for name, mean in means.items()).backward()  # type: ignore[union-attr]
        policy.latent_optimizer.step()
        policy.target_copy.update(policy.options.latent_tau)  # type: ignore[arg-type]
        policy.reader.forget()
        self._monitor.add({f"{name}_loss": mean.detach() for name, mean in means.items()})

    def _find_reward_scale(self, buffer: SequenceReplayBuffer, gradient_steps: int) -> None:
        """Estimate mean and standard deviation of the rewards, as VecNormalize scales them, again, if it is due."""
        rewards = buffer.rewards[: buffer.size()]
        is_due = -self._n_updates % SCALE_INTERVAL < gradient_steps or rewards.size < SCALE_INTERVAL
        is_due |= self._scaled_at is None or abs(self.num_timesteps - self._scaled_at) >= SCALE_INTERVAL  # with rare updates
        if is_due and rewards.size >= MIN_REWARDS:
            self._scaled_at = self.num_timesteps
            self.reward_mean, self.reward_scale = moments(buffer._normalize_reward(rewards, self._vec_normalize_env))

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names, variables = super()._get_torch_save_params()
        return [*names, "policy.latent_optimizer"] if self.policy.has_latent else names, variables


def moments(rewards: np.ndarray) -> tuple[float, float]:
    """Mean and standard deviation of rewards; 1 in place of the latter if all are nearly equal."""
    mean, spread = (float(found(rewards, dtype=np.float64)) for found in (np.mean, np.std))
    return mean, spread if spread > MIN_SPREAD * np.abs(rewards).max() else 1.0


@dataclass(eq=False)
class BeforeSamples:
    """
    A replay buffer for one round of updates; each call of ``sample`` first passes ``n_windows`` windows of its own to a
    function, then draws transitions without rollouts.
    """

    buffer: SequenceReplayBuffer
    function: Callable[[SequenceReplayBufferSamples], None]
    n_windows: int

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> SequenceReplayBufferSamples:
        """As that of the buffer."""
        buffer = self.buffer
        self.function(buffer.sample(self.n_windows, env))
        depth, buffer.prediction_depth = buffer.prediction_depth, 0
        try:
            return buffer.sample(batch_size, env)
        finally:
            buffer.prediction_depth = depth
