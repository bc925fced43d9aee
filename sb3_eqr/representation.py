"""Representation learning without rewards: trains only the encoder and the latent model, on random actions (Example 2)."""

import warnings
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import LinearSchedule
from torch import nn

from sb3_eqr.common.checks.arguments import check, integer
from sb3_eqr.common.groups import Group
from sb3_eqr.common.latent.latent_model import LatentModel
from sb3_eqr.eqr_qrdqn import EqRQRDQN
from sb3_eqr.visualize.diagnostics import diagnose
from sb3_eqr.visualize.latents import replayed

N_WINDOWS = 512  # how many windows are checked for a collapse
AGENT: dict[str, Any] = {  # random actions; no loss but those of the latent model
    "gradient_steps": -1,
    "n_steps": 1,
    "exploration_fraction": 1.0,
    "exploration_final_eps": 1.0,
    "td_coef": 0.0,
    "reward_coef": 0.0,
    "prioritized_replay": False,
    "shift_pixels": 0,  # shifts would hide the motion that is to be learned
    "intensity_scale": 0.0,
}
NETWORK: dict[str, Any] = {  # unless ``policy_kwargs`` says otherwise
    "projection": "none",
    "predictor": False,
    "layer_norm": False,  # redundant with whitening
    "head_input": "state",
    "latent_tau": None,
    "noisy": False,
    "dueling": False,
    "optimizer_kwargs": {"eps": 1e-8},  # PyTorch's default: the value of Table 5 suppresses small gradients
}


class StillActions(BaseCallback):
    """
    Start κ at the identity, and keep it there for a while. Slow features are then learned first (slow feature analysis,
    Wiskott and Sejnowski 2002, https://doi.org/10.1162/089976602317318938).

    :param until: number of environment steps after which κ is trained
    """

    model: EqRQRDQN

    def __init__(self, until: int):
        super().__init__()
        self.until = until

    def _on_training_start(self) -> None:
        latent_model = self.model.policy.latent_model
        assert isinstance(latent_model, LatentModel)
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
    Train τ and κ with the AET loss on random actions, without Q-learning and without rewards. Returns an ordinary agent
    (``td_coef=0``), which works with ``save``, ``sb3-eqr visualize`` and ``load_representation``; its Q head is untrained.

    The defaults are the minimum that recovered the sliding ball's circle and torus (docs/without_reward.md): whitened latent
    states with a parameterization without discontinuities, actions fixed to the identity at first, the contrastive loss. The
    paper's example as stated (``aet_loss="distance", parameterization="euler", whiten=False, still_timesteps=0``) collapses.

    :param env: as for :class:`~sb3_eqr.EqRQRDQN`; several parallel environments cover more states
    :param group: group of the blocks, see :func:`~sb3_eqr.common.groups.make_group`
    :param n_blocks: K; ``None``: as in the policies
    :param total_timesteps: random steps, over all environments; one update per step after ``learning_starts``
    :param policy: "CnnPolicy", "MlpPolicy" or "MultiInputPolicy"
    :param learning_rate: ``None``: 10⁻³, decaying linearly to 0, so that the last updates add little noise
    :param learning_starts: steps before the first update: slow features emerge only from data that cover the environment
    :param batch_size: windows per update; with the contrastive loss, one more than the number of negatives
    :param prediction_depth: M, number of predicted steps
    :param aet_loss: "contrastive" or "distance" (Eq. 18)
    :param symmetry_coef: weight of the GET loss; 0 as in Example 2
    :param parameterization: parameterization of rotations in the latent states
    :param whiten: whether to whiten the latent states
    :param state_dependent_actions: ``True``: κ(s, a). ``False``: κ(a), as in Example 2; latent angles are then linear in
        the true positions
    :param still_timesteps: number of steps after ``learning_starts`` in which actions stay the identity, so that slow features
        are learned first (:class:`StillActions`): one turn around a loop instead of two, one axis instead of a mixture. 0: κ
        is trained from the start, near the identity
    :param policy_kwargs: additional arguments of the policy
    :param callback: as for ``learn``
    :param progress_bar: as for ``learn``
    :param verbose: as for the agent
    :param seed: seed of all random generators
    :param device: as for the agent
    :return: the trained agent
    :raises ValueError: if an argument is out of range
    :warns UserWarning: if the representation has collapsed (:func:`~sb3_eqr.visualize.diagnostics.find_verdict`)
    """
    _check_steps(total_timesteps, learning_starts, still_timesteps)
    network: dict[str, Any] = {"group": group, "n_blocks": n_blocks, "parameterization": parameterization, "whiten": whiten}
    network |= {"state_dependent_actions": state_dependent_actions, "aet_loss": aet_loss, **NETWORK}
    network |= {"features_extractor_class": "flatten"} if policy == "MlpPolicy" else {}
    model = EqRQRDQN(
        policy,
        env,
        LinearSchedule(1e-3, 0.0, 1.0) if learning_rate is None else learning_rate,
        buffer_size=total_timesteps,
        learning_starts=learning_starts,
        batch_size=batch_size,
        prediction_depth=prediction_depth,
        aet_coef=float(prediction_depth),  # makes the AET loss a sum over the steps; the GET loss has one step only
        symmetry_coef=symmetry_coef,
        policy_kwargs={**network, **(policy_kwargs or {})},
        verbose=verbose,
        seed=seed,
        device=device,
        **AGENT,
    )
    given = callback if isinstance(callback, list) else [callback]
    callbacks = [one if isinstance(one, BaseCallback) else ConvertCallback(one) for one in given if one is not None]
    if still_timesteps > 0:
        callbacks.insert(0, StillActions(learning_starts + still_timesteps))
    model.learn(total_timesteps, callback=callbacks, progress_bar=progress_bar)
    if model.replay_buffer is not None and model.replay_buffer.n_starts > 0:  # unless a callback stopped training at once
        _tell(model, {"whiten=True": not whiten, 'aet_loss="contrastive"': aet_loss != "contrastive", "another group": True})
    return model


def _check_steps(total_timesteps: int, learning_starts: int, still_timesteps: int) -> None:
    check("still_timesteps", still_timesteps, integer(0))
    check("total_timesteps", total_timesteps, integer(1))
    if total_timesteps <= learning_starts + still_timesteps:
        raise ValueError(
            f"total_timesteps must be > learning_starts + still_timesteps = {learning_starts + still_timesteps}, "
            f"got {total_timesteps}. Pass more steps, or lower learning_starts (random steps before the first update) or "
            "still_timesteps (steps in which actions stay the identity)."
        )


def _tell(model: EqRQRDQN, remedies: dict[str, bool]) -> None:
    """
    Warn about a collapse; otherwise print the summary of the diagnostics, if verbose.

    :param remedies: argument that helps -> whether the caller can still pass it
    """
    found = diagnose(model, replayed(model, N_WINDOWS, np.random.default_rng(0)))
    if found.verdict == "collapsed":
        open_remedies = " or ".join(remedy for remedy, is_open in remedies.items() if is_open)
        warnings.warn(
            "train_representation: latent states and actions are nearly constant, the representation has collapsed. "
            f"Pass {open_remedies}."
        )
    elif model.verbose > 0:
        print(found.summary)
