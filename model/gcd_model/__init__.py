"""Generative Camera Dolly: a video in, the same moments from another camera out. Tensors in, tensors out.

    synthesizer = load_synthesizer("kubric_gradual_max90.ckpt")
    trajectory = synthesizer.traits.plan_view(SphericalDelta(azimuth_deg=30.0, elevation_deg=15.0))
    [view] = synthesizer.render(synthesizer.encode(Clip(video=video, fps=12.0)), [trajectory])

The node imports from here only. Source: Van Hoorick et al., "Generative Camera Dolly", ECCV 2024.
"""

from gcd_model.clip import Augmentation, Clip, View, hatched
from gcd_model.conditioning import SourceFeatures
from gcd_model.diffusion import RenderOptions, Sampler
from gcd_model.engines.onnx_export import is_export
from gcd_model.errors import (
    AlignmentError,
    Cancelled,
    CheckpointError,
    DeviceMemoryError,
    FileError,
    ModelError,
    NonFiniteError,
    OptionError,
    PoseError,
    ViewFixedError,
    ViewRangeError,
)
from gcd_model.geometry import (
    CameraMount,
    Intrinsics,
    Orbit,
    Spherical,
    SphericalDelta,
    Trajectory,
    center_crop_box,
    invert_rigid,
    nearest_delta,
)
from gcd_model.live.alignment import (
    Alignment,
    CameraMove,
    Features,
    Landmarks,
    align,
    features,
    landmarks,
    landmarks_of,
)
from gcd_model.live.ego_motion import require_motion
from gcd_model.live.eyes import PlacedFrame, SeenFrame
from gcd_model.live.grid import Grid, GridMapper
from gcd_model.live.synthesizer import visibility_of
from gcd_model.loading import export_weights, load_synthesizer, placement, weights_path
from gcd_model.small_files import decode_toml, explain_settings_error, printable, read_json, read_small
from gcd_model.synthesizer import FrameSynthesizer, ViewSynthesizer
from gcd_model.traits import Traits
from gcd_model.weights.card import Card
from gcd_model.weights.load import WeightsReport, convert_weights, inspect_weights

__all__ = [
    "Alignment",
    "AlignmentError",
    "Augmentation",
    "CameraMount",
    "CameraMove",
    "Cancelled",
    "Card",
    "CheckpointError",
    "Clip",
    "DeviceMemoryError",
    "Features",
    "FileError",
    "FrameSynthesizer",
    "Grid",
    "GridMapper",
    "Intrinsics",
    "Landmarks",
    "ModelError",
    "NonFiniteError",
    "OptionError",
    "Orbit",
    "PlacedFrame",
    "PoseError",
    "RenderOptions",
    "Sampler",
    "SeenFrame",
    "SourceFeatures",
    "Spherical",
    "SphericalDelta",
    "Traits",
    "Trajectory",
    "View",
    "ViewFixedError",
    "ViewRangeError",
    "ViewSynthesizer",
    "WeightsReport",
    "align",
    "center_crop_box",
    "convert_weights",
    "decode_toml",
    "explain_settings_error",
    "export_weights",
    "features",
    "hatched",
    "inspect_weights",
    "invert_rigid",
    "is_export",
    "landmarks",
    "landmarks_of",
    "load_synthesizer",
    "nearest_delta",
    "placement",
    "printable",
    "read_json",
    "read_small",
    "require_motion",
    "visibility_of",
    "weights_path",
]
