from typing import Any

import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_eqr.common.actor_critic import EqRActorCritic
from sb3_eqr.common.checks.validation import answers_misspelt
from sb3_eqr.common.replay.buffers import SequenceReplayBuffer
from sb3_eqr.eqr_sac.policies import CnnPolicy, EqRSACPolicy, MlpPolicy, MultiInputPolicy


class EqRSAC(EqRActorCritic, SAC):
    """
    Soft actor-critic (SAC) with a latent model that predicts what actions do.
    Papers: Haarnoja et al., https://arxiv.org/abs/1801.01290; the latent model and its losses are those of Mondal et al., EqR:
    Equivariant Representations for Data-Efficient Reinforcement Learning (ICML 2022).

    Before each update of SAC, the latent model makes one of its own. Actor and critics also read the latent state, and the
    critics the predicted next one: see :class:`~sb3_eqr.common.actor_critic_policies.EqRActorCriticPolicy`.
    """

    policy_aliases = {"MlpPolicy": MlpPolicy, "CnnPolicy": CnnPolicy, "MultiInputPolicy": MultiInputPolicy}
    policy: EqRSACPolicy  # type: ignore[assignment]

    @answers_misspelt(policy_kwargs=EqRSACPolicy, replay_buffer_kwargs=SequenceReplayBuffer)
    def __init__(
        self,
        policy: str | type[EqRSACPolicy],
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
        Parameters and defaults are those of SB3's SAC, and the next five. ``policy_kwargs`` has more keys,
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
