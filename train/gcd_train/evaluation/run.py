"""Methods on held-out clips, one clip after the other."""

import time
from collections.abc import Callable, Sequence

from gcd_model.config import SemanticClass
from gcd_train.baselines import Prediction, Predictor
from gcd_train.errors import DataError
from gcd_train.evaluation.clips import EvaluationSet, HeldOutClip
from gcd_train.evaluation.figures import Evaluation, summed_up
from gcd_train.evaluation.measured import measure
from gcd_train.evaluation.record import ClipRecord
from gcd_train.evaluation.tallies import FIRST_MEASURED, MAIN, Selection
from gcd_train.metrics import Lpips, void_ids


def predicted_and_measured(
    predictor: Predictor, clip: HeldOutClip, *, classes: Sequence[SemanticClass], lpips: Lpips | None = None
) -> tuple[Prediction, ClipRecord]:
    """What a method makes of a clip, and the record of that.

    Args:
        classes: the ontology, empty for none. lpips: None for no such figure.
    Raises: what the method raises; ShapeError, NonFiniteError: see `measure`.
    """
    start = time.perf_counter()
    prediction = predictor.predict(clip.seen)
    seconds = time.perf_counter() - start
    record = measure(
        clip,
        prediction,
        method=predictor.name,
        privileged=predictor.privileged,
        seconds=seconds,
        classes=len(classes),
        void=void_ids([each.name for each in classes]),
        lpips=lpips,
    )
    return prediction, record


def evaluate(
    predictors: Sequence[Predictor],
    clips: EvaluationSet,
    *,
    selection: Selection = MAIN,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Evaluation, ...]:
    """Every method on the same clips, each read once; nothing is kept but the figures.

    Args:
        selection: frames and pixels that the figures are of. progress: called with (clips done, clips).
    Raises:
        DataError: there is no clip, a clip has no frame to measure, or one cannot be read.
    """
    require_measurable(clips)
    records: list[list[ClipRecord]] = [[] for _ in predictors]
    for done, key in enumerate(clips.keys, start=1):
        clip = clips.clip(key)
        for rows, predictor in zip(records, predictors, strict=True):
            rows.append(predicted_and_measured(predictor, clip, classes=clips.classes)[1])
        if progress is not None:
            progress(done, len(clips.keys))
    return tuple(summed_up(rows, selection, classes=len(clips.classes)) for rows in records)


def require_measurable(clips: EvaluationSet) -> None:
    """Raises DataError where there is no clip, or none has a change between two measured frames."""
    if not clips.keys or clips.frames <= FIRST_MEASURED + 1:
        raise DataError(
            f"evaluation wants a clip of 3 frames or more, got {len(clips.keys)} of {clips.frames}; generate some"
        )
