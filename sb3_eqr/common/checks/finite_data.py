"""Checks data from environments and users before they are used, and stores them as the environment returned them."""

import warnings
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_eqr.common.checks.validation import environment_errors, find_infinite


class FiniteData(OffPolicyAlgorithm):
    """
    Mixin that rejects observations and rewards that are NaN or infinite, in training (the replay buffer refuses them) and in
    ``predict``. A rejected step does not change the replay buffer and the statistics of VecNormalize, and a stop of the
    training leaves out no step.
    """

    trained_normalized = False  # whether VecNormalize scaled the last environment's observations; saved with the model
    _stored_steps = 0  # num_timesteps after the last step that was stored
    _statistics: list[dict[str, Any]]  # of VecNormalize, after the last accepted step

    def _setup_learn(self, *args: Any, **kwargs: Any) -> Any:
        self._warn_without_normalization()
        with environment_errors(self.num_timesteps):
            result = super()._setup_learn(*args, **kwargs)
        self._statistics = [dict(vars(part)) for part in _running_means(self._vec_normalize_env)]
        self._stored_steps = self.num_timesteps
        return result

    def collect_rollouts(self, env: VecEnv, callback: BaseCallback, *args: Any, **kwargs: Any) -> Any:
        """
        As SB3's ``collect_rollouts``, with two differences: errors state if an environment violates gymnasium's interface, and
        the step that a callback saw when it stopped the training, by its answer or by an exception, is stored as all others.
        """
        with environment_errors(self.num_timesteps):
            try:
                result = super().collect_rollouts(env, callback, *args, **kwargs)
            except BaseException:  # Ctrl-C, too
                self._finish_step(callback)
                raise
            if not result.continue_training:
                self._finish_step(callback)
        return result

    def _finish_step(self, callback: BaseCallback) -> None:
        """Do what SB3 does after a callback has seen a step, if the training was stopped before that."""
        # The environment may have made a step that nobody has seen, so the next call of learn must reset it.
        if self._stored_steps == self.num_timesteps:
            self._last_obs = None
            return
        self._stored_steps = self.num_timesteps
        if callback.num_timesteps != self.num_timesteps:
            self._last_obs = None
            return
        seen = callback.locals
        self._update_info_buffer(seen["infos"], seen["dones"])
        step = (seen[name] for name in ("replay_buffer", "buffer_actions", "new_obs", "rewards", "dones", "infos"))
        self._store_transition(*step)
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        self._on_step()
        self._episode_num += int(seen["dones"].sum())
        if self.action_noise is not None and seen["dones"].any():
            self.action_noise.reset(**({"indices": np.flatnonzero(seen["dones"])} if self.n_envs > 1 else {}))

    def _warn_without_normalization(self) -> None:
        """Warn if an agent trained with VecNormalize would now get raw observations, with which its actions are useless."""
        if self.env is None:
            return  # SB3 raises an error
        counts = [part.count for part in _running_means(self._vec_normalize_env)[:-1]]  # without that of the returns
        is_new = bool(counts) and max(counts) < 1  # it has no statistics yet
        if self.trained_normalized and (self._vec_normalize_env is None or is_new):
            found = "this VecNormalize has no statistics yet" if is_new else "this environment is not wrapped in it"
            warnings.warn(
                f"This agent was trained with VecNormalize, but {found}, so observations are scaled differently. "
                "Pass VecNormalize.load(path, venv) as env, with the statistics that were saved with the model."
            )
        self.trained_normalized = bool(getattr(self._vec_normalize_env, "norm_obs", False))

    def _store_transition(self, *args: Any, **kwargs: Any) -> None:
        """As SB3's; the buffer refuses what is not finite, and then the statistics of VecNormalize are as before."""
        self._stored_steps = self.num_timesteps
        try:
            super()._store_transition(*args, **kwargs)
        except ValueError as error:
            self._last_obs = None  # the environment has already stepped, so the next call of learn must reset it
            for part, saved in zip(_running_means(self._vec_normalize_env), self._statistics, strict=True):
                vars(part).update(saved)
            raise ValueError(f"step {self.num_timesteps}: {error}") from error
        self._statistics = [dict(vars(part)) for part in _running_means(self._vec_normalize_env)]

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """As SB3's ``predict``, with the same parameters; raises ValueError if the observation is not finite."""
        if not isinstance(observation, tuple) and (found := find_infinite(observation)) is not None:  # SB3 explains tuples
            raise ValueError(f"observation must be finite, got {found}.")
        return super().predict(observation, state, episode_start, deterministic)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_statistics", "_stored_steps"]


def _running_means(normalize: VecNormalize | None) -> list[Any]:
    """The statistics of VecNormalize. Their attributes need not be copied: SB3 replaces arrays instead of changing them."""
    if normalize is None:
        return []
    obs_rms: Any = getattr(normalize, "obs_rms", {})  # there is none with norm_obs=False
    return [*(obs_rms.values() if isinstance(obs_rms, dict) else [obs_rms]), normalize.ret_rms]
