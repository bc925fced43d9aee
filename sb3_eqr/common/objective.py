"""The objective of one update (Eq. 21): computes the losses of samples. ``train`` of the agents applies them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch as th
from torch import nn

from sb3_eqr.common.actor_critic_policies import EqRActorCriticPolicy
from sb3_eqr.common.latent.gradients import branch
from sb3_eqr.common.networks.encoders import is_flat
from sb3_eqr.common.networks.inputs import Augmentation
from sb3_eqr.common.policies import EqRPolicy, ignores_mode
from sb3_eqr.common.type_aliases import PyTorchObs, SequenceReplayBufferSamples


class LossTerms(NamedTuple):
    """The losses of an update and what follows from them."""

    losses: dict[str, th.Tensor]  # name -> (B,): those with a weight above 0
    loss: th.Tensor  # (): the mean of their sum, weighted by coefficients and replay weights (Eq. 21)
    priorities: th.Tensor | None = None  # (B,), ≥ 0, no gradient: new priorities of the samples, from the TD loss
    q_values: th.Tensor | None = None  # (B,), no gradient: Q(s_t, a_t)
    gram: th.Tensor | None = None  # (2, 2): inner products of TD and auxiliary gradient, filled by the backward pass

    def metrics(self) -> dict[str, th.Tensor]:
        """The metrics to log: scalars without gradient."""
        terms = {f"{name}_loss": loss for name, loss in self.losses.items()}
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


@dataclass(eq=False)
class LatentObjective:
    """
    The auxiliary losses of windows.

    :param policy: latent model and its target copy
    :param encoder: the encoder that is trained
    :param latent_encoder: the encoder of the latent model's targets
    :param augment: prepares observations for the encoders
    :param target_dtype: in which encoders compute where no gradient flows
    """

    policy: EqRPolicy | EqRActorCriticPolicy
    encoder: nn.Module
    latent_encoder: nn.Module
    augment: Augmentation
    target_dtype: th.dtype = th.float32

    def latent_losses(
        self, names: list[str], samples: SequenceReplayBufferSamples, observations: PyTorchObs, features: th.Tensor
    ) -> dict[str, th.Tensor]:
        """The auxiliary losses along the rollout. The target encoder sees s_t with the online encoder's augmentation."""
        rollout, mask, rewards = samples.rollout_observations, samples.mask, samples.rollout_rewards
        assert rollout is not None and mask is not None and rewards is not None and samples.rollout_actions is not None
        target, target_state, target_states = self.policy.latent_target, None, None
        with th.no_grad():
            if "symmetry" in names:
                is_same = self.latent_encoder is self.encoder
                target_features = features if is_same else self.encode(self.latent_encoder, observations)
                target_state = target.embedding(target_features)  # x̄₀, (B, D)
            if "aet" in names:
                augmented = self.augment(flat(rollout), self.target_dtype)
                target_states = target.embedding(self.encode(self.latent_encoder, augmented))  # x̄_1 ... x̄_M, (B * M, D)
        # After the end of an episode, action 0: what follows must not leak through batch statistics.
        embedded = self.policy.embed_actions(valid_actions(samples.rollout_actions, mask))  # (B, M, A)
        return self.policy.latent_model(names, features, embedded, rewards, mask, target, target_state, target_states)

    def encode(self, encoder: nn.Module, observations: PyTorchObs) -> th.Tensor:
        """Features without gradient, (B, F), of augmented observations, (B, *obs_shape)."""
        if self.target_dtype == th.float32:
            return encoder(observations)
        with th.autocast(self.policy.device.type, self.target_dtype, cache_enabled=False):
            return encoder(observations).float()


