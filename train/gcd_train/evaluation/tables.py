"""A report as Markdown: what was measured, steps against steps, classes, scenes."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from gcd_train.baselines import FROM_EXACT_CLASSES
from gcd_train.evaluation.figures import Evaluation, Figures, lead
from gcd_train.evaluation.report import Report, best_of


@dataclass(frozen=True, kw_only=True, slots=True)
class _Column:
    """One figure as a column. full: the same at picture size, shown in brackets. of_classes: of class maps."""

    heading: str
    figure: Callable[[Figures], float]
    digits: int
    full: Callable[[Figures], float] | None = None
    of_classes: bool = False

    def cell(self, each: Evaluation) -> str:
        text = _with_error(self.figure(each.total), self.figure(each.error), self.digits)
        full = math.nan if self.full is None else self.full(each.total)
        text = text if math.isnan(full) else f"{text} ({full:.{self.digits}f})"
        return f"{text} *" if self.of_classes and text != "-" and each.name in FROM_EXACT_CLASSES else text

    def ahead(self, first: Evaluation, other: Evaluation) -> str:
        return "-" if first is other else _with_error(*lead(first, other, self.figure), self.digits)


_PSNR = _Column(heading="PSNR dB", figure=lambda f: f.psnr_db, digits=2)
_SSIM = _Column(heading="SSIM", figure=lambda f: f.ssim, digits=3)
_MIOU = _Column(heading="mIoU", figure=lambda f: f.miou, digits=3, full=lambda f: f.miou_full, of_classes=True)
_COLUMNS = (
    _PSNR,
    _Column(heading="last frame", figure=lambda f: f.last_psnr_db, digits=2),
    _SSIM,
    _Column(heading="LPIPS", figure=lambda f: f.lpips, digits=3),
    _Column(heading="diversity", figure=lambda f: f.diversity, digits=3),
    _Column(heading="gradient energy", figure=lambda f: f.gradient_energy, digits=2),
    _Column(heading="flicker", figure=lambda f: f.flicker, digits=2),
    _MIOU,
    _Column(heading="accuracy", figure=lambda f: f.accuracy, digits=3, of_classes=True),
)


def to_markdown(report: Report) -> str:
    """All tables; what nobody has is left out."""
    parts = [_conditions(report), _predictors(report.evaluations)]
    if len(report.model) > 1:
        parts.append(_steps(report))
    if any(not math.isnan(each.total.miou) for each in report.evaluations):
        parts.append(_classes(report))
    if report.model:
        parts.append(_clips(report))
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def _conditions(report: Report) -> list[str]:
    given, shots = report.conditions, report.conditions.shots
    scenes = len({(shot.world, shot.scene) for shot in shots})
    folders = ", ".join(f"`{folder}`" for folder in given.data)
    lines = [
        f"{len(shots)} clips of {scenes} scenes in {folders}, frames {given.first_frame}-{given.frames}; value ± "
        "standard error over scenes. * is given more than the source video."
    ]
    if given.weights is not None:
        steps, samples = _counted(given.steps or 0, "step"), _counted(given.samples, "sample")
        lines.append(f"`{given.weights}` as it ships: {steps} of its sampler, {samples}.")
    if given.true_mount is not None:
        lines.append(f"Source camera at {given.true_mount}; declared: {given.declared_mount}.")
    if report.classes:
        height, width = given.grid
        lines.append(f"Class figures at {width}x{height}, in brackets at picture size.")
    totals = [each.total for each in report.evaluations]
    if all(math.isnan(each.lpips) for each in totals) and any(not math.isnan(each.psnr_db) for each in totals):
        lines.append("LPIPS: no weights given (`--lpips`).")
    return lines


def _predictors(evaluations: Sequence[Evaluation]) -> list[str]:
    first = evaluations[0]
    columns = [each for each in _COLUMNS if not all(math.isnan(each.figure(row.total)) for row in evaluations)]
    ahead = [each for each in (_PSNR, _MIOU) if not math.isnan(each.figure(first.total))]
    rows = [
        [
            each.name + (" *" if each.privileged else ""),
            *(column.cell(each) for column in columns),
            *(column.ahead(first, each) for column in ahead),
            f"{each.seconds_per_clip:.2f}",
        ]
        for each in evaluations
    ]
    headings = [*(each.heading for each in columns), *(f"first row ahead, {each.heading}" for each in ahead), "s/clip"]
    return _table(["", *headings], rows)


def _steps(report: Report) -> list[str]:
    shipped, *others = report.model
    return ["The steps that ship against others, on the same clips:", "", *(_against(shipped, each) for each in others)]


def _against(shipped: Evaluation, other: Evaluation) -> str:
    told = [
        f"{column.heading} {_with_error(*lead(shipped, other, column.figure), column.digits, sign='+')}"
        for column in (_PSNR, _SSIM, _MIOU)
        if not math.isnan(column.figure(shipped.total))
    ]
    return f"- over {other.name}: {', '.join(told)}"


def _classes(report: Report) -> list[str]:
    shown = [each for each in report.evaluations if not math.isnan(each.total.miou)]

    def cell(each: Evaluation, label: int) -> str:
        iou, full = each.total.class_iou[label], each.total.class_iou_full[label]
        shown = tuple("-" if math.isnan(value) else f"{value:.2f}" for value in (iou, full))
        return "-" if shown == ("-", "-") else f"{shown[0]} ({shown[1]})"

    every = [[name, *(cell(each, i) for each in shown)] for i, name in enumerate(report.classes)]
    rows = [row for row in every if set(row[1:]) != {"-"}]  # a class that nobody saw or said, as void
    return ["IoU of each class:", "", *_table(["class", *(each.name for each in shown)], rows)]


def _clips(report: Report) -> list[str]:
    """Every clip by name, and where the model is ahead of the best baseline and where not."""
    headings, columns = ["clip"], list[list[str]]()
    for heading, column in _clip_columns(report):
        headings.append(heading)
        columns.append(column)
    names = [str(shot) for shot in report.conditions.shots]
    return ["Clips:", "", *_table(headings, [list(row) for row in zip(names, *columns, strict=True)])]


def _clip_columns(report: Report) -> Iterator[tuple[str, list[str]]]:
    model = report.model[0]
    for column in (_PSNR, _MIOU):
        if math.isnan(column.figure(model.total)):
            continue
        own = [column.figure(each) for each in model.clips]
        yield column.heading, [_with_error(value, math.nan, column.digits) for value in own]
        best = best_of(report.baselines, column.figure)
        if best is not None:
            apart = [value - column.figure(each) for value, each in zip(own, best.clips, strict=True)]
            yield f"over {best.name}", [_with_error(value, math.nan, column.digits, sign="+") for value in apart]


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _with_error(value: float, error: float, digits: int, sign: str = "") -> str:
    if math.isnan(value):
        return "-"
    return f"{value:{sign}.{digits}f}" + ("" if math.isnan(error) else f" ± {error:.{digits}f}")


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    rule = ["---"] * len(headings)
    return [f"| {' | '.join(cells)} |" for cells in (headings, rule, *rows)]
