"""The objective of one update (Eq. 21): computes loss terms from samples. ``EqRAlgorithm.train`` applies them."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from math import ceil, inf
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, preprocess_obs
from torch import nn

from sb3_eqr.common.augmentations import random_intensity, random_shift
from sb3_eqr.common.latent.gradients import branch
from sb3_eqr.common.policies import EqRPolicy
from sb3_eqr.common.type_aliases import LatentLosses, PyTorchObs, SequenceReplayBufferSamples


class LossCoefs(NamedTuple):
    """The weights λ ≥ 0 of the loss terms; a term with weight 0 is not computed."""

    td: float
    aet: float
    symmetry: float
    reward: float


class LossTerms(NamedTuple):
    """The loss terms of an update, one number per sample, and derived quantities. ``None``: the term is disabled."""

    td: th.Tensor | None  # (B,)
    aet: th.Tensor | None  # (B,)
    symmetry: th.Tensor | None  # (B,)
    reward: th.Tensor | None  # (B,)
    loss: th.Tensor  # (): the mean of their sum, weighted by coefficients and replay weights (Eq. 21)
    priorities: th.Tensor | None = None  # (B,), ≥ 0, no gradient: new priorities of the samples, from the TD loss
    q_values: th.Tensor | None = None  # (B,), no gradient: Q(s_t, a_t)
    gram: th.Tensor | None = None  # (2, 2): inner products of TD and auxiliary gradient, filled by the backward pass

    def metrics(self) -> dict[str, th.Tensor]:
        """The metrics to log: scalars without gradient."""
        terms = {f"{name}_loss": term for name, term in zip(self._fields[:4], self[:4], strict=True) if term is not None}
        if self.q_values is not None:
            terms["mean_q_value"] = self.q_values
        with th.no_grad():
            means = th.stack(list(terms.values())).mean(dim=1)
            metrics = {**dict(zip(terms, means.unbind(), strict=True)), "loss": self.loss.detach()}
            if self.gram is not None:
                td_norm, aux_norm = self.gram.diagonal().sqrt().unbind()
                cosine = self.gram[0, 1] / (td_norm * aux_norm).clamp(min=1e-30)
                metrics |= {"td_state_gradient": td_norm, "aux_state_gradient": aux_norm, "state_gradient_cosine": cosine}
        return metrics


class NextEncodings(NamedTuple):
    """Encodings without gradient that the objective needs."""

    next_features: th.Tensor  # (B, F): from the target encoder, after the n-step transition; empty without TD loss
    selection_features: th.Tensor  # (B, F): the same, from the encoder of the network that chooses the next action
    start: th.Tensor  # (B, D): x̄₀, for the GET loss
    rollout: th.Tensor | None  # (B, M, D): x̄₁ ... x̄_M, for the AET loss


class Objective:
    """
    The sum of TD and auxiliary losses that an update minimises.

    :param policy: online and target network, latent model
    :param double_q: whether the online network chooses the next action (van Hasselt et al. 2016)
    :param shift_pixels: random shift of images, in pixels, ≥ 0
    :param intensity_scale: random intensity of images, ≥ 0
    :param aux_gradient_share: maximum norm of the auxiliary losses' gradient at the features, as a share of the TD
        gradient's norm; ``None``: no limit
    """

    def __init__(
        self,
        policy: EqRPolicy,
        double_q: bool,
        shift_pixels: int,
        intensity_scale: float,
        aux_gradient_share: float | None = None,
    ):
        self.policy = policy
        self.double_q = double_q
        self.aux_gradient_share = aux_gradient_share
        self.augment = Augmentation(policy.observation_space, policy.normalize_images, shift_pixels, intensity_scale)

    def __call__(self, samples: SequenceReplayBufferSamples, coefs: LossCoefs) -> LossTerms:
        """The loss terms of B windows; without a rollout (M = 0) there are no auxiliary losses."""
        observations = self.augment(samples.observations)
        features = self.policy.online.features_extractor(observations)
        # (B, F): TD and auxiliary losses share these features, so their gradients are balanced here. With projection="head"
        # they also share the first layer of the Q head, whose gradients are not.
        for_head = for_state = features
        gram = None
        if coefs.td > 0 and samples.mask is not None and features.requires_grad:  # not if the representation is frozen
            gram = features.new_zeros(2, 2)
            for_head, for_state = branch(features, self.aux_gradient_share, gram)
        state = for_state if samples.mask is None else self.policy.latent_model.embedding(for_state)  # x₀, (B, D)
        encodings = self._encode_next(samples, observations, state, coefs)
        td = priorities = q_values = None
        if coefs.td > 0:
            td, priorities, q_values = self._td_terms(samples, for_head, encodings)
        latent = self._latent_losses(samples, state, encodings, coefs)
        terms = zip(coefs, (td, *latent), strict=True)
        weighted = [term if coef == 1 else coef * term for coef, term in terms if term is not None]
        loss = (samples.weights * sum(weighted[1:], weighted[0])).mean()
        return LossTerms(td, *latent, loss, priorities, q_values, gram)

    @th.no_grad()
    def _encode_next(
        self, samples: SequenceReplayBufferSamples, observations: PyTorchObs, state: th.Tensor, coefs: LossCoefs
    ) -> NextEncodings:
        """Encode everything that needs no gradient. The target copy sees s_t with the online encoder's augmentation."""
        policy, embedding = self.policy, self.policy.latent_model_target.embedding
        has_td, has_latent = coefs.td > 0, samples.mask is not None
        has_start = has_latent and coefs.symmetry > 0  # only the GET loss compares with x̄₀
        is_separate, as_online = policy.latent_target is not policy.target, policy.latent_target_encodes_as_online
        of_target = [self.augment(samples.next_observations)] if has_td else []
        of_latent = [observations] if has_start and not as_online else []
        selection, selects_apart = None, has_td and self.double_q and not policy.target_encodes_as_online
        if selects_apart and is_separate and as_online:
            of_latent = of_target  # this encoder equals the online one, so encode in one pass with the rollout
        elif selects_apart:
            selection = policy.online.features_extractor(of_target[0])
        rollout = [flat(samples.rollout_observations)] if has_latent and coefs.aet > 0 else []
        pieces = chain(of_latent, map(self.augment, chain.from_iterable(map(in_pieces, rollout))))
        encoder, latent_encoder = policy.target.features_extractor, policy.latent_target.features_extractor
        passes: Iterator[th.Tensor]
        if is_separate:
            passes = chain(encode(encoder, of_target), encode(latent_encoder, pieces))
        else:
            passes = encode(encoder, chain(of_target, pieces))  # one tensor per batch
        next_features = next(passes) if has_td else state.new_empty(0)
        if selects_apart and selection is None:
            selection = next(passes)
        start = embedding(next(passes)) if has_start and not as_online else state.detach()
        states = list(passes)
        rolled = embedding(th.cat(states)).view(*samples.mask.shape, -1) if states and samples.mask is not None else None
        return NextEncodings(next_features, next_features if selection is None else selection, start, rolled)

    def _td_terms(
        self, samples: SequenceReplayBufferSamples, features: th.Tensor, encodings: NextEncodings
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Distributional Q-learning on the n-step transition: TD loss, new priorities and Q(s_t, a_t), (B,) each."""
        online, target, n_samples = self.policy.online, self.policy.target, len(features)
        # One pass of the online head, with one draw of noise, for both uses.
        inputs = [features, encodings.selection_features] if self.double_q else [features]
        outputs = online.head(th.cat(inputs), noisy=True)  # (B or 2 B, N, A)
        with th.no_grad():
            next_outputs = target.head(encodings.next_features, noisy=True)  # (B, N, A)
            values = online.expectation(outputs.detach())  # (B or 2 B, A)
            next_values = values[n_samples:] if self.double_q else target.expectation(next_outputs)
            next_best = of_actions(next_outputs, next_values.argmax(dim=1, keepdim=True))  # (B, N)
            discounts = th.addcmul(samples.discounts, samples.discounts, samples.dones, value=-1)  # (B, 1): 0 at the end
        current = of_actions(outputs[:n_samples], samples.actions)  # (B, N)
        loss, priorities = online.td_loss(current, next_best, samples.rewards, discounts)
        return loss, priorities, values.gather(1, samples.actions).squeeze(dim=1)

    def _latent_losses(
        self, samples: SequenceReplayBufferSamples, state: th.Tensor, encodings: NextEncodings, coefs: LossCoefs
    ) -> LatentLosses:
        """The auxiliary losses along the rollout."""
        policy = self.policy
        if samples.mask is None:
            return LatentLosses(None, None, None)
        return policy.latent_model(
            state,
            samples.rollout_actions,
            samples.rollout_rewards if coefs.reward > 0 else None,
            samples.mask,
            encodings.start,
            encodings.rollout,
            policy.latent_model_target if coefs.symmetry > 0 else None,
            policy.project if coefs.aet > 0 else None,
            policy.target_project,
        )


def of_actions(outputs: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """Select the outputs of a head, (B, N, A), for given actions, (B, 1): (B, N)."""
    return th.take_along_dim(outputs, actions[..., None], dim=2).squeeze(dim=2)


class Augmentation:
    """
    Prepare observations for the networks in an update: shift images (also those in a dict), scale their intensity, then apply
    SB3's ``preprocess_obs``. ``normalize_images``: whether images are bytes, which SB3 divides by 255, or already floats.
    """

    def __init__(self, observation_space: spaces.Space, normalize_images: bool, shift_pixels: int, intensity_scale: float):
        is_dict = isinstance(observation_space, spaces.Dict)
        self._spaces = observation_space.spaces if is_dict else {"": observation_space}  # type: ignore[attr-defined]
        self.image_keys = [k for k, s in self._spaces.items() if is_image_space(s, normalized_image=not normalize_images)]
        self._normalize_images = normalize_images
        self.shift_pixels = shift_pixels
        self.intensity_scale = intensity_scale

    def __call__(self, observations: PyTorchObs) -> PyTorchObs:
        """Map observations, (B, *obs_shape) or a dict of these, to floats for a features extractor."""
        if isinstance(observations, dict):
            return {key: self._part(key, obs) for key, obs in observations.items()}
        return self._part("", observations)

    def _part(self, key: str, observations: th.Tensor) -> th.Tensor:
        if key in self.image_keys:
            if self.shift_pixels > 0:
                observations = random_shift(observations, self.shift_pixels)
            if self.intensity_scale > 0:  # in one pass with the division of preprocess_obs: this is the largest tensor
                unit = 1 / 255 if self._normalize_images else 1.0
                return random_intensity(observations, self.intensity_scale, unit).float()
            if self._normalize_images:
                return observations / 255  # as preprocess_obs, in one pass
        return preprocess_obs(observations, self._spaces[key], self._normalize_images)  # type: ignore[return-value]


_PIECE = 2 << 20  # numbers per pass on a CPU: 8 MiB as floats, 74 stacks of Atari frames


def flat(observations: PyTorchObs | None) -> PyTorchObs:
    """Flatten the observations of a rollout, (B, M, ...), into one batch, (B * M, ...)."""
    assert observations is not None
    if isinstance(observations, dict):
        return {key: obs.flatten(0, 1) for key, obs in observations.items()}
    return observations.flatten(0, 1)


def in_pieces(observations: PyTorchObs) -> Iterator[PyTorchObs]:
    """
    Split observations, (N, ...), for passes without gradient. On a CPU, each piece fits into the caches, and into memory
    blocks that the C library reuses, for any M; on other devices there is a single piece.
    """
    tensors = tensors_of(observations)
    if size_of(observations) <= _limit(observations):
        return iter([observations])
    at_a_time = ceil(len(tensors[0]) / ceil(size_of(observations) / _limit(observations)))
    pieces = zip(*(tensor.split(at_a_time) for tensor in tensors), strict=True)
    return (dict(zip(observations, piece, strict=True)) if isinstance(observations, dict) else piece[0] for piece in pieces)


def encode(encoder: nn.Module, batches: Iterable[PyTorchObs]) -> Iterator[th.Tensor]:
    """
    Encode batches of preprocessed observations; consecutive small batches share one pass.

    :param encoder: a features extractor
    :param batches: (N, ...) each, N may differ
    :return: the features of each batch, (N, D)
    """
    waiting: list[PyTorchObs] = []
    for batch in batches:
        if waiting and sum(map(size_of, waiting)) + size_of(batch) > _limit(batch):
            yield from _in_one_pass(encoder, waiting)
            waiting = []
        waiting.append(batch)
    if waiting:
        yield from _in_one_pass(encoder, waiting)


def _in_one_pass(encoder: nn.Module, batches: list[PyTorchObs]) -> Sequence[th.Tensor]:
    if len(batches) == 1:
        return [encoder(batches[0])]
    together: Any = batches
    if isinstance(batches[0], dict):
        features = encoder({key: th.cat([batch[key] for batch in together]) for key in batches[0]})
    else:
        features = encoder(th.cat(together))
    return features.split([len(tensors_of(batch)[0]) for batch in batches])


def tensors_of(observations: PyTorchObs) -> list[th.Tensor]:
    """The values of a dict, or the single tensor."""
    return list(observations.values()) if isinstance(observations, dict) else [observations]


def size_of(observations: PyTorchObs) -> int:
    """The number of elements in all tensors."""
    return sum(tensor.numel() for tensor in tensors_of(observations))


def _limit(observations: PyTorchObs) -> float:
    return _PIECE if tensors_of(observations)[0].device.type == "cpu" else inf


def keep_freed_memory() -> None:
    """
    Make the C library keep freed memory. On Linux, it returns large blocks to the system and requests them again page by
    page, which causes thousands of page faults per update with Atari frames. Its threshold for large blocks adapts to the
    largest block freed so far (mallopt(3), M_MMAP_THRESHOLD; blocks above 32 MiB do not count), and it then keeps up to
    twice as much. This function therefore frees one such block.
    """
    np.empty(31 << 20, dtype=np.uint8)
