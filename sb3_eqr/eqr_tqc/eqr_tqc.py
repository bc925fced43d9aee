from typing import Any

import torch as th
from sb3_contrib import TQC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_eqr.common.actor_critic import EqRActorCritic
from sb3_eqr.common.checks.validation import answers_misspelt
from sb3_eqr.common.replay.buffers import SequenceReplayBuffer
from sb3_eqr.eqr_tqc.policies import CnnPolicy, EqRTQCPolicy, MlpPolicy, MultiInputPolicy


class EqRTQC(EqRActorCritic, TQC):
    """
    Truncated quantile critics (TQC) with a latent model that predicts what actions do.
    Papers: Kuznetsov et al., https://arxiv.org/abs/2005.04269; the latent model is that of Mondal et al., EqR:
    Equivariant Representations for Data-Efficient Reinforcement Learning (ICML 2022).

    As :class:`~sb3_eqr.EqRSAC`, with TQC in place of SAC.
    """

    policy_aliases = {"MlpPolicy": MlpPolicy, "CnnPolicy": CnnPolicy, "MultiInputPolicy": MultiInputPolicy}
    policy: EqRTQCPolicy  # type: ignore[assignment]

    @answers_misspelt(policy_kwargs=EqRTQCPolicy, replay_buffer_kwargs=SequenceReplayBuffer)
    def __init__(
        self,
        policy: str | type[EqRTQCPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: str | float = "auto",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        top_quantiles_to_drop_per_net: int = 2,
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        use_sde_at_warmup: bool = False,
        prediction_depth: int = 2,
        aet_coef: float = 1.0,
        symmetry_coef: float = 0.0,
        reward_coef: float = 1.0,
        latent_batch_size: int | None = 64,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        """
        Parameters and defaults are those of SB3-Contrib's TQC, and the next five. ``policy_kwargs`` has more keys,
        ``replay_buffer_class`` must be a :class:`~sb3_eqr.SequenceReplayBuffer`, ``optimize_memory_usage`` has no effect.

        :param prediction_depth: M, number of steps that the latent model predicts; 0 disables the auxiliary losses
        :param aet_coef: weight ≥ 0 of the action-equivariant transition loss, a mean over steps; 0 disables it
        :param symmetry_coef: weight ≥ 0 of the group-equivariant transition loss; 0 disables it
        :param reward_coef: weight ≥ 0 of the loss of the standardised rewards; 0 disables it
        :param latent_batch_size: number ≥ 2 of windows in an update of the latent model; None: ``batch_size``
        :raises ValueError: if an argument is out of range
        :raises TypeError: if an argument is unknown; the message suggests the nearest name
        """
        arguments = {name: value for name, value in locals().items() if name not in ("self", "__class__")}
        super().__init__(**arguments)

    def _check_losses(self) -> None:
        super()._check_losses()
        dropped, n_quantiles = self.top_quantiles_to_drop_per_net, self.critic.n_quantiles
        if dropped >= n_quantiles:
            raise ValueError(f"top_quantiles_to_drop_per_net must be below n_quantiles={n_quantiles}, got {dropped}.")
