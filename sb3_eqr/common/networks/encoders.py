"""Features extractors: convolutional trunks, and the group encoder τ on top of a trunk."""

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from math import prod
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import TensorDict
from torch import nn
from torch.nn import functional as F

from sb3_eqr.common.checks.arguments import check, integer, number
from sb3_eqr.common.groups import DEFAULT_GROUP, Group, GroupLayer
from sb3_eqr.common.losses import rescaled
from sb3_eqr.common.networks.layers import Centering
from sb3_eqr.common.type_aliases import PyTorchObs

NATURE_LAYERS = ((32, 8, 4), (64, 4, 2), (64, 3, 1))  # Mnih et al. 2015, and appendix B.4
SMALL_LAYERS = ((16, 3, 1),)  # MinAtar (Young and Tian 2019, https://arxiv.org/abs/1903.03176), whose images are 10×10


class ConvTrunk(nn.Sequential):
    """
    Convolutions, each followed by a ReLU; the output is flattened, without a linear layer.

    :param in_channels: C
    :param layers: (filters, kernel size, stride) of each convolution; by default those of Mnih et al. 2015 (appendix B.4)
    """

    memory_format = th.channels_last  # fastest for several convolutions on CPU, and not slower on GPU

    def __init__(self, in_channels: int, layers: Sequence[Sequence[int]] = NATURE_LAYERS):
        modules: list[nn.Module] = []
        for filters, kernel_size, stride in layers:
            modules += [nn.Conv2d(in_channels, filters, kernel_size, stride), nn.ReLU(inplace=True)]
            in_channels = filters
        super().__init__(*modules, nn.Flatten())
        if len(layers) == 1:  # its output is flattened directly, which needs the contiguous layout
            self.memory_format = th.contiguous_format

    @staticmethod
    def smallest_image(layers: Sequence[Sequence[int]] = NATURE_LAYERS) -> int:
        """The height and width for which one pixel is left after the last layer."""
        size = 1
        for _, kernel_size, stride in reversed(layers):
            size = (size - 1) * stride + kernel_size
        return size

    def to_channels_last(self) -> None:
        """
        Convert the weights to the memory format of :meth:`forward`, so that calls need not copy them. The constructor does not
        do this, because the orthogonal initialisation of SB3's PPO requires PyTorch's default layout.
        """
        self.to(memory_format=self.memory_format)  # type: ignore[call-overload]

    def forward(self, images: th.Tensor) -> th.Tensor:
        """Map images, (B, C, H, W), floating point, to features, (B, trunk_dim)."""
        return super().forward(images.contiguous(memory_format=self.memory_format))


class ImpalaTrunk(ConvTrunk):
    """
    The residual network of IMPALA (Espeholt et al. 2018, Figure 3, https://arxiv.org/abs/1802.01561) with flattened output,
    without a linear layer: three stages of a 3×3 convolution, a 3×3 max pooling with stride 2 and two residual blocks.

    :param in_channels: C
    :param width_scale: factor for the 16, 32 and 32 channels of the stages; BBF uses 4
    """

    def __init__(self, in_channels: int, width_scale: float = 1):
        modules: list[nn.Module] = []
        for channels in (16, 32, 32):
            width = max(round(channels * width_scale), 1)
            modules += [nn.Conv2d(in_channels, width, 3, padding=1), nn.MaxPool2d(3, stride=2, padding=1)]
            modules += [ResidualBlock(width), ResidualBlock(width)]
            in_channels = width
        nn.Sequential.__init__(self, *modules, nn.ReLU(), nn.Flatten())


class ResidualBlock(nn.Module):
    """
    x + conv(ReLU(conv(ReLU(x)))), with 3×3 convolutions.

    :param channels: number of input and output channels
    """

    def __init__(self, channels: int):
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, images: th.Tensor) -> th.Tensor:
        """Map (B, C, H, W) to (B, C, H, W)."""
        return images + self.conv2(F.relu(self.conv1(F.relu(images)), inplace=True))


