"""The camera that does not move."""

from dataclasses import dataclass

from gcd_train.baselines.predictor import Prediction, SourceClip, to_labels, to_pictures


@dataclass(frozen=True, kw_only=True, slots=True)
class CopySource:
    """The source picture and its class map, as if they were the target's."""

    name: str = "copy_source"
    privileged: bool = False

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. The class map is the source's exact one."""
        return Prediction(video=to_pictures(clip.source), classes=to_labels(clip.source_classes))
