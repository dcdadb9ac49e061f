"""What a model has to beat: predictors that learn nothing, only means, or one scene; and what others have made."""

from gcd_train.baselines.cameras import CameraPair
from gcd_train.baselines.copy_source import CopySource
from gcd_train.baselines.depth_reprojection import DepthReprojection
from gcd_train.baselines.ground_homography import GroundHomography
from gcd_train.baselines.hexplane import HexPlane
from gcd_train.baselines.majority_map import MajorityMap
from gcd_train.baselines.mean_target import MeanTarget
from gcd_train.baselines.predictor import (
    OtherViews,
    Prediction,
    Predictor,
    SourceClip,
    SourcePoints,
    to_labels,
    to_pictures,
)
from gcd_train.baselines.published_reprojection import REPROJECT_RGBD, REPROJECT_SEMD, ReprojectRgbd, ReprojectSemd
from gcd_train.baselines.registry import (
    DEPTH_ON_MEAN,
    FROM_EXACT_CLASSES,
    HEXPLANE_VIEWS,
    BaselineSettings,
    ClassesAlone,
    baseline_names,
    build,
    described,
    usual_baselines,
)
from gcd_train.baselines.saved_frames import SavedFrames
from gcd_train.baselines.saved_layouts import SavedDraw, find_draws
from gcd_train.baselines.target_statistics import TargetStatistics, fit_statistics
from gcd_train.baselines.vanilla_svd import VANILLA_SVD, VanillaSVD

__all__ = [
    "DEPTH_ON_MEAN",
    "FROM_EXACT_CLASSES",
    "HEXPLANE_VIEWS",
    "REPROJECT_RGBD",
    "REPROJECT_SEMD",
    "VANILLA_SVD",
    "BaselineSettings",
    "CameraPair",
    "ClassesAlone",
    "CopySource",
    "DepthReprojection",
    "GroundHomography",
    "HexPlane",
    "MajorityMap",
    "MeanTarget",
    "OtherViews",
    "Prediction",
    "Predictor",
    "ReprojectRgbd",
    "ReprojectSemd",
    "SavedDraw",
    "SavedFrames",
    "SourceClip",
    "SourcePoints",
    "TargetStatistics",
    "VanillaSVD",
    "baseline_names",
    "build",
    "described",
    "find_draws",
    "fit_statistics",
    "to_labels",
    "to_pictures",
    "usual_baselines",
]
