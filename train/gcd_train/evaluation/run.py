"""Predictors on held-out clips, one clip after the other."""

import time
from collections.abc import Callable, Sequence

from gcd_model.geometry import CameraMount
from gcd_train.baselines import Predictor
from gcd_train.errors import DataError
from gcd_train.evaluation.figures import Evaluation, summed_up
from gcd_train.evaluation.held_out import HeldOutClips, class_grid, source_side
from gcd_train.evaluation.measures import FIRST_MEASURED, Measures, TrueView, measure


def evaluate(
    predictors: Sequence[Predictor],
    clips: HeldOutClips,
    *,
    declared: CameraMount | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Evaluation, ...]:
    """Every predictor on the same clips, each read once.

    Args:
        declared: mount that all predictors are told for the source camera of driving clips; None for the true one.
        progress: called with (clips done, clips).
    Raises:
        DataError: there is no clip, or a clip has no frame to measure.
    """
    count, classes, grid = len(clips), len(clips.classes), class_grid(clips)
    if count < 1 or clips.frames <= FIRST_MEASURED + 1:
        raise DataError(f"evaluation wants a clip of 3 frames or more, got {count} of {clips.frames}; generate some")
    measured: list[list[Measures]] = [[] for _ in predictors]
    seconds = [0.0] * len(predictors)
    for number in range(count):
        clip = clips[number]
        seen, true = source_side(clips, number, clip, declared), TrueView.of(clip, grid=grid, classes=classes)
        for place, predictor in enumerate(predictors):
            start = time.perf_counter()
            prediction = predictor.predict(seen)
            seconds[place] += time.perf_counter() - start
            measured[place].append(measure(prediction, true, classes=classes))
        if progress is not None:
            progress(number + 1, count)
    scenes = [clips.scene(number) for number in range(count)]
    return tuple(
        summed_up(predictor.name, each, scenes, seconds=spent, privileged=predictor.privileged)
        for predictor, each, spent in zip(predictors, measured, seconds, strict=True)
    )
