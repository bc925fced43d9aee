"""Representation learning without reward: encoder and latent model alone, on random actions (Example 2 of the paper)."""

from typing import Any

from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import LinearSchedule

from sb3_eqr.common.groups import Group
from sb3_eqr.eqr_qrdqn import EqRQRDQN


def train_representation(
    env: GymEnv | str,
    group: str | Group,
    n_blocks: int | None = 1,
    total_timesteps: int = 2_000,
    policy: str = "CnnPolicy",
    learning_rate: float | Schedule | None = None,
    learning_starts: int = 500,
    batch_size: int = 64,
    prediction_depth: int = 5,
    aet_loss: str = "contrastive",
    get_coef: float = 0.0,
    parameterization: str = "gram-schmidt",
    whiten: bool = True,
    state_dependent_actions: bool = False,
    policy_kwargs: dict[str, Any] | None = None,
    callback: MaybeCallback = None,
    progress_bar: bool = False,
    verbose: int = 0,
    seed: int | None = None,
    device: str = "auto",
) -> EqRQRDQN:
    return_value = EqRQRDQN(
        policy,
        env,
        learning_rate=learning_rate or LinearSchedule(1e-3, 0.0, 1.0),
        buffer_size=total_timesteps,
        learning_starts=learning_starts,
        batch_size=batch_size,
        gradient_steps=1,
        n_steps=1,
        exploration_fraction=1.0,
        exploration_final_eps=1.0,
        prediction_depth=prediction_depth,
        aet_loss=aet_loss,
        td_coef=0.0,
        get_coef=get_coef,
        reward_coef=0.0,
        prioritized_replay=False,
        shift_pixels=0,
        intensity_scale=0.0,
        policy_kwargs={
            "group": group,
            "n_blocks": n_blocks,
            "parameterization": parameterization,
            "whiten": whiten,
            "state_dependent_actions": state_dependent_actions,
            "projection": "none",
            "noisy": False,
            "optimizer_kwargs": {"eps": 1e-8},  # PyTorch's own: Table 5's stops small gradients
            "dueling": False,
            **(policy_kwargs or {}),
        },
        verbose=verbose,
        seed=seed,
        device=device,
    )
    return return_value.learn(total_timesteps, callback=callback, progress_bar=progress_bar)
