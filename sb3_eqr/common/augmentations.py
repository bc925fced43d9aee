"""Image augmentation (paper §6.1 and Table 5): every image of the batch gets its own draw, from torch's generator."""

import torch as th

from sb3_eqr.common.type_aliases import PyTorchObs


def random_shift(images: th.Tensor, pad: int) -> th.Tensor:
    """
    Shift each image by up to ``pad`` pixels in each direction, repeating the edge (Yarats et al. 2021,
    https://arxiv.org/abs/2004.13649; padding and cropping in one gather, whatever the dtype).

    :param images: (B, C, H, W), any dtype
    :param pad: pixels, ≥ 0; Table 5 uses 4
    :return: same shape and dtype
    """
    batch, channels, height, width = images.shape
    dy, dx = th.randint(-pad, pad + 1, (2, batch, 1), device=images.device)
    rows = (th.arange(height, device=images.device) + dy).clamp(0, height - 1)  # (B, H)
    columns = (th.arange(width, device=images.device) + dx).clamp(0, width - 1)  # (B, W)
    pixels = (rows[:, :, None] * width + columns[:, None, :]).view(batch, 1, -1)  # (B, 1, H * W)
    return images.flatten(2).gather(2, pixels.expand(-1, channels, -1)).view_as(images)


def random_intensity(images: th.Tensor, scale: float) -> th.Tensor:
    """
    Multiply each image by 1 + scale · clip(ε, −2, 2), ε ~ N(0, 1) (Schwarzer et al. 2021, https://arxiv.org/abs/2007.05929).

    :param images: (B, C, H, W), uint8 or floating point
    :param scale: ≥ 0; Table 5 uses 0.05
    :return: same shape, float32 (or the images' own floating dtype), not clipped
    """
    noise = th.randn(images.shape[0], 1, 1, 1, device=images.device).clamp_(-2.0, 2.0)
    dtype = images.dtype if images.is_floating_point() else th.float32
    # One pass makes them floats in the layout that the convolutions want, so that none has to copy them again.
    images = images.to(dtype, memory_format=th.channels_last, copy=True)
    return images.mul_(1.0 + scale * noise)


class ImageAugmentation:
    """
    Shift, then intensity, on those parts of an observation that are images.

    :param image_keys: keys of a dict observation that are images; for a plain observation, any key says that it is one
    :param shift_pixels: ≥ 0, 0 switches the shift off
    :param intensity_scale: ≥ 0, 0 switches the intensity off
    """

    def __init__(self, image_keys: list[str], shift_pixels: int, intensity_scale: float):
        self.image_keys = image_keys
        self.shift_pixels = shift_pixels
        self.intensity_scale = intensity_scale

    def __call__(self, observations: PyTorchObs) -> PyTorchObs:
        """
        :param observations: (B, *obs_shape), images (B, C, H, W), or a dict of these
        :return: the same shapes; images are floats unless the intensity is off
        """
        if isinstance(observations, dict):
            return {key: self.images(obs) if key in self.image_keys else obs for key, obs in observations.items()}
        return self.images(observations) if self.image_keys else observations

    def images(self, images: th.Tensor) -> th.Tensor:
        """
        :param images: (B, C, H, W)
        :return: (B, C, H, W)
        """
        if self.shift_pixels > 0:
            images = random_shift(images, self.shift_pixels)
        return random_intensity(images, self.intensity_scale) if self.intensity_scale > 0 else images
