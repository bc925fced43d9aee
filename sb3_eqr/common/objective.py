"""What one update minimises (Eq. 21): samples in, loss terms out. How they are applied is ``EqRAlgorithm.train``."""

from math import ceil
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, preprocess_obs

from sb3_eqr.common.augmentations import random_intensity, random_shift
from sb3_eqr.common.policies import EqRPolicy
from sb3_eqr.common.type_aliases import LatentLosses, PyTorchObs, SequenceReplayBufferSamples


class LossCoefs(NamedTuple):
    """The weights λ ≥ 0 of the loss terms; a term of weight 0 is not computed."""

    td: float
    aet: float
    symmetry: float
    reward: float


class LossTerms(NamedTuple):
    """The loss terms of an update, one number per sample, and what follows from them. ``None``: that term is off."""

    td: th.Tensor | None  # (B,)
    aet: th.Tensor | None  # (B,)
    symmetry: th.Tensor | None  # (B,)
    reward: th.Tensor | None  # (B,)
    loss: th.Tensor  # (): the mean of their sum, weighted by coefficients and replay weights (Eq. 21)
    priorities: th.Tensor | None = None  # (B,), ≥ 0, no gradient: new ones of the samples, by the TD loss
    q_values: th.Tensor | None = None  # (B,), no gradient: Q(s_t, a_t)

    def metrics(self) -> dict[str, th.Tensor]:
        """What is logged: scalars without gradient."""
        terms = zip(self._fields[:4], self[:4], strict=True)
        with th.no_grad():
            found = {f"{name}_loss": term.mean() for name, term in terms if term is not None}
            found["loss"] = self.loss.detach()
            if self.q_values is not None:
                found["mean_q_value"] = self.q_values.mean()
        return found


