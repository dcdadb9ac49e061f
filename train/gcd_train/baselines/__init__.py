"""What a model has to beat: predictors that learn nothing, or only means."""

from gcd_model.geometry import CameraMount
from gcd_train.baselines.cameras import CameraPair
from gcd_train.baselines.copy_source import CopySource
from gcd_train.baselines.depth_reprojection import DepthReprojection
from gcd_train.baselines.ground_homography import GroundHomography
from gcd_train.baselines.majority_map import MajorityMap
from gcd_train.baselines.mean_target import MeanTarget
from gcd_train.baselines.predictor import Prediction, Predictor, SourceClip, to_pictures
from gcd_train.baselines.target_statistics import TargetStatistics, fit_statistics

__all__ = [
    "CameraPair",
    "CopySource",
    "DepthReprojection",
    "GroundHomography",
    "MajorityMap",
    "MeanTarget",
    "Prediction",
    "Predictor",
    "SourceClip",
    "TargetStatistics",
    "driving_baselines",
    "fit_statistics",
    "to_pictures",
]


def driving_baselines(statistics: TargetStatistics, mount: CameraMount, classes: int) -> tuple[Predictor, ...]:
    """All of them, for driving clips.

    Args:
        statistics: of the training targets. mount: declared for the source camera. classes: how many there are.
    Returns:
        Copy, mean target, majority map, ground homography with holes as in the mean target, depth reprojection with
        holes in one colour, and the same with holes as in the mean target.
    """
    frames, _, height, width = statistics.mean.shape
    cameras = CameraPair.driving(mount, frames=frames, height=height, width=width)
    return (
        CopySource(),
        MeanTarget(statistics=statistics),
        MajorityMap(statistics=statistics),
        GroundHomography(cameras=cameras, fill=statistics),
        DepthReprojection(cameras=cameras, fill=statistics.constant, classes=classes),
        DepthReprojection(cameras=cameras, fill=statistics, classes=classes, name="depth_reprojection_on_mean"),
    )
