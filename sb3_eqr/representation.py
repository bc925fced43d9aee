"""Representation learning without reward: encoder and latent model alone, on random actions (Example 2 of the paper)."""

import warnings
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import LinearSchedule
from torch import nn

from sb3_eqr.common.groups import Group
from sb3_eqr.common.latent_model import GroupLatentModel
from sb3_eqr.common.validation import check_number
from sb3_eqr.eqr_qrdqn import EqRQRDQN
from sb3_eqr.visualize.diagnostics import diagnose
from sb3_eqr.visualize.latents import replayed

INITIAL_LEARNING_RATE = 1e-3  # to 0, linearly: what is left at the end is the noise of the last updates
N_WINDOWS = 512  # that are looked at for a collapse


class StillActions(BaseCallback):
    """
    Lets κ begin at the identity, and stay there for a while.

    :param until: so many steps of the environments
    """

    model: EqRQRDQN

    def __init__(self, until: int):
        super().__init__()
        self.until = until

    def _on_training_start(self) -> None:
        latent_model = self.model.policy.latent_model
        assert isinstance(latent_model, GroupLatentModel)
        *_, output = latent_model.transition.children()
        assert isinstance(output, nn.Linear)
        identity = latent_model.group.identity_params().repeat(latent_model.n_blocks)
        with th.no_grad():
            output.weight.zero_()
            output.bias.copy_(identity)

    def _on_rollout_start(self) -> None:
        self.model.policy.latent_model.transition.requires_grad_(self.num_timesteps >= self.until)

    def _on_training_end(self) -> None:
        self.model.policy.latent_model.transition.requires_grad_(True)

    def _on_step(self) -> bool:
        return True


