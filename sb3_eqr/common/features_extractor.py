"""The old import path of :mod:`sb3_eqr.common.networks.encoders`, kept for YAML files that use it."""

from sb3_eqr.common.networks.encoders import ConvExtractor, GroupFeaturesExtractor, ImpalaExtractor

__all__ = ["ConvExtractor", "GroupFeaturesExtractor", "ImpalaExtractor"]
