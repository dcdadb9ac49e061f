"""What our small models are meant to reach on held-out scenes, and whether they do."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from gcd_model.config import CameraControl
from gcd_train.baselines import DEPTH_ON_MEAN
from gcd_train.evaluation.figures import Evaluation, lead

PSNR_OVER_DEPTH_DB, PSNR_OVER_COPY_DB, PSNR_OVER_HOMOGRAPHY_DB = 3.0, 2.0, 0.5
LEAST_GRADIENT, MOST_GRADIENT, MOST_FLICKER = 0.6, 1.4, 1.0
LEAST_MIOU = 0.58
LEAST_CLASS_IOU = {"car": 0.5, "person": 0.15}


@dataclass(frozen=True, kw_only=True, slots=True)
class Bar:
    """One thing to be reached: `least <= value <= most`.

    value: NaN where it could not be measured. error: its standard error over scenes; NaN where that is not known.
    strict: whether `least` itself is too little.
    """

    name: str
    value: float
    error: float
    least: float = -math.inf
    most: float = math.inf
    strict: bool = False

    @property
    def margin(self) -> float:
        """How far the value lies inside the bounds, negative outside; NaN for a value that is NaN."""
        return min(self.value - self.least, self.most - self.value) if not math.isnan(self.value) else math.nan

    @property
    def reached(self) -> bool:
        """Whether the value lies within the bounds."""
        return self.margin > 0.0 or (self.margin == 0.0 and not self.strict)

    def __str__(self) -> str:
        if math.isnan(self.value):
            return f"{self.name}: nothing to measure, wanted {self._wanted}: **missed**"
        error = "" if math.isnan(self.error) else f" ± {round(self.error, 3):.2g}"
        value = f"{round(self.value, 3):.3g}{error}"
        outcome = f"reached by {self.margin:.2g}" if self.reached else f"**missed** by {-self.margin:.2g}"
        return f"{self.name}: {value}, wanted {self._wanted}: {outcome}"

    @property
    def _wanted(self) -> str:
        bounds = [f"more than {self.least:g}" if self.strict else f"{self.least:g} or more"] * math.isfinite(self.least)
        return ", ".join([*bounds, *[f"{self.most:g} or less"] * math.isfinite(self.most)])


def bars(
    model: Evaluation, others: Sequence[Evaluation], *, classes: Sequence[str], camera: CameraControl
) -> tuple[Bar, ...]:
    """What the model is meant to reach; bars against a baseline only where that was measured.

    Args:
        model: with the settings that ship. others: among them the baselines, by name.
        classes: names of the ontology, in the order of the figures. camera: control of the clips.
    """
    rivals = {each.name: each for each in others}
    found: list[Bar] = []
    if not math.isnan(model.total.psnr_db):
        found += _driving_picture(model, rivals) if camera == "none" else _orbit_picture(model, rivals)
    if not math.isnan(model.total.miou):
        found += _class_map(model, rivals, classes)
    return tuple(found)


def _driving_picture(model: Evaluation, rivals: dict[str, Evaluation]) -> Iterator[Bar]:
    yield from _psnr_over(model, rivals, "depth_reprojection", PSNR_OVER_DEPTH_DB)
    yield _gradient(model)
    yield Bar(name="flicker", value=model.total.flicker, error=model.error.flicker, most=MOST_FLICKER)


def _orbit_picture(model: Evaluation, rivals: dict[str, Evaluation]) -> Iterator[Bar]:
    yield from _psnr_over(model, rivals, "copy_source", PSNR_OVER_COPY_DB)
    yield from _psnr_over(model, rivals, "ground_homography", PSNR_OVER_HOMOGRAPHY_DB)
    yield _gradient(model)


def _psnr_over(model: Evaluation, rivals: dict[str, Evaluation], rival: str, least_db: float) -> Iterator[Bar]:
    if rival in rivals:
        ahead, error = lead(model, rivals[rival], lambda of: of.psnr_db)
        yield Bar(name=f"PSNR over {rival}, dB", value=ahead, error=error, least=least_db)


def _gradient(model: Evaluation) -> Bar:
    value, error = model.total.gradient_energy, model.error.gradient_energy
    return Bar(name="gradient energy", value=value, error=error, least=LEAST_GRADIENT, most=MOST_GRADIENT)


def _class_map(model: Evaluation, rivals: dict[str, Evaluation], classes: Sequence[str]) -> Iterator[Bar]:
    yield Bar(name="mIoU", value=model.total.miou, error=model.error.miou, least=LEAST_MIOU)
    if DEPTH_ON_MEAN in rivals:
        ahead, error = lead(model, rivals[DEPTH_ON_MEAN], lambda of: of.miou)
        yield Bar(name=f"mIoU over {DEPTH_ON_MEAN}", value=ahead, error=error, least=0.0, strict=True)
    for name, least in LEAST_CLASS_IOU.items():
        if name in classes:
            label = classes.index(name)
            value, error = model.total.class_iou[label], model.error.class_iou[label]
            yield Bar(name=f"IoU of {name}", value=value, error=error, least=least)
