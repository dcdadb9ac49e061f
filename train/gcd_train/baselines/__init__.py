"""What a model has to beat: predictors that learn nothing, or only means."""

from gcd_train.baselines.cameras import CameraPair
from gcd_train.baselines.copy_source import CopySource
from gcd_train.baselines.depth_reprojection import DepthReprojection
from gcd_train.baselines.ground_homography import GroundHomography
from gcd_train.baselines.majority_map import MajorityMap
from gcd_train.baselines.mean_target import MeanTarget
from gcd_train.baselines.predictor import Prediction, Predictor, SourceClip, to_pictures
from gcd_train.baselines.target_statistics import TargetStatistics, fit_statistics

__all__ = [
    "DEPTH_ON_MEAN",
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
    "all_baselines",
    "fit_statistics",
    "to_pictures",
]

DEPTH_ON_MEAN = "depth_reprojection_on_mean"
"""Depth reprojection with holes as in the mean target and the majority map."""


def all_baselines(statistics: TargetStatistics, classes: int) -> tuple[Predictor, ...]:
    """All of them; each finds the cameras in the clip.

    Args:
        statistics: of the training targets. classes: how many there are, 0 without an ontology.
    Returns:
        Copy, mean target, majority map (with an ontology), ground homography with holes as in the mean target, depth
        reprojection with holes in one colour, and the same with holes as in the mean target.
    """
    of_classes = () if statistics.majority is None else (MajorityMap(majority=statistics.majority),)
    return (
        CopySource(),
        MeanTarget(statistics=statistics),
        *of_classes,
        GroundHomography(fill=statistics),
        DepthReprojection(fill=statistics.constant, classes=classes),
        DepthReprojection(fill=statistics, classes=classes, name=DEPTH_ON_MEAN),
    )