class ImageExtractor(BaseFeaturesExtractor):
    """
    SB3 features extractor with a convolutional trunk.

    :param observation_space: channels-first images
    :param make_trunk: function that creates the trunk for a number of channels
    :param smallest: smallest legal height and width
    :param features_dim: size of a linear layer with a ReLU after the convolutions; ``None``: no such layer
    :param normalized_image: as in SB3's ``NatureCNN``: images are already floats, skip the check for uint8
    :param rescale: whether to scale the output of the convolutions to [0, 1] per sample, as in SPR and BBF
    :raises ValueError: if the observations are not such images
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        make_trunk: Callable[[int], ConvTrunk],
        smallest: int,
        features_dim: int | None,
        normalized_image: bool,
        rescale: bool,
    ):
        if features_dim is not None:
            check("features_dim", features_dim, integer(1))
        if not is_image_space(observation_space, check_channels=False, normalized_image=normalized_image):
            raise ValueError(
                f"observation_space must be uint8 images (channels, height, width) in [0, 255], got {observation_space}. "
                "Use MlpPolicy for vectors, MultiInputPolicy for dicts (both without an image features_extractor_class), "
                "normalize_images=False for float images, and sb3_eqr.envs.minatar.ChannelsFirstImage for MinAtar. "
                "VecNormalize (normalize in RL Zoo) needs norm_obs=False for images."
            )
        channels, height, width = observation_space.shape
        if min(height, width) < smallest:
            raise ValueError(
                f"Images must be (channels, height, width) with at least {smallest}x{smallest} pixels, got "
                f"{observation_space.shape}. "
                "Pass smaller filters, such as policy_kwargs=dict(features_extractor_kwargs=dict(layers=[[16, 3, 1]])): "
                '"Small images" in docs/own_environment.md.'
            )
        trunk = make_trunk(channels)
        with th.no_grad():
            image = th.zeros(1, channels, height, width)
            _, *self.map_shape = nn.Sequential(*list(trunk)[:-1])(image).shape  # (C, H, W), before flattening
            trunk_dim = prod(self.map_shape)
        super().__init__(observation_space, features_dim or trunk_dim)
        self.trunk = trunk
        self.rescale = rescale
        self.linear = None if features_dim is None else nn.Sequential(nn.Linear(trunk_dim, features_dim), nn.ReLU())

    def forward(self, observations: th.Tensor) -> th.Tensor:
        features = self.trunk(observations)  # (B, trunk_dim)
        features = rescaled(features) if self.rescale else features
        return features if self.linear is None else self.linear(features)  # (B, features_dim)


class ConvExtractor(ImageExtractor):
    """
    The paper's convolutions: :class:`ConvTrunk`. The other parameters are those of :class:`ImageExtractor`.

    :param layers: (filters, kernel size, stride) of each convolution; the default needs images of at least 36×36 pixels
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        features_dim: int | None = None,
        normalized_image: bool = False,
        layers: Sequence[Sequence[int]] = NATURE_LAYERS,
        rescale: bool = False,
    ):
        smallest = ConvTrunk.smallest_image(layers)
        make_trunk = partial(ConvTrunk, layers=layers)
        super().__init__(observation_space, make_trunk, smallest, features_dim, normalized_image, rescale)


class ImpalaExtractor(ImageExtractor):
    """
    The residual network of IMPALA: :class:`ImpalaTrunk`. The other parameters are those of :class:`ImageExtractor`.

    :param width_scale: factor for the number of channels, ≥ 1/16; 4 in BBF (https://arxiv.org/abs/2305.19452)
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        features_dim: int | None = None,
        normalized_image: bool = False,
        width_scale: float = 1,
        rescale: bool = False,
    ):
        check("width_scale", width_scale, number(1 / 16))  # at least one channel in the first stage
        make_trunk = partial(ImpalaTrunk, width_scale=width_scale)
        super().__init__(observation_space, make_trunk, 1, features_dim, normalized_image, rescale)


class MlpExtractor(BaseFeaturesExtractor):
    """
    Flatten, one linear layer and a ReLU: a trunk for vectors, so that Q-learning and the latent model share trained
    features.

    :param observation_space: any space except ``Dict``
    :param features_dim: size of the layer
    """

    def __init__(self, observation_space: spaces.Space, features_dim: int = 256):
        check("features_dim", features_dim, integer(1))
        super().__init__(observation_space, features_dim)
        flat = FlattenExtractor(observation_space)
        self.layers = nn.Sequential(flat, *self.make_layers(flat.features_dim, features_dim))

    @staticmethod
    def make_layers(n_in: int, n_out: int) -> list[nn.Module]:
        """The layers after flattening."""
        return [nn.Linear(n_in, n_out), nn.ReLU()]

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Map (B, *obs_shape) to (B, features_dim)."""
        return self.layers(observations)


class TwoLayerExtractor(MlpExtractor):
    """Flatten, a linear layer, layer norm, ELU and a second linear layer of the same size: an encoder for vectors."""

    @staticmethod
    def make_layers(n_in: int, n_out: int) -> list[nn.Module]:
        return [nn.Linear(n_in, n_out), nn.LayerNorm(n_out), nn.ELU(), nn.Linear(n_out, n_out)]


