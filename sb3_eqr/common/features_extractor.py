"""The group encoder lives in :mod:`sb3_eqr.common.networks`; this is its old import path."""

from sb3_eqr.common.networks.encoders import GroupFeaturesExtractor

__all__ = ["GroupFeaturesExtractor"]
