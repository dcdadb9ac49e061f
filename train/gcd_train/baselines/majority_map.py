"""The best class map for somebody who looks at nothing."""

from dataclasses import dataclass

from gcd_train.baselines.predictor import Prediction, SourceClip
from gcd_train.baselines.target_statistics import TargetStatistics


@dataclass(frozen=True, kw_only=True, slots=True)
class MajorityMap:
    """The commonest class of each pixel of each frame number among training targets, whatever the clip."""

    statistics: TargetStatistics
    name: str = "majority_map"
    privileged: bool = False

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor."""
        return Prediction(classes=self.statistics.majority)
