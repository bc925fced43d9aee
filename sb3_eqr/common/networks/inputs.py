"""Observations as inputs of networks in an update."""

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, preprocess_obs

from sb3_eqr.common.augmentations import random_intensity, random_shift
from sb3_eqr.common.type_aliases import PyTorchObs


def keys_of(observation_space: spaces.Space) -> str:
    """The keys of a dict of observations, in the order in which they are concatenated; "" for other spaces."""
    return ", ".join(observation_space.spaces) if isinstance(observation_space, spaces.Dict) else ""


class Augmentation:
    """
    Prepare observations for the networks in an update: shift images (also those in a dict), scale their intensity, then apply
    SB3's ``preprocess_obs``.

    :param observation_space: of the observations
    :param normalize_images: whether images are bytes, which SB3 divides by 255, or already floats
    :param shift_pixels: maximum shift, ≥ 0, but at most one for each ``SIDE_PER_PIXEL`` pixels of the smaller side: a shift
        by 4 would move most of an image of 7×7 out of sight
    :param intensity_scale: of the random intensity, ≥ 0
    """

    SIDE_PER_PIXEL = 16  # Table 5 has 4 for 84 pixels, one for each 21

    def __init__(self, observation_space: spaces.Space, normalize_images: bool, shift_pixels: int, intensity_scale: float):
        is_dict = isinstance(observation_space, spaces.Dict)
        self._spaces = observation_space.spaces if is_dict else {"": observation_space}  # type: ignore[attr-defined]
        self.image_keys = [k for k, s in self._spaces.items() if is_image_space(s, normalized_image=not normalize_images)]
        self.plain_spaces = {key: s for key, s in self._spaces.items() if key not in self.image_keys}
        self._normalize_images = normalize_images
        sides = {key: min(self._spaces[key].shape[-2:]) for key in self.image_keys}  # type: ignore[index]
        self.shifts = {key: min(shift_pixels, side // self.SIDE_PER_PIXEL) for key, side in sides.items()}
        self.intensity_scale = intensity_scale

    def __call__(self, observations: PyTorchObs, dtype: th.dtype = th.float32) -> PyTorchObs:
        """
        Map observations, (B, *obs_shape) or a dict of these, to floats for a features extractor; ``dtype`` is that of images.
        """
        if isinstance(observations, dict):
            return {key: self._part(key, obs, dtype) for key, obs in observations.items()}
        return self._part("", observations, dtype)

    def _part(self, key: str, observations: th.Tensor, dtype: th.dtype) -> th.Tensor:
        if key in self.image_keys:
            if self.shifts[key] > 0:
                observations = random_shift(observations, self.shifts[key])
            if self.intensity_scale > 0:  # in one pass with the division of preprocess_obs: this is the largest tensor
                unit = 1 / 255 if self._normalize_images else 1.0
                return random_intensity(observations, self.intensity_scale, unit, dtype)
            if self._normalize_images:
                return observations.to(dtype) / 255  # as preprocess_obs, in one pass
        return preprocess_obs(observations, self._spaces[key], self._normalize_images)  # type: ignore[return-value]