FLAT = (MlpExtractor, FlattenExtractor)  # for vectors


class DictExtractor(BaseFeaturesExtractor):
    """
    SB3's ``CombinedExtractor`` with the convolutions of :class:`ConvExtractor`, so that images may be small, and a layer for
    everything else, because the scale of raw numbers would not survive a layer norm.

    :param observation_space: a ``Dict``
    :param cnn_output_dim: size of the linear layer with a ReLU after the convolutions of each image
    :param normalized_image: as in :class:`ImageExtractor`
    :param layers: as in :class:`ConvExtractor`, the same for every image; ``None``: for each image the paper's, or, if it is
        smaller than 36×36, one layer of 16 filters of 3×3, as for MinAtar
    :param mlp_output_dim: size of the linear layer with a ReLU that takes everything but images, flattened
    :raises ValueError: if an image is too small for the layers
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        cnn_output_dim: int = 256,
        normalized_image: bool = False,
        layers: Sequence[Sequence[int]] | None = None,
        mlp_output_dim: int = 256,
    ):
        check("mlp_output_dim", mlp_output_dim, integer(1))
        images, others = {}, {}
        for key, space in observation_space.spaces.items():
            if is_image_space(space, normalized_image=normalized_image):
                is_small = min(space.shape[-2:]) < ConvTrunk.smallest_image()  # type: ignore[index]
                chosen = layers or (SMALL_LAYERS if is_small else NATURE_LAYERS)
                images[key] = ConvExtractor(space, cnn_output_dim, normalized_image, chosen)  # type: ignore[arg-type]
            else:
                others[key] = FlattenExtractor(space)
        super().__init__(observation_space, cnn_output_dim * len(images) + mlp_output_dim * bool(others))
        # Lists, because a ModuleDict refuses keys such as "items" and "a.b".
        self.image_keys, self.images = list(images), nn.ModuleList(images.values())
        self.other_keys, self.others = list(others), nn.ModuleList(others.values())
        n_numbers = sum(flat.features_dim for flat in others.values())
        self.mlp = nn.Sequential(nn.Linear(n_numbers, mlp_output_dim), nn.ReLU()) if others else None

    def forward(self, observations: TensorDict) -> th.Tensor:
        """Map a dict of (B, ...) to (B, features_dim)."""
        features = [extractor(observations[key]) for key, extractor in zip(self.image_keys, self.images, strict=True)]
        if self.mlp is not None:
            numbers = [flat(observations[key]) for key, flat in zip(self.other_keys, self.others, strict=True)]
            features.append(self.mlp(th.cat(numbers, dim=1)))
        return th.cat(features, dim=1)


# Names for use in YAML files.
TRUNKS: dict[str, type[BaseFeaturesExtractor]] = {
    "nature": ConvExtractor,
    "impala": ImpalaExtractor,
    "mlp": MlpExtractor,
    "two_layer": TwoLayerExtractor,
    "flatten": FlattenExtractor,
}


def find_trunk(trunk: str | type[BaseFeaturesExtractor]) -> type[BaseFeaturesExtractor]:
    """Resolve a features extractor given as a class or by its name in ``TRUNKS``; raises ValueError for an unknown name."""
    if not isinstance(trunk, str):
        return trunk
    if trunk not in TRUNKS:
        raise ValueError(f"features_extractor_class must be a class or one of {list(TRUNKS)}, got {trunk!r}.")
    return TRUNKS[trunk]


def default_trunk(observation_space: spaces.Space, normalized_image: bool) -> type[BaseFeaturesExtractor]:
    """The paper's convolutions for images (floats if ``normalized_image``), also in dicts, SB3's extractor otherwise."""
    if isinstance(observation_space, spaces.Dict):
        return DictExtractor
    is_image = is_image_space(observation_space, normalized_image=normalized_image)
    return ConvExtractor if is_image else FlattenExtractor


class NormalizedExtractor(BaseFeaturesExtractor):
    """
    A trunk followed by layer norm (Ba et al. 2016, https://arxiv.org/abs/1607.06450): the features of each sample have mean 0
    and variance 1, which is the scale that the next layers expect.

    :param trunk: any features extractor
    :param center: whether to subtract the running mean of the trunk's features before the layer norm (docs/gradients.md)
    """

    def __init__(self, trunk: BaseFeaturesExtractor, center: bool = False):
        super().__init__(trunk._observation_space, trunk.features_dim)
        self.trunk = trunk
        self.center = Centering(trunk.features_dim) if center else nn.Identity()
        self.norm = nn.LayerNorm(trunk.features_dim)

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """Map the trunk's input to features, (B, features_dim)."""
        return self.norm(self.center(self.trunk(observations)))


def is_flat(encoder: nn.Module) -> bool:
    """Whether it takes each pixel of an image for a number of its own."""
    return isinstance(trunk_of(encoder), FLAT)


def make_trunk(
    trunk_class: type[BaseFeaturesExtractor],
    observation_space: spaces.Space,
    trunk_kwargs: dict[str, Any],
    layer_norm: bool,
    center: bool,
    normalize_images: bool = True,
) -> BaseFeaturesExtractor:
    """
    :param trunk_class: any features extractor
    :param observation_space: its observations
    :param trunk_kwargs: its other arguments
    :param layer_norm: whether a :class:`NormalizedExtractor` follows
    :param center: as in :class:`NormalizedExtractor`
    :param normalize_images: whether images are bytes, or already floats
    :return: the trunk
    :raises ValueError: if the trunk is for vectors and the observations are dicts
    """
    if issubclass(trunk_class, FLAT) and isinstance(observation_space, spaces.Dict):
        raise ValueError(
            f"features_extractor_class must accept dicts, got {trunk_class.__name__} for {observation_space}. "
            "Use MultiInputPolicy and leave features_extractor_class out."
        )
    if layer_norm and issubclass(trunk_class, FlattenExtractor) and not isinstance(observation_space, spaces.Discrete):
        warnings.warn(
            "features_extractor_class='flatten' with layer_norm=True: the numbers of each observation are shifted and scaled "
            "to mean 0 and variance 1, which loses information. Pass features_extractor_class='mlp', or layer_norm=False."
        )
    if not normalize_images and issubclass(trunk_class, (ImageExtractor, DictExtractor)):
        trunk_kwargs = {**trunk_kwargs, "normalized_image": True}
    trunk = trunk_class(observation_space, **trunk_kwargs)
    return NormalizedExtractor(trunk, center) if layer_norm else trunk


def trunk_of(encoder: nn.Module) -> nn.Module:
    """The trunk inside an encoder, below layer norm and group layer."""
    while isinstance(encoder, (NormalizedExtractor, GroupFeaturesExtractor)):
        encoder = encoder.trunk
    return encoder


class GroupFeaturesExtractor(BaseFeaturesExtractor):
    """
    A trunk and a :class:`GroupLayer`: τ_θ of Eq. 13.
    It is an ordinary SB3 features extractor: SB3's DQN and PPO and SB3-Contrib's QRDQN accept it as
    ``features_extractor_class``.

    :param observation_space: any space that the trunk accepts
    :param group: as in :class:`GroupLayer`, like the next three
    :param n_blocks: K ≥ 1, or ``None``
    :param parameterization: parameterization of rotations
    :param whiten: whether to whiten the algebra parameters over the batch
    :param layer_norm: whether to apply layer norm to the trunk's features
    :param center: whether to subtract their running mean before the layer norm; unused without layer norm. The agents of this
        package update that mean after each gradient step (``Centering.update``); others, such as SB3's, do not
    :param trunk_class: features extractor before the linear layer, or its name in ``TRUNKS``; ``None``: the
        paper's convolutions for images, also in dicts, SB3's extractor otherwise
    :param trunk_kwargs: its keyword arguments
    :param normalized_image: as in SB3's extractors: images are already floats; passed to the default trunk
    :param features_dim: size of the trunk's features, as in SB3's extractors; ``None``: the trunk's own default
    :raises ValueError: if the group is unknown or ``n_blocks`` is below 1
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        group: str | Group = DEFAULT_GROUP,
        n_blocks: int | None = None,
        parameterization: str = "euler",
        whiten: bool = False,
        layer_norm: bool = False,
        center: bool = False,
        trunk_class: str | type[BaseFeaturesExtractor] | None = None,
        trunk_kwargs: dict[str, Any] | None = None,
        normalized_image: bool = False,
        features_dim: int | None = None,
    ):
        super().__init__(observation_space, 1)  # the size is set below
        found = default_trunk(observation_space, normalized_image) if trunk_class is None else find_trunk(trunk_class)
        kwargs = {**(trunk_kwargs or {}), **({} if features_dim is None else {"features_dim": features_dim})}
        self.trunk = make_trunk(found, observation_space, kwargs, layer_norm, center, not normalized_image)
        self.group_layer = GroupLayer(self.trunk.features_dim, group, n_blocks, parameterization, whiten)
        self._features_dim = self.group_layer.state_dim

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """Map observations preprocessed by SB3, (B, ...) or a dict of these, to K flattened elements, (B, features_dim)."""
        return self.group_layer(self.trunk(observations))
