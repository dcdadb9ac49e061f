"""What a network looks like: frozen descriptions, one constant per named set-up.

These travel as JSON in the metadata of our own weight files, hence `msgspec.Struct`.
"""

from gcd_model.config.model import CAMERA_FEATURES, CameraControl, ModelConfig, Prediction
from gcd_model.config.networks import ImageEncoderConfig, SamplingConfig, UNetConfig, VAEConfig
from gcd_model.config.small_models import (
    DRIVING_CLASSES,
    DRIVING_SEMANTIC_SMALL,
    DRIVING_SMALL,
    OBJECTS_SMALL,
    PLAIN_SMALL,
    SMALL,
    SVD_14,
)
from gcd_model.config.switches import (
    ClassHeadConfig,
    PlaneMixConfig,
    PlaneWarpConfig,
    SemanticClass,
    WarpFrame,
    warp_channels,
)

__all__ = [
    "CAMERA_FEATURES",
    "DRIVING_CLASSES",
    "DRIVING_SEMANTIC_SMALL",
    "DRIVING_SMALL",
    "OBJECTS_SMALL",
    "PLAIN_SMALL",
    "SMALL",
    "SVD_14",
    "CameraControl",
    "ClassHeadConfig",
    "ImageEncoderConfig",
    "ModelConfig",
    "PlaneMixConfig",
    "PlaneWarpConfig",
    "Prediction",
    "SamplingConfig",
    "SemanticClass",
    "UNetConfig",
    "VAEConfig",
    "WarpFrame",
    "warp_channels",
]
