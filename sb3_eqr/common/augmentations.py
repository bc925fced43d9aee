"""Image augmentation (paper §6.1 and Table 5): every image of the batch gets its own draw, from torch's generator."""

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, preprocess_obs
from torch.nn import functional as F

from sb3_eqr.common.type_aliases import PyTorchObs


def random_shift(images: th.Tensor, pad: int) -> th.Tensor:
    """
    Shift each image by up to ``pad`` pixels in each direction, repeating the edge (Yarats et al. 2021,
    https://arxiv.org/abs/2004.13649; padding and cropping in one gather, whatever the dtype).

    :param images: (B, C, H, W), any dtype
    :param pad: pixels, ≥ 0; Table 5 uses 4
    :return: same shape and dtype; images of bytes come channels-last
    """
    batch, channels, height, width = images.shape
    dy, dx = th.randint(-pad, pad + 1, (2, batch, 1), device=images.device)
    rows = (th.arange(height, device=images.device) + dy).clamp(0, height - 1)  # (B, H)
    columns = (th.arange(width, device=images.device) + dx).clamp(0, width - 1)  # (B, W)
    pixels = (rows[:, :, None] * width + columns[:, None, :]).view(batch, 1, -1)  # (B, 1, H * W)
    if images.dtype != th.uint8:
        return images.flatten(2).gather(2, pixels.expand(-1, channels, -1)).view_as(images)
    words = _packed(images)  # a quarter of the elements to move, and already in the layout of the convolutions
    shifted = words.gather(2, pixels.expand(-1, words.shape[1], -1))
    return _unpacked(shifted, images.shape)


def _packed(images: th.Tensor) -> th.Tensor:
    """
    Four channels in one word each; missing ones are 0.

    :param images: (B, C, H, W), uint8
    :return: (B, ⌈C / 4⌉, H * W), int32
    """
    missing = -images.shape[1] % 4
    if missing:
        images = F.pad(images, (0, 0, 0, 0, 0, missing))
    planes = images.flatten(2).unflatten(1, (-1, 4))  # (B, ⌈C / 4⌉, 4, H * W)
    words = planes[:, :, 0].int()
    for k in range(1, 4):
        words.add_(planes[:, :, k], alpha=1 << 8 * k)  # the lowest byte comes first in memory
    return words


def _unpacked(words: th.Tensor, shape: th.Size) -> th.Tensor:
    """
    :param words: (B, ⌈C / 4⌉, H * W), int32
    :param shape: (B, C, H, W)
    :return: uint8, channels-last
    """
    batch, channels, height, width = shape
    pixels = words.transpose(1, 2).reshape(batch, -1).view(th.uint8).view(batch, height, width, -1)  # (B, H, W, 4 * ⌈C / 4⌉)
    return pixels.permute(0, 3, 1, 2)[:, :channels]


def random_intensity(images: th.Tensor, scale: float) -> th.Tensor:
    """
    Multiply each image by 1 + scale · clip(ε, −2, 2), ε ~ N(0, 1) (Schwarzer et al. 2021, https://arxiv.org/abs/2007.05929).

    :param images: (B, C, H, W), uint8 or floating point
    :param scale: ≥ 0; Table 5 uses 0.05
    :return: same shape, float32 (or the images' own floating dtype), not clipped, channels-last
    """
    noise = th.randn(images.shape[0], 1, 1, 1, device=images.device).clamp_(-2.0, 2.0)
    dtype = images.dtype if images.is_floating_point() else th.float32
    # One pass makes them floats in the layout that the convolutions want, so that none has to copy them again.
    images = images.to(dtype, memory_format=th.channels_last, copy=True)
    return images.mul_(1.0 + scale * noise)


class ImageAugmentation:
    """
    What the networks see in an update: images shifted, then their intensity, then SB3's ``preprocess_obs``.

    :param observation_space: any that SB3 supports; of a dict, the parts that are images are augmented
    :param normalize_images: whether images are bytes, which SB3 divides by 255; else they are floats already
    :param shift_pixels: ≥ 0, 0 switches the shift off
    :param intensity_scale: ≥ 0, 0 switches the intensity off
    """

    def __init__(self, observation_space: spaces.Space, normalize_images: bool, shift_pixels: int, intensity_scale: float):
        is_dict = isinstance(observation_space, spaces.Dict)
        self._spaces = observation_space.spaces if is_dict else {"": observation_space}  # type: ignore[attr-defined]
        self.image_keys = [k for k, s in self._spaces.items() if is_image_space(s, normalized_image=not normalize_images)]
        self._normalize_images = normalize_images
        self.shift_pixels = shift_pixels
        self.intensity_scale = intensity_scale

    def __call__(self, observations: PyTorchObs) -> PyTorchObs:
        """
        :param observations: (B, *obs_shape), images (B, C, H, W), or a dict of these
        :return: floats, what a features extractor takes
        """
        if isinstance(observations, dict):
            return {key: self._part(key, obs) for key, obs in observations.items()}
        return self._part("", observations)

    def _part(self, key: str, observations: th.Tensor) -> th.Tensor:
        augmented = self.images(observations) if key in self.image_keys else observations
        if self._normalize_images and augmented.is_floating_point() and not observations.is_floating_point():
            return augmented.div_(255.0)  # as preprocess_obs does, but in place: no tensor of an update is larger
        return preprocess_obs(augmented, self._spaces[key], self._normalize_images)  # type: ignore[return-value]

    def images(self, images: th.Tensor) -> th.Tensor:
        """
        :param images: (B, C, H, W), uint8 or floating point
        :return: (B, C, H, W), floats unless the intensity is off
        """
        if self.shift_pixels > 0:
            images = random_shift(images, self.shift_pixels)
        return random_intensity(images, self.intensity_scale) if self.intensity_scale > 0 else images