def train_representation(
    env: GymEnv | str,
    group: str | Group,
    n_blocks: int | None = 1,
    total_timesteps: int = 5_500,
    policy: str = "CnnPolicy",
    learning_rate: float | Schedule | None = None,
    learning_starts: int = 3_000,
    batch_size: int = 64,
    prediction_depth: int = 5,
    aet_loss: str = "contrastive",
    symmetry_coef: float = 0.0,
    parameterization: str = "gram-schmidt",
    whiten: bool = True,
    state_dependent_actions: bool = False,
    still_timesteps: int = 500,
    policy_kwargs: dict[str, Any] | None = None,
    callback: MaybeCallback = None,
    progress_bar: bool = False,
    verbose: int = 0,
    seed: int | None = None,
    device: th.device | str = "auto",
) -> EqRQRDQN:
    """
    τ and κ by the AET loss on random actions, without Q-learning and without rewards. What comes back is an ordinary agent
    (``td_coef=0``): ``save``, ``sb3-eqr visualize`` and ``load_representation`` take it; its Q head is as it was drawn.

    The defaults are the least that found the sliding ball's circle and torus (docs/representation.md): states that are
    whitened and have no seam, actions that stay the identity at first, and the contrastive loss. The paper's example as it is
    stated, ``aet_loss="distance", parameterization="euler", whiten=False, still_timesteps=0``, collapses.

    :param env: as for :class:`~sb3_eqr.EqRQRDQN`; several environments at once see more of the world
    :param group: of the blocks, see :func:`~sb3_eqr.common.groups.make_group`
    :param n_blocks: K; ``None`` as in the policies
    :param total_timesteps: random steps, over all environments; one update per step after ``learning_starts``
    :param policy: "CnnPolicy", "MlpPolicy" or "MultiInputPolicy"
    :param learning_rate: ``None``: 10⁻³, linearly to 0
    :param learning_starts: steps before the first update: what is slow shows only where much of the world has been seen
    :param batch_size: windows per update; with the contrastive loss, one more than the negatives
    :param prediction_depth: M, how many steps ahead
    :param aet_loss: "contrastive" or "distance" (Eq. 18)
    :param symmetry_coef: weight of the GET loss; 0 as in Example 2
    :param parameterization: of rotations among the states
    :param whiten: whether states are whitened
    :param state_dependent_actions: κ(s, a); ``False``: κ(a), as in Example 2, which makes angles linear in what is moved
    :param still_timesteps: how many steps after ``learning_starts`` actions stay the identity; 0: they start as drawn. Then
        what changes slowly is learned first (slow feature analysis, Wiskott and Sejnowski 2002,
        https://doi.org/10.1162/089976602317318938): one turn of a loop and not two, one axis and not a mixture
    :param policy_kwargs: what else the policy takes
    :param callback: as for ``learn``
    :param progress_bar: as for ``learn``
    :param verbose: as for the agent
    :param seed: of everything random
    :param device: as for the agent
    :return: the agent, trained
    :raises ValueError: for an argument out of its range
    :warns UserWarning: if the representation has collapsed (:func:`~sb3_eqr.visualize.diagnostics.find_verdict`)
    """
    check_number("still_timesteps", still_timesteps, 0, whole=True)
    check_number("total_timesteps", total_timesteps, 1, whole=True)
    if total_timesteps <= learning_starts + still_timesteps:
        raise ValueError(
            f"total_timesteps: expected more than learning_starts + still_timesteps = {learning_starts + still_timesteps}, "
            f"found {total_timesteps}. Pass more steps, or lower learning_starts (random steps before the first update) and "
            "still_timesteps (steps in which actions do nothing)."
        )
    model = EqRQRDQN(
        policy,
        env,
        learning_rate=LinearSchedule(INITIAL_LEARNING_RATE, 0.0, 1.0) if learning_rate is None else learning_rate,
        buffer_size=total_timesteps,
        learning_starts=learning_starts,
        batch_size=batch_size,
        gradient_steps=-1,
        n_steps=1,
        exploration_fraction=1.0,
        exploration_final_eps=1.0,
        prediction_depth=prediction_depth,
        td_coef=0.0,
        aet_coef=float(prediction_depth),  # the sum over the steps, beside the one step of GET
        symmetry_coef=symmetry_coef,
        reward_coef=0.0,
        prioritized_replay=False,
        shift_pixels=0,  # a shift is what a world of moving things is about
        intensity_scale=0.0,
        policy_kwargs={
            "group": group,
            "n_blocks": n_blocks,
            "parameterization": parameterization,
            "whiten": whiten,
            "state_dependent_actions": state_dependent_actions,
            "aet_loss": aet_loss,
            "projection": "none",
            "layer_norm": False,  # whitening does its work
            "head_input": "state",
            "latent_tau": None,
            **({"features_extractor_class": "flatten"} if policy == "MlpPolicy" else {}),
            "noisy": False,
            "dueling": False,
            "optimizer_kwargs": {"eps": 1e-8},  # PyTorch's own: Table 5's stops small gradients
            **(policy_kwargs or {}),
        },
        verbose=verbose,
        seed=seed,
        device=device,
    )
    given = [] if callback is None else callback if isinstance(callback, list) else [callback]
    still = [StillActions(learning_starts + still_timesteps)] if still_timesteps > 0 else []
    callbacks = [*still, *(one if isinstance(one, BaseCallback) else ConvertCallback(one) for one in given)]
    model.learn(total_timesteps, callback=callbacks, progress_bar=progress_bar)
    if model.replay_buffer is not None and model.replay_buffer.n_starts > 0:  # unless a callback has stopped it at once
        _tell(model, {"whiten=True": not whiten, 'aet_loss="contrastive"': aet_loss != "contrastive", "another group": True})
    return model


def _tell(model: EqRQRDQN, remedies: dict[str, bool]) -> None:
    """
    Warn of a collapse; else say what was found, if verbose.

    :param remedies: what to pass instead -> whether it was not passed already
    """
    found = diagnose(model, replayed(model, N_WINDOWS, np.random.default_rng(0)))
    if found.verdict == "collapsed":
        open_remedies = " or ".join(remedy for remedy, is_open in remedies.items() if is_open)
        warnings.warn(f"train_representation: states and actions are nearly constant. Pass {open_remedies}.")
    elif model.verbose > 0:
        print(found.summary)
