"""From stored observations to what networks take."""

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, preprocess_obs

from sb3_eqr.common.augmentations import random_intensity, random_shift
from sb3_eqr.common.type_aliases import PyTorchObs


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
        if key in self.image_keys:
            if self.shift_pixels > 0:
                observations = random_shift(observations, self.shift_pixels)
            if self.intensity_scale > 0:  # in one pass with the division that preprocess_obs makes: no tensor here is larger
                unit = 1 / 255 if self._normalize_images else 1.0
                return random_intensity(observations, self.intensity_scale, unit).float()
        return preprocess_obs(observations, self._spaces[key], self._normalize_images)  # type: ignore[return-value]
