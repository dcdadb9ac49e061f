"""What the main tables leave out: visible pixels beside occluded ones, diversity, sharpness, and frame by frame."""

import numpy as np

from gcd_train.evaluation.tallies import FIRST_MEASURED, FigureName, Selection, Span
from gcd_train.reports.figure_tables import Measured, frames_told, measured_row, table_notes
from gcd_train.reports.material import EvaluatedSet
from gcd_train.reports.paper import Column, PaperRow
from gcd_train.reports.table import Table, csv_text

_COLUMNS = (
    Column(heading="PSNR all", figure="psnr_db"),
    Column(heading="PSNR visible", figure="psnr_db", region="visible"),
    Column(heading="PSNR occluded", figure="psnr_db", region="occluded"),
    Column(heading="SSIM all", figure="ssim", digits=3),
    Column(heading="SSIM visible", figure="ssim", region="visible", digits=3),
    Column(heading="SSIM occluded", figure="ssim", region="occluded", digits=3),
    Column(heading="mIoU all", figure="miou_common", digits=3),
    Column(heading="mIoU visible", figure="miou_common", region="visible", digits=3),
    Column(heading="mIoU occluded", figure="miou_common", region="occluded", digits=3),
    Column(heading="diversity", figure="diversity", digits=4),
    Column(heading="gradient energy", figure="gradient_energy"),
)
_BY_FRAME: tuple[FigureName, ...] = (
    "psnr_db",
    "ssim",
    "lpips",
    "diversity",
    "gradient_energy",
    "flicker",
    "miou_common",
)


def region_table(measured: Measured, frames: Span = "2-last") -> Table:
    """Every method on all, visible and occluded pixels side by side, with its diversity and sharpness on all."""
    of = measured.of
    columns = tuple(column for column in _COLUMNS if column.region in of.regions and _has(of, column))
    return Table(
        name="regions",
        title=f"Visible and occluded pixels, diversity, sharpness: {frames_told(of, frames)}",
        headings=tuple(column.heading for column in columns),
        rows=tuple(measured_row(measured, method, columns, frames, PaperRow(label="")) for method in of.methods),
        notes=(*table_notes(measured, columns, frames), *_told(columns)),
    )


def frames_csv(measured: Measured) -> str:
    """Every figure of every method in each frame from the second on: one figure a line, without intervals."""
    lines: list[list[str]] = []
    for method in measured.of.methods:
        for frame in range(FIRST_MEASURED + 1, measured.of.note.frames + 1):
            for region in measured.of.regions:
                sums = measured.sums(method, Selection(frames=frame, region=region))
                values = [(name, sums.value(name)) for name in _BY_FRAME]
                lines += [
                    [method.name, str(frame), region, name, f"{value:.6g}"]
                    for name, value in values
                    if not np.isnan(value)
                ]
    return csv_text(["method", "frame", "pixels", "figure", "value"], lines)


def _has(of: EvaluatedSet, column: Column) -> bool:
    """Whether any method can have such a figure."""
    if column.of_classes:
        return any(method.makes_classes for method in of.methods)
    if column.figure == "diversity":
        return any(record.draws > 1 for method in of.methods for record in method.records if method.makes_pictures)
    return any(method.makes_pictures for method in of.methods)


def _told(columns: tuple[Column, ...]) -> tuple[str, ...]:
    figures = {column.figure for column in columns}
    notes = {
        "diversity": "Diversity: standard deviation over the draws of one view; of two draws or more.",
        "gradient_energy": "Gradient energy: view over target, 1 is as sharp as the target.",
    }
    return tuple(note for figure, note in notes.items() if figure in figures)
