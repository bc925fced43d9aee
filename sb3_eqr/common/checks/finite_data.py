"""Checks data from environments and users before they are used, and stores them as the environment returned them."""

import warnings
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_eqr.common.checks.validation import check_finite, environment_errors, find_infinite

STATISTICS = ("obs_rms", "ret_rms")  # attributes of VecNormalize


class FiniteData(OffPolicyAlgorithm):
    """
    Mixin that rejects observations, rewards and terminal observations that are NaN or infinite, in training and in
    ``predict``. A rejected step does not change the replay buffer and the statistics of VecNormalize. Terminal observations
    are stored as the environment returned them, and a stop of the training leaves out no step.
    """

    trained_normalized = False  # whether the last environment was wrapped in VecNormalize; saved with the model
    _stored_steps = 0  # num_timesteps after the last step that was stored
    _statistics: dict[str, Any] | None = None  # VecNormalize's statistics after the last accepted step

    def _setup_learn(self, *args: Any, **kwargs: Any) -> Any:
        self._warn_without_normalization()
        with environment_errors(self.num_timesteps):
            result = super()._setup_learn(*args, **kwargs)
        check_finite("observation", self._last_obs, self.num_timesteps)
        self._statistics = statistics_of(self._vec_normalize_env)
        self._stored_steps = self.num_timesteps
        return result

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> Any:
        """
        As SB3's ``collect_rollouts``, with two differences: errors state if an environment violates gymnasium's interface, and
        the step that a callback saw when it stopped the training, by its answer or by an exception, is stored as all others.
        """
        with environment_errors(self.num_timesteps):
            try:
                result = super().collect_rollouts(*args, **kwargs)
            except BaseException:  # Ctrl-C, too
                self._finish_step(kwargs["callback"])
                raise
            if not result.continue_training:
                self._finish_step(kwargs["callback"])
        return result

    def _finish_step(self, callback: BaseCallback) -> None:
        """Do what SB3 does after a callback has seen a step, if the training was stopped before that."""
        if self._stored_steps == self.num_timesteps:
            return  # the error came before the step, or from the environment
        self._stored_steps = self.num_timesteps
        if callback.num_timesteps != self.num_timesteps:
            self._last_obs = None  # nobody has seen this step, so the next call of learn must reset the environment
            return
        seen = callback.locals
        self._update_info_buffer(seen["infos"], seen["dones"])
        step = (seen[name] for name in ("replay_buffer", "buffer_actions", "new_obs", "rewards", "dones", "infos"))
        self._store_transition(*step)
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        self._on_step()
        self._episode_num += int(seen["dones"].sum())

    def _warn_without_normalization(self) -> None:
        """Warn if an agent trained with VecNormalize would now get raw observations, with which its actions are useless."""
        if self.env is None:
            return  # SB3 raises an error
        counts = (
            [part.count for part in _parts(self._vec_normalize_env, "obs_rms").values()] if self._vec_normalize_env else []
        )
        is_new = bool(counts) and max(counts) < 1  # it has no statistics yet
        if self.trained_normalized and (self._vec_normalize_env is None or is_new):
            found = "this VecNormalize has no statistics yet" if is_new else "this environment is not wrapped in it"
            warnings.warn(
                f"This agent was trained with VecNormalize, but {found}, so observations are scaled differently. "
                "Pass VecNormalize.load(path, venv) as env, with the statistics that were saved with the model."
            )
        self.trained_normalized = self._vec_normalize_env is not None

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        self._stored_steps = self.num_timesteps
        # Check the original values, because VecNormalize's clipping may hide an infinity.
        normalize, step = self._vec_normalize_env, self.num_timesteps
        try:
            check_finite("observation", new_obs if normalize is None else normalize.get_original_obs(), step)
            check_finite("reward", reward if normalize is None else normalize.get_original_reward(), step)
            for info in [*infos, *original_infos(normalize)]:
                check_finite("terminal observation", info.get("terminal_observation", 0), step)
            if normalize is None:
                super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
            else:
                self._store_original(normalize, replay_buffer, buffer_action, new_obs, dones, infos)
        except ValueError:
            self._last_obs = None  # the environment has already stepped, so the next call of learn must reset it
            restore_statistics(normalize, self._statistics)
            raise
        self._statistics = statistics_of(normalize)

    def _store_original(
        self,
        normalize: VecNormalize,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        As SB3's ``_store_transition`` behind VecNormalize, which casts normalised terminal observations to integers, where
        observations are integers, and stores the clipped ones.
        """
        original = normalize.get_original_obs()
        next_obs: Any = normalize.get_original_obs()  # another copy
        for i, done in enumerate(dones):
            if done and infos[i].get("terminal_observation") is not None:
                found: Any = terminal_observation(normalize, infos, i)
                for key in next_obs if isinstance(next_obs, dict) else [...]:
                    into, value = (next_obs, np.asarray(found)) if key is ... else (next_obs[key], np.asarray(found[key]))
                    into[i] = value if value.dtype == into.dtype else rounded(value, into.dtype)
        replay_buffer.add(
            self._last_original_obs,  # type: ignore[arg-type]
            next_obs,
            buffer_action,
            normalize.get_original_reward(),
            dones,
            infos,
        )
        self._last_obs, self._last_original_obs = new_obs, original  # type: ignore[assignment]

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """As SB3's ``predict``, with the same parameters; raises ValueError if the observation is not finite."""
        found = find_infinite(observation) if isinstance(observation, (np.ndarray, dict)) else None
        if found is not None:
            raise ValueError(f"observation must be finite, got {found}.")
        return super().predict(observation, state, episode_start, deterministic)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_statistics", "_stored_steps"]


def original_infos(normalize: VecNormalize | None) -> list[dict[str, Any]]:
    """
    The infos of the environments before VecNormalize clipped their terminal observations in place. Only SB3's DummyVecEnv
    keeps them, because it returns copies; with other VecEnvs they are lost, and the clipped values are finite.
    """
    innermost = None if normalize is None else normalize.unwrapped
    return innermost.buf_infos if isinstance(innermost, DummyVecEnv) else []


def terminal_observation(normalize: VecNormalize, infos: list[dict[str, Any]], i: int) -> Any:
    """
    The last observation of the episode that environment ``i`` has ended: as the environment returned it where it is kept,
    else computed from the normalised and clipped one.
    """
    if normalize.venv is normalize.unwrapped and isinstance(normalize.venv, DummyVecEnv):
        return normalize.venv.buf_infos[i]["terminal_observation"]
    return normalize.unnormalize_obs(infos[i]["terminal_observation"])


def rounded(values: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Round to the nearest value of an integer ``dtype``; others are cast."""
    if not np.issubdtype(dtype, np.integer):
        return values.astype(dtype)
    limits = np.iinfo(dtype)
    return np.rint(values).clip(limits.min, limits.max).astype(dtype)


def statistics_of(normalize: VecNormalize | None) -> dict[str, Any] | None:
    """The current running means. They need not be copied, because SB3 replaces their arrays instead of changing them."""
    if normalize is None:
        return None
    return {name: {key: dict(vars(part)) for key, part in _parts(normalize, name).items()} for name in STATISTICS}


def restore_statistics(normalize: VecNormalize | None, statistics: dict[str, Any] | None) -> None:
    """Undo the changes of a rejected step to the running means."""
    if normalize is None or statistics is None:
        return
    for name, saved in statistics.items():
        for key, part in _parts(normalize, name).items():
            vars(part).update(saved[key])


def _parts(normalize: VecNormalize, name: str) -> dict[str, Any]:
    found = getattr(normalize, name, None)
    return found if isinstance(found, dict) else {} if found is None else {"": found}
