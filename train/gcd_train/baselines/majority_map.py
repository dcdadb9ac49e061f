"""The best class map for somebody who looks at nothing."""

from dataclasses import dataclass

from torch import Tensor

from gcd_train.baselines.predictor import Prediction, SourceClip


@dataclass(frozen=True, kw_only=True, slots=True)
class MajorityMap:
    """The commonest class of each pixel of each frame number among training targets, whatever the clip.

    majority: uint8 [T, H, W].
    """

    majority: Tensor
    name: str = "majority_map"
    privileged: bool = False

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor."""
        return Prediction(classes=self.majority)
