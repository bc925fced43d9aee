"""τ: observations to K group elements."""

from math import prod
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from torch import nn

from sb3_eqr.common.groups import Group, NoGroup, ProductGroup, T, make_group
from sb3_eqr.common.networks.layers import Whitening
from sb3_eqr.common.networks.trunks import ImageExtractor, default_trunk, find_trunk
from sb3_eqr.common.type_aliases import PyTorchObs
from sb3_eqr.common.validation import check_number

DEFAULT_GROUP = "SE(2)"  # §7 and Table 5
DEFAULT_N_BLOCKS = 12  # Table 5, for SE(2) and GL(2)
DEFAULT_N_TRANSLATIONS = 32  # Table 5, for T(2)


class GroupFeaturesExtractor(BaseFeaturesExtractor):
    """
    A trunk, one linear layer to the Lie algebra, K group elements, flattened (τ_θ of Eq. 13, appendix B.4).
    It is a plain SB3 features extractor: stock QRDQN, DQN and PPO take it as ``features_extractor_class``.

    :param observation_space: any that the trunk takes
    :param group: see :func:`~sb3_eqr.common.groups.make_group`
    :param n_blocks: K ≥ 1; ``None``: 12, for T(n) 32 (Table 5), and 1 where the name counts its own blocks
        ("SE(2)^8 x SO(3)^4", "none")
    :param parameterization: of rotations, "euler", "exp" or "gram-schmidt"
    :param whiten: whether the algebra parameters are whitened over the batch
        (:class:`~sb3_eqr.common.networks.layers.Whitening`): states cannot collapse to a point, and blocks are driven apart
    :param trunk_class: features extractor in front of the linear layer, or its name ("nature", "impala"); ``None``: the
        paper's convolutions for images, SB3's extractors otherwise
    :param trunk_kwargs: its keyword arguments
    :param normalized_image: as in SB3's extractors: images are floats already; reaches the default trunk
    :param features_dim: size of the trunk's features, as SB3's extractors take it; ``None``: the trunk's own default
    :raises ValueError: for an unknown group or a number of blocks below 1
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        group: str | Group = DEFAULT_GROUP,
        n_blocks: int | None = None,
        parameterization: str = "euler",
        whiten: bool = False,
        trunk_class: str | type[BaseFeaturesExtractor] | None = None,
        trunk_kwargs: dict[str, Any] | None = None,
        normalized_image: bool = False,
        features_dim: int | None = None,
    ):
        made = make_group(group, parameterization)
        if n_blocks is None:
            n_blocks = DEFAULT_N_TRANSLATIONS if isinstance(made, T) else DEFAULT_N_BLOCKS
            n_blocks = 1 if isinstance(made, (ProductGroup, NoGroup)) else n_blocks
        check_number("n_blocks", n_blocks, 1, whole=True)
        super().__init__(observation_space, n_blocks * prod(made.element_shape))
        self.group = made
        self.n_blocks = n_blocks
        self.description = f"{made}^{n_blocks}, {parameterization}"  # shapes of parameters do not determine the group
        trunk_kwargs = dict(trunk_kwargs or {})
        found = default_trunk(observation_space, normalized_image) if trunk_class is None else find_trunk(trunk_class)
        is_default = trunk_class is None and found is not FlattenExtractor
        if is_default or (normalized_image and issubclass(found, ImageExtractor)):
            trunk_kwargs.setdefault("normalized_image", normalized_image)
        if features_dim is not None:
            trunk_kwargs["features_dim"] = features_dim
        self.trunk = found(observation_space, **trunk_kwargs)
        n_params = n_blocks * made.num_params
        self.to_algebra: nn.Module = nn.Linear(self.trunk.features_dim, n_params)
        if whiten:
            self.to_algebra = nn.Sequential(self.to_algebra, Whitening(n_params))

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """Observations preprocessed by SB3, (B, ...) or a dict of these, to K flattened elements, (B, features_dim)."""
        params = self.to_algebra(self.trunk(observations))  # (B, K * num_params)
        elements = self.group.element(params.unflatten(-1, (self.n_blocks, self.group.num_params)))
        return elements.flatten(1)  # (B, K * prod(element_shape))
