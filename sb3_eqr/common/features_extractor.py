"""τ: observations to K group elements."""

from collections.abc import Callable, Sequence
from math import prod
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor
from torch import nn

from sb3_eqr.common.checks import check_number
from sb3_eqr.common.groups import Group, NoGroup, ProductGroup, T, make_group
from sb3_eqr.common.layers import NATURE_LAYERS, ConvTrunk, ImpalaTrunk, Whitening, rescaled
from sb3_eqr.common.type_aliases import PyTorchObs

DEFAULT_GROUP = "SE(2)"  # §7 and Table 5
DEFAULT_N_BLOCKS = 12  # Table 5, for SE(2) and GL(2)
DEFAULT_N_TRANSLATIONS = 32  # Table 5, for T(2)


class ImageExtractor(BaseFeaturesExtractor):
    """
    SB3 features extractor around a convolutional trunk.

    :param observation_space: channels-first images
    :param make_trunk: from the number of channels to the trunk
    :param smallest: legal height and width
    :param normalized_image: as in SB3's ``NatureCNN``: the images are floats already, skip the check for uint8
    :param rescale: whether each sample's features are scaled to [0, 1], as SPR and BBF do
    :raises ValueError: if the observations are no such images
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        make_trunk: Callable[[int], nn.Module],
        smallest: int,
        normalized_image: bool,
        rescale: bool,
    ):
        if not is_image_space(observation_space, check_channels=False, normalized_image=normalized_image):
            raise ValueError(
                f"image encoder: expected uint8 images (channels, height, width) in [0, 255], found {observation_space}. "
                "Use MlpPolicy for vectors, MultiInputPolicy for dicts, both without a features_extractor_class for images, "
                "and normalize_images=False for float images."
            )
        channels, height, width = observation_space.shape
        if min(height, width) < smallest:
            raise ValueError(
                f"image encoder: expected images of at least {smallest}x{smallest} pixels, found {height}x{width}. "
                "Pass a features_extractor_class with smaller filters."
            )
        trunk = make_trunk(channels)
        with th.no_grad():
            features_dim = trunk(th.zeros(1, channels, height, width)).shape[1]
        super().__init__(observation_space, features_dim)
        self.trunk = trunk
        self.rescale = rescale

    def forward(self, observations: th.Tensor) -> th.Tensor:
        features = self.trunk(observations)
        return rescaled(features) if self.rescale else features


class ConvExtractor(ImageExtractor):
    """
    :class:`~sb3_eqr.common.layers.ConvTrunk` as SB3 features extractor: the paper's convolutions, no linear layer.

    :param observation_space: channels-first images, at least 36×36 with the default layers
    :param normalized_image: as in SB3's ``NatureCNN``: the images are floats already, skip the check for uint8
    :param layers: (filters, kernel size, stride) of each convolution
    :param rescale: whether each sample's features are scaled to [0, 1], as SPR and BBF do
    :raises ValueError: if the observations are no such images
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        normalized_image: bool = False,
        layers: Sequence[Sequence[int]] = NATURE_LAYERS,
        rescale: bool = False,
    ):
        smallest = ConvTrunk.smallest_image(layers)
        super().__init__(observation_space, lambda channels: ConvTrunk(channels, layers), smallest, normalized_image, rescale)


class ImpalaExtractor(ImageExtractor):
    """
    :class:`~sb3_eqr.common.layers.ImpalaTrunk` as SB3 features extractor.

    :param observation_space: channels-first images
    :param normalized_image: as in SB3's ``NatureCNN``: the images are floats already, skip the check for uint8
    :param width_scale: multiplies the channels, > 0; 4 in BBF (https://arxiv.org/abs/2305.19452)
    :param rescale: whether each sample's features are scaled to [0, 1], as SPR and BBF do
    :raises ValueError: if the observations are no such images, or for a width of 0 or less
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        normalized_image: bool = False,
        width_scale: float = 1,
        rescale: bool = False,
    ):
        check_number("width_scale", width_scale, 1 / 16)  # one channel in the first stage
        super().__init__(observation_space, lambda channels: ImpalaTrunk(channels, width_scale), 1, normalized_image, rescale)


# Names for files that hold plain strings only.
TRUNKS: dict[str, type[BaseFeaturesExtractor]] = {"nature": ConvExtractor, "impala": ImpalaExtractor}


def find_trunk(trunk: str | type[BaseFeaturesExtractor]) -> type[BaseFeaturesExtractor]:
    """
    :param trunk: a features extractor, or one of the names in ``TRUNKS``
    :raises ValueError: for an unknown name
    """
    if not isinstance(trunk, str):
        return trunk
    if trunk not in TRUNKS:
        raise ValueError(f"features_extractor_class: expected a class or one of {list(TRUNKS)}, found {trunk!r}")
    return TRUNKS[trunk]


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
    :param parameterization: of rotations, "euler", "exp" or "gram-schmidt"
    :param whiten: whether the algebra parameters are whitened over the batch (:class:`~sb3_eqr.common.layers.Whitening`), so
        that states cannot collapse to a point, and blocks are driven apart
    :param trunk_class: features extractor in front of the linear layer, or its name ("nature", "impala"); ``None``: the
        paper's convolutions for images, SB3's extractors otherwise
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
        whiten: bool = False,
        trunk_class: str | type[BaseFeaturesExtractor] | None = None,
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
        found = default_trunk(observation_space, normalized_image) if trunk_class is None else find_trunk(trunk_class)
        is_default = trunk_class is None and found is not FlattenExtractor
        if is_default or (normalized_image and issubclass(found, ImageExtractor)):
            trunk_kwargs.setdefault("normalized_image", normalized_image)
        self.trunk = found(observation_space, **trunk_kwargs)
        n_params = n_blocks * made.num_params
        self.to_algebra: nn.Module = nn.Linear(self.trunk.features_dim, n_params)
        if whiten:
            self.to_algebra = nn.Sequential(self.to_algebra, Whitening(n_params))

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """
        :param observations: preprocessed by SB3, (B, ...) or a dict of these
        :return: the K elements, flattened, (B, features_dim)
        """
        return self.elements(self.trunk(observations))

    def elements(self, features: th.Tensor) -> th.Tensor:
        """
        :param features: of the trunk, (B, n)
        :return: the K elements, flattened, (B, features_dim)
        """
        params = self.to_algebra(features)  # (B, K * num_params)
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
