"""What a network looks like: frozen descriptions, one constant per named set-up.

These travel as JSON in the metadata of our own weight files, hence `msgspec.Struct`.
"""

from gcd_model.config.model import (
    CAMERA_FEATURES,
    CameraControl,
    ModelConfig,
    Prediction,
    SemanticClass,
    require_ontology,
)
from gcd_model.config.networks import ImageEncoderConfig, SamplingConfig, UNetConfig, VAEConfig
from gcd_model.config.small_models import DRIVING_CLASSES, PLAIN_SMALL, SMALL, SVD_14

__all__ = [
    "CAMERA_FEATURES",
    "DRIVING_CLASSES",
    "PLAIN_SMALL",
    "SMALL",
    "SVD_14",
    "CameraControl",
    "ImageEncoderConfig",
    "ModelConfig",
    "Prediction",
    "SamplingConfig",
    "SemanticClass",
    "UNetConfig",
    "VAEConfig",
    "require_ontology",
]
