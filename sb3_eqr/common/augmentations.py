"""Image augmentation (paper §6.1 and Table 5), drawn independently for each image of the batch, from torch's generator."""

import torch as th
from torch.nn import functional as F


def random_shift(images: th.Tensor, pad: int) -> th.Tensor:
    """
    Shift each image by up to ``pad`` pixels in each direction, repeating the edge pixels (Yarats et al. 2021,
    https://arxiv.org/abs/2004.13649; pads and crops in one gather, for any dtype).

    :param images: (B, C, H, W), any dtype
    :param pad: maximum shift in pixels, ≥ 0; Table 5 uses 4
    :return: same shape and dtype; uint8 images are returned channels-last
    """
    batch, channels, height, width = images.shape
    dy, dx = th.randint(-pad, pad + 1, (2, batch, 1), device=images.device)
    rows = (th.arange(height, device=images.device) + dy).clamp(0, height - 1)  # (B, H)
    columns = (th.arange(width, device=images.device) + dx).clamp(0, width - 1)  # (B, W)
    # Move bytes four at a time: a quarter of the elements, and the result has the layout that the convolutions need.
    planes = _packed(images) if images.dtype == th.uint8 else images  # (B, planes, H, W)
    n_planes = planes.shape[1]
    every = th.arange(batch * n_planes, device=images.device).view(batch, n_planes, 1)
    lines = planes.reshape(-1, width).index_select(0, (every * height + rows[:, None]).flatten())  # full rows copy fast
    shifted = lines.view(planes.shape).gather(3, columns[:, None, None].expand_as(planes))
    return _unpacked(shifted, channels) if images.dtype == th.uint8 else shifted


def _packed(images: th.Tensor) -> th.Tensor:
    """
    Pack four channels into one word each; missing channels are 0.

    :param images: (B, C, H, W), uint8
    :return: (B, ⌈C / 4⌉, H, W), int32
    """
    missing = -images.shape[1] % 4
    if missing:
        images = F.pad(images, (0, 0, 0, 0, 0, missing))
    planes = images.unflatten(1, (-1, 4))  # (B, ⌈C / 4⌉, 4, H, W)
    words = planes[:, :, 0].int()
    for k in range(1, 4):
        words.add_(planes[:, :, k], alpha=1 << 8 * k)  # the lowest byte comes first in memory
    return words


def _unpacked(words: th.Tensor, channels: int) -> th.Tensor:
    """
    :param words: (B, ⌈C / 4⌉, H, W), int32
    :param channels: C
    :return: (B, C, H, W), uint8, channels-last
    """
    batch, _, height, width = words.shape
    pixels = words.permute(0, 2, 3, 1).reshape(batch, -1).view(th.uint8).view(batch, height, width, -1)
    return pixels.permute(0, 3, 1, 2)[:, :channels]


def random_intensity(images: th.Tensor, scale: float, unit: float = 1.0, dtype: th.dtype = th.float32) -> th.Tensor:
    """
    Multiply each image by 1 + scale · clip(ε, −2, 2), ε ~ N(0, 1) (Schwarzer et al. 2021, https://arxiv.org/abs/2007.05929).

    :param images: (B, C, H, W), uint8 or floating point
    :param scale: ≥ 0; Table 5 uses 0.05
    :param unit: additional constant factor; 1/255 maps bytes to [0, 1]
    :param dtype: of the result
    :return: same shape, not clipped, channels-last
    """
    noise = th.randn(images.shape[0], 1, 1, 1, device=images.device).clamp_(-2.0, 2.0)
    # Convert to floats in the layout of the convolutions in one pass, so that they need not copy the images again.
    images = images.to(dtype, memory_format=th.channels_last, copy=True)
    return images.mul_((unit * (1.0 + scale * noise)).to(dtype))
