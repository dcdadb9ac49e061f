"""The best picture for somebody who looks at nothing."""

from dataclasses import dataclass

from gcd_train.baselines.predictor import Prediction, SourceClip
from gcd_train.baselines.target_statistics import TargetStatistics


@dataclass(frozen=True, kw_only=True, slots=True)
class MeanTarget:
    """The mean training target of each frame number, whatever the clip."""

    statistics: TargetStatistics
    name: str = "mean_target"
    privileged: bool = False

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor."""
        return Prediction(video=self.statistics.mean)
