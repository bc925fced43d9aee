"""What every EqR policy adds to an SB3 Q-learning policy."""

from copy import deepcopy
from typing import Any, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import get_parameters_by_name, polyak_update
from torch import nn

from sb3_eqr.common.checks import check_number
from sb3_eqr.common.features_extractor import ConvExtractor, GroupFeaturesExtractor
from sb3_eqr.common.groups import Group, NoGroup
from sb3_eqr.common.latent_model import LatentModel, Projection
from sb3_eqr.common.layers import DistributionalHead
from sb3_eqr.common.type_aliases import PyTorchObs

Module = TypeVar("Module", bound=nn.Module)


class EqRNetwork(BasePolicy):
    """A features extractor and a distributional head; what online and target networks have in common."""

    head: DistributionalHead
    net_arch: list[int]

    def features(self, obs: PyTorchObs) -> th.Tensor:
        """
        :param obs: (B, *obs_shape), or a dict of these
        :return: (B, D)
        """
        return self.extract_features(obs, self.features_extractor)


class EqRPolicy(BasePolicy):
    """
    Mixin, to stand before an SB3 policy whose ``_build`` makes an online network, a target network and the optimiser.
    It puts the group encoder behind the policy's features extractor, and adds the latent model, its target copy,
    its parameter group and its train mode.

    A subclass calls :meth:`_configure` before its base's constructor (which builds), and defines ``online`` and ``target``.
    """

    action_space: spaces.Discrete
    latent_model: LatentModel
    latent_model_target: LatentModel
    own_projection: nn.Linear | None
    own_projection_target: nn.Linear | None

    def _configure(
        self,
        *,
        group: str | Group | None,
        n_blocks: int | None,
        parameterization: str,
        latent_hidden_dim: int,
        dueling: bool,
        noisy: bool,
        sigma_init: float,
        shared_projection: bool,
        reward_loss: str,
    ) -> None:
        check_number("latent_hidden_dim", latent_hidden_dim, 1, whole=True)
        check_number("sigma_init", sigma_init, 0)
        self.group = group
        self.n_blocks = n_blocks
        self.parameterization = parameterization
        self.latent_hidden_dim = latent_hidden_dim
        self.dueling = dueling
        self.noisy = noisy
        self.sigma_init = sigma_init
        self.shared_projection = shared_projection
        self.reward_loss = reward_loss

    @property
    def online(self) -> EqRNetwork:
        """The network that acts and is trained."""
        raise AttributeError(f"{type(self).__name__} must define `online`")

    @property
    def target(self) -> EqRNetwork:
        """Its target copy."""
        raise AttributeError(f"{type(self).__name__} must define `target`")

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """The given features extractor as trunk, the group encoder behind it; ``group=None`` leaves the trunk alone."""
        trunk_kwargs = dict(self.features_extractor_kwargs)
        if not self.normalize_images and issubclass(self.features_extractor_class, ConvExtractor):
            trunk_kwargs["normalized_image"] = True  # SB3 does this for its own extractors
        if self.group is None:
            return self.features_extractor_class(self.observation_space, **trunk_kwargs)
        group_kwargs = {
            "group": self.group,
            "n_blocks": self.n_blocks,
            "parameterization": self.parameterization,
            "normalized_image": not self.normalize_images,
        }
        if issubclass(self.features_extractor_class, GroupFeaturesExtractor):
            return self.features_extractor_class(self.observation_space, **{**group_kwargs, **trunk_kwargs})
        return GroupFeaturesExtractor(
            self.observation_space,
            **group_kwargs,  # type: ignore[arg-type]
            trunk_class=self.features_extractor_class,
            trunk_kwargs=trunk_kwargs,
        )

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)  # type: ignore[misc]
        encoder = self.online.features_extractor
        if isinstance(encoder, GroupFeaturesExtractor):
            group, n_blocks = encoder.group, encoder.n_blocks
        else:
            group, n_blocks = NoGroup(encoder.features_dim), 1
        self.latent_model = LatentModel(
            group, n_blocks, int(self.action_space.n), self.latent_hidden_dim, self.reward_loss
        ).to(self.device)
        self.latent_model_target = _frozen_copy(self.latent_model)
        parameters = list(self.latent_model.parameters())
        self.own_projection = self.own_projection_target = None
        if not self.shared_projection:
            self.own_projection = nn.Linear(encoder.features_dim, self.latent_hidden_dim).to(self.device)
            self.own_projection_target = _frozen_copy(self.own_projection)
            parameters += self.own_projection.parameters()
        # One optimiser: the learning-rate schedule and the save path are the inherited ones.
        self.optimizer.add_param_group({"params": parameters})

    @property
    def project(self) -> Projection:
        """p of the AET loss: the first layer of the Q head, or a layer of its own."""
        return self.online.head.project if self.own_projection is None else self.own_projection

    @property
    def target_project(self) -> Projection:
        """p̄, from the target copy."""
        return self.target.head.project if self.own_projection_target is None else self.own_projection_target

    def update_target(self, tau: float) -> None:
        """
        Move the one target copy: encoder, Q head, κ, b.

        :param tau: in [0, 1]; 1 copies
        """
        for online, target in self._target_pairs():
            polyak_update(online.parameters(), target.parameters(), tau)
            # Running statistics are copied, see https://github.com/DLR-RM/stable-baselines3/issues/996
            polyak_update(get_parameters_by_name(online, ["running_"]), get_parameters_by_name(target, ["running_"]), 1.0)

    def _target_pairs(self) -> list[tuple[nn.Module, nn.Module]]:
        pairs: list[tuple[nn.Module | None, nn.Module | None]] = [
            (self.online, self.target),
            (self.own_projection, self.own_projection_target),
            (self.latent_model.transition, self.latent_model_target.transition),
            (self.latent_model.projection, self.latent_model_target.projection),
        ]
        return [(online, target) for online, target in pairs if online is not None and target is not None]

    def set_training_mode(self, mode: bool) -> None:
        """
        Put everything that is trained into train or eval mode; the target copy stays in eval mode.

        :param mode: True for training
        """
        super().set_training_mode(mode)
        self.latent_model.train(mode)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            group=self.group,
            n_blocks=self.n_blocks,
            parameterization=self.parameterization,
            latent_hidden_dim=self.latent_hidden_dim,
            dueling=self.dueling,
            noisy=self.noisy,
            sigma_init=self.sigma_init,
            shared_projection=self.shared_projection,
            reward_loss=self.reward_loss,
        )
        return data


def _frozen_copy(module: Module) -> Module:
    """A copy in eval mode without trained parameters. Parts that no target needs (r_ψ, ρ) are left out."""
    copy = deepcopy(module)
    if isinstance(copy, LatentModel):
        del copy.reward_net, copy.action_symmetry
    return copy.requires_grad_(False).eval()
