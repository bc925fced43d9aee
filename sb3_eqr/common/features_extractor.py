"""The encoders live in :mod:`sb3_eqr.common.networks.encoders`; this is their old import path, which YAML files use."""

from sb3_eqr.common.networks.encoders import ConvExtractor, GroupFeaturesExtractor, ImpalaExtractor

__all__ = ["ConvExtractor", "GroupFeaturesExtractor", "ImpalaExtractor"]
