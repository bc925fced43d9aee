"""τ: observations to K group elements."""

from math import prod
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor
from torch import nn

from sb3_eqr.common.checks import check_number
from sb3_eqr.common.groups import Group, NoGroup, ProductGroup, T, make_group
from sb3_eqr.common.layers import ConvTrunk
from sb3_eqr.common.type_aliases import PyTorchObs

DEFAULT_GROUP = "SE(2)"  # §7 and Table 5
DEFAULT_N_BLOCKS = 12  # Table 5, for SE(2) and GL(2)
DEFAULT_N_TRANSLATIONS = 32  # Table 5, for T(2)


class ConvExtractor(BaseFeaturesExtractor):
    """
    SB3 features extractor around :class:`~sb3_eqr.common.layers.ConvTrunk`: the paper's convolutions, no linear layer.

    :param observation_space: channels-first images, at least 36×36
    :param normalized_image: as in SB3's ``NatureCNN``: the images are floats already, skip the check for uint8
    :raises ValueError: if the observations are no such images
    """

    def __init__(self, observation_space: spaces.Box, normalized_image: bool = False):
        if not is_image_space(observation_space, check_channels=False, normalized_image=normalized_image):
            raise ValueError(
                f"CnnPolicy: expected uint8 images (channels, height, width) in [0, 255], found {observation_space}. "
                "Use MlpPolicy for vectors, MultiInputPolicy for dicts, and normalize_images=False for float images."
            )
        channels, height, width = observation_space.shape
        if min(height, width) < 36:
            raise ValueError(
                f"CnnPolicy: expected images of at least 36x36 pixels, found {height}x{width}. "
                "Pass a features_extractor_class with smaller filters."
            )
        trunk = ConvTrunk(channels)
        with th.no_grad():
            features_dim = trunk(th.zeros(1, channels, height, width)).shape[1]
        super().__init__(observation_space, features_dim)
        self.trunk = trunk

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.trunk(observations)


def default_trunk(observation_space: spaces.Space, normalized_image: bool) -> type[BaseFeaturesExtractor]:
    """
    :param observation_space: any that SB3 supports
    :param normalized_image: whether images are floats already
    :return: the paper's convolutions for images, SB3's extractors otherwise
    """
    if isinstance(observation_space, spaces.Dict):
        return CombinedExtractor
    is_image = is_image_space(observation_space, normalized_image=normalized_image)
    return ConvExtractor if is_image else FlattenExtractor


class GroupFeaturesExtractor(BaseFeaturesExtractor):
    """
    A trunk, one linear layer to the Lie algebra, K group elements, flattened (τ_θ of Eq. 13, appendix B.4).
    It is a plain SB3 features extractor: stock QRDQN, DQN and PPO take it as ``features_extractor_class``.

    :param observation_space: any that the trunk takes
    :param group: see :func:`~sb3_eqr.common.groups.make_group`
    :param n_blocks: K ≥ 1; ``None``: 12, for T(n) 32 (Table 5), and 1 where the name counts its own blocks
        ("SE(2)^8 x SO(3)^4", "none")
    :param parameterization: of rotations, "euler" or "exp"
    :param trunk_class: features extractor in front of the linear layer; ``None``: the paper's convolutions for images,
        SB3's extractors otherwise
    :param trunk_kwargs: its keyword arguments
    :param normalized_image: as in SB3's extractors: images are floats already; reaches the default trunk
    :raises ValueError: for an unknown group or a number of blocks below 1
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        group: str | Group = DEFAULT_GROUP,
        n_blocks: int | None = None,
        parameterization: str = "euler",
        trunk_class: type[BaseFeaturesExtractor] | None = None,
        trunk_kwargs: dict[str, Any] | None = None,
        normalized_image: bool = False,
    ):
        made = make_group(group, parameterization)
        if n_blocks is None:
            n_blocks = DEFAULT_N_TRANSLATIONS if isinstance(made, T) else DEFAULT_N_BLOCKS
            n_blocks = 1 if isinstance(made, (ProductGroup, NoGroup)) else n_blocks
        check_number("n_blocks", n_blocks, 1, whole=True)
        super().__init__(observation_space, n_blocks * prod(made.element_shape))
        self.group = made
        self.n_blocks = n_blocks
        self._description = f"{made}^{n_blocks}, {parameterization}"
        trunk_kwargs = dict(trunk_kwargs or {})
        if trunk_class is None:
            trunk_class = default_trunk(observation_space, normalized_image)
            if trunk_class is not FlattenExtractor:
                trunk_kwargs.setdefault("normalized_image", normalized_image)
        self.trunk = trunk_class(observation_space, **trunk_kwargs)
        self.to_algebra = nn.Linear(self.trunk.features_dim, n_blocks * made.num_params)

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """
        :param observations: preprocessed by SB3, (B, ...) or a dict of these
        :return: the K elements, flattened, (B, features_dim)
        """
        params = self.to_algebra(self.trunk(observations))  # (B, K * num_params)
        elements = self.group.element(params.unflatten(-1, (self.n_blocks, self.group.num_params)))
        return elements.flatten(1)  # (B, K * prod(element_shape))

    # The group travels with the parameters: two groups may well have parameters of the same shapes.
    def get_extra_state(self) -> th.Tensor:
        return th.tensor(list(self._description.encode()), dtype=th.uint8)

    def set_extra_state(self, state: th.Tensor) -> None:
        found = bytes(state.tolist()).decode(errors="replace")
        if found != self._description:
            raise ValueError(
                f"group encoder: expected parameters of {self._description!r}, found parameters of {found!r}. "
                "Build the model with the group and n_blocks of the file, or use load(), which does."
            )