class Objective:
    """
    The sum of TD and auxiliary losses that an update minimises.

    :param policy: online and target network, latent model
    :param double_q: whether the online network chooses the next action (van Hasselt et al. 2016)
    :param shift_pixels: random shift of images, in pixels, ≥ 0
    :param intensity_scale: random intensity of images, ≥ 0
    """

    def __init__(self, policy: EqRPolicy, double_q: bool, shift_pixels: int, intensity_scale: float):
        self.policy = policy
        self.double_q = double_q
        self.augment = Augmentation(policy.observation_space, policy.normalize_images, shift_pixels, intensity_scale)

    def __call__(self, samples: SequenceReplayBufferSamples, coefs: LossCoefs) -> LossTerms:
        """The terms of B windows; without a rollout (M = 0) there are no auxiliary losses."""
        observations = self.augment(samples.observations)
        # x₀, (B, D): TD and auxiliary losses meet here and nowhere else, so this is where their gradients can be weighed.
        state = self.policy.online.features_extractor(observations)
        td = priorities = q_values = None
        if coefs.td > 0:
            td, priorities, q_values = self._td_terms(samples, state)
        latent = self._latent_losses(samples, state, observations, coefs)
        weighted = [coef * term for coef, term in zip(coefs, (td, *latent), strict=True) if term is not None]
        loss = (samples.weights * sum(weighted[1:], weighted[0])).mean()
        return LossTerms(td, *latent, loss, priorities, q_values)

    def _td_terms(self, samples: SequenceReplayBufferSamples, state: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Distributional Q-learning on the n-step transition: TD loss, new priorities and Q(s_t, a_t), (B,) each."""
        online, target = self.policy.online, self.policy.target
        with th.no_grad():
            next_observations = self.augment(samples.next_observations)
            next_state = chooser_state = target.features_extractor(next_observations)  # (B, D)
            if self.double_q and not self.policy.target_encodes_as_online:
                chooser_state = online.features_extractor(next_observations)
            next_outputs = target.head(next_state, noisy=True)  # (B, N, A)
            chooser = online.head(chooser_state, noisy=True) if self.double_q else next_outputs
            next_actions = online.expectation(chooser).argmax(dim=1, keepdim=True)  # (B, 1)
            following = of_actions(next_outputs, next_actions)  # (B, N)
            discounts = (1 - samples.dones) * samples.discounts  # (B, 1)
        current = of_actions(online.head(state, noisy=True), samples.actions.long())  # (B, N)
        loss, priorities = online.td_loss(current, following, samples.rewards, discounts)
        return loss, priorities, online.expectation(current.detach())

    def _latent_losses(
        self, samples: SequenceReplayBufferSamples, state: th.Tensor, observations: PyTorchObs, coefs: LossCoefs
    ) -> LatentLosses:
        """The auxiliary losses along the rollout; the target copy sees s_t in the same augmentation."""
        policy = self.policy
        if samples.mask is None:
            return LatentLosses(None, None, None)
        with th.no_grad():
            shared = policy.target_encodes_as_online
            target_states = (state.detach() if shared else policy.target.features_extractor(observations))[
                :, None
            ]  # x̄₀, (B, 1, D)
            if coefs.aet > 0:
                rollout = self._encode_rollout(samples)  # x̄₁ ... x̄_M, (B, M, D)
                target_states = th.cat([target_states, rollout], dim=1)  # (B, M + 1, D)
        return policy.latent_model(
            state,
            samples.rollout_actions,
            samples.rollout_rewards if coefs.reward > 0 else None,
            samples.mask,
            target_states,
            policy.latent_model_target if coefs.symmetry > 0 else None,
            policy.project if coefs.aet > 0 else None,
            policy.target_project,
        )

    def _encode_rollout(self, samples: SequenceReplayBufferSamples) -> th.Tensor:
        """x̄₁ ... x̄_M, (B, M, D)."""
        assert samples.mask is not None and samples.rollout_observations is not None
        observations: Any = samples.rollout_observations
        encoder = self.policy.target.features_extractor
        is_dict = isinstance(observations, dict)
        flat = {key: obs.flatten(0, 1) for key, obs in (observations if is_dict else {"": observations}).items()}
        pieces = [encoder(self.augment(piece if is_dict else piece[""])) for piece in in_pieces(flat)]
        return th.cat(pieces).unflatten(0, samples.mask.shape)


def of_actions(outputs: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """Outputs of a head, (B, N, A), for actions, (B, 1): (B, N)."""
    return outputs.gather(dim=2, index=actions[..., None].expand(-1, outputs.shape[1], 1)).squeeze(dim=2)


class Augmentation:
    """
    What the networks see in an update: images (of a dict, its images) are shifted, then their intensity is scaled, then SB3's
    ``preprocess_obs``. ``normalize_images``: whether images are bytes, which SB3 divides by 255; else they are floats already.
    """

    def __init__(self, observation_space: spaces.Space, normalize_images: bool, shift_pixels: int, intensity_scale: float):
        is_dict = isinstance(observation_space, spaces.Dict)
        self._spaces = observation_space.spaces if is_dict else {"": observation_space}  # type: ignore[attr-defined]
        self.image_keys = [k for k, s in self._spaces.items() if is_image_space(s, normalized_image=not normalize_images)]
        self._normalize_images = normalize_images
        self.shift_pixels = shift_pixels
        self.intensity_scale = intensity_scale

    def __call__(self, observations: PyTorchObs) -> PyTorchObs:
        """Observations, (B, *obs_shape) or a dict of these, to what a features extractor takes: floats."""
        if isinstance(observations, dict):
            return {key: self._part(key, obs) for key, obs in observations.items()}
        return self._part("", observations)

    def _part(self, key: str, observations: th.Tensor) -> th.Tensor:
        if key in self.image_keys:
            if self.shift_pixels > 0:
                observations = random_shift(observations, self.shift_pixels)
            if self.intensity_scale > 0:  # in one pass with the division that preprocess_obs makes: no tensor here is larger
                unit = 1 / 255 if self._normalize_images else 1.0
                return random_intensity(observations, self.intensity_scale, unit).float()
        return preprocess_obs(observations, self._spaces[key], self._normalize_images)  # type: ignore[return-value]


_PIECE = 2 << 20  # numbers in the observations of one pass on a CPU: 8 MiB as floats, 74 stacks of Atari frames


def in_pieces(observations: dict[str, th.Tensor]) -> list[dict[str, th.Tensor]]:
    """
    Observations, (N, ...) each, cut along the first axis into what a pass without gradient takes at a time: on a CPU as much
    as its caches hold, in blocks of memory that the C library keeps, whatever M; elsewhere everything.
    """
    tensors = list(observations.values())
    if tensors[0].device.type != "cpu":
        return [observations]
    n_pieces = ceil(sum(tensor.numel() for tensor in tensors) / _PIECE)
    at_a_time = ceil(len(tensors[0]) / n_pieces)
    pieces = zip(*(tensor.split(at_a_time) for tensor in tensors), strict=True)
    return [dict(zip(observations, piece, strict=True)) for piece in pieces]


def keep_freed_memory() -> None:
    """
    The C library of Linux gives large blocks back to the system and takes them again page by page, thousands of page faults
    per update of Atari frames. It learns what is large from the largest block freed so far (mallopt(3), M_MMAP_THRESHOLD;
    blocks above 32 MiB do not count), and then keeps up to twice as much. So one such block is freed.
    """
    np.empty(31 << 20, dtype=np.uint8)