class Objective(LatentObjective):
    """
    The sum of TD and auxiliary losses that an update minimises.

    :param policy: online and target network, latent model; whether encoders compute in bfloat16 where no gradient flows
    :param double_q: whether the online network chooses the next action (van Hasselt et al. 2016)
    :param shift_pixels: random shift of images, in pixels, ≥ 0, see :class:`Augmentation`
    :param intensity_scale: random intensity of images, ≥ 0
    :param aux_gradient_share: maximum norm of the auxiliary losses' gradient at the features, as a share of the TD
        gradient's norm; ``None``: no cap
    :param target_is_copied: whether the target network is a copy of the online one before each update. Then its encoder is the
        online one, unless that computes something else in train mode
    """

    policy: EqRPolicy

    def __init__(
        self,
        policy: EqRPolicy,
        double_q: bool,
        shift_pixels: int,
        intensity_scale: float,
        aux_gradient_share: float | None = None,
        target_is_copied: bool = False,
    ):
        self.double_q = double_q
        self.aux_gradient_share = aux_gradient_share
        encoder = policy.online.features_extractor
        if is_flat(encoder):
            shift_pixels, intensity_scale = 0, 0.0
        is_online = target_is_copied and ignores_mode(encoder)
        self.target_encoder = encoder if is_online else policy.target.features_extractor
        of_latent = self.target_encoder if policy.options.latent_tau is None else encoder
        augment = Augmentation(policy.observation_space, policy.normalize_images, shift_pixels, intensity_scale)
        dtype = th.bfloat16 if policy.bfloat16_targets else th.float32
        super().__init__(policy, encoder, policy.latent_encoder or of_latent, augment, dtype)

    def __call__(self, samples: SequenceReplayBufferSamples, coefs: Mapping[str, float]) -> LossTerms:
        """
        :param samples: B windows; without a rollout (M = 0) there are no auxiliary losses
        :param coefs: the weights λ ≥ 0 of the losses "td", "aet", "symmetry" and "reward"; one with weight 0 is not computed
        :return: the losses
        """
        observations = self.augment(samples.observations)
        features = self.encoder(observations)
        # (B, F): TD and auxiliary losses share these features, so their gradients are balanced here. With projection="head"
        # they also share the first layer of the Q head, whose gradients are not.
        for_td = for_latent = features
        gram = priorities = q_values = None
        if coefs["td"] > 0 and samples.mask is not None and features.requires_grad:  # not if the representation is frozen
            gram = features.new_zeros(2, 2)
            for_td, for_latent = branch(features, self.aux_gradient_share, gram)
        losses = {}
        if coefs["td"] > 0:
            losses["td"], priorities, q_values = self.td_loss(samples, for_td)
        if samples.mask is not None:
            names = [name for name, coef in coefs.items() if coef > 0 and name != "td"]
            losses |= self.latent_losses(names, samples, observations, for_latent)
        weighted = [coefs[name] * loss for name, loss in losses.items()]
        loss = (samples.weights * sum(weighted[1:], weighted[0])).mean()
        return LossTerms(losses, loss, priorities, q_values, gram)

    def td_loss(self, samples: SequenceReplayBufferSamples, features: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Distributional Q-learning on the n-step transition: TD loss, new priorities and Q(s_t, a_t), (B,) each."""
        online, target = self.policy.online, self.policy.target
        with th.no_grad():
            next_observations = self.augment(samples.next_observations, self.target_dtype)
            next_features = self.encode(self.target_encoder, next_observations)
            is_same = self.target_encoder is self.encoder or not self.double_q
            for_choice = next_features if is_same else self.encode(self.encoder, next_observations)
            noise = online.head.draw_noise()
        weights = online.head.with_noise(noise)  # one draw for both uses
        with th.no_grad():
            next_outputs = target.head(next_features, target.head.draw_noise())  # (B, N, A)
            outputs = online.head(for_choice, weights) if self.double_q else next_outputs
            next_best = of_actions(next_outputs, online.expectation(outputs).argmax(dim=1, keepdim=True))  # (B, N)
            discounts = samples.discounts * (1 - samples.dones)  # (B, 1): 0 at the end
        current = of_actions(online.head(features, weights), samples.actions)  # (B, N)
        loss, priorities = online.td_loss(current, next_best, samples.rewards, discounts)
        with th.no_grad():
            return loss, priorities, online.expectation(current)


def of_actions(outputs: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """Select the outputs of a head, (B, N, A), for given actions, (B, 1): (B, N)."""
    return th.take_along_dim(outputs, actions[..., None], dim=2).squeeze(dim=2)


def valid_actions(actions: th.Tensor, mask: th.Tensor) -> th.Tensor:
    """Actions, (B, M) or (B, M, A), with action 0 where the mask, (B, M), is 0."""
    return actions * mask.view(*mask.shape, *[1] * (actions.ndim - 2)).to(actions.dtype)


def flat(observations: PyTorchObs) -> PyTorchObs:
    """Flatten the observations of a rollout, (B, M, ...), into one batch, (B * M, ...)."""
    if isinstance(observations, dict):
        return {key: obs.flatten(0, 1) for key, obs in observations.items()}
    return observations.flatten(0, 1)
