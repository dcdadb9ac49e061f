"""The paper's tables 1 to 6: their rows, their columns, and the figures that the paper prints.

Printed figures stand beside measured ones as the paper's own data and are never put in their place. A row that nobody
measured says so.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from gcd_train.evaluation.record import Region, RunNote
from gcd_train.evaluation.tallies import FigureName, Span


@dataclass(frozen=True, kw_only=True, slots=True)
class Column:
    """One figure on some pixels. digits: behind the point."""

    heading: str
    figure: FigureName
    region: Region = "all"
    digits: int = 2

    @property
    def of_classes(self) -> bool:
        """Whether it tells how good class maps are, not pictures."""
        return self.figure in ("miou", "miou_full", "miou_common", "accuracy")


@dataclass(frozen=True, kw_only=True, slots=True)
class PaperRow:
    """One row of a paper's table. label: as it stands there. printed: its figures, by column; None where unknown."""

    label: str
    printed: tuple[float | None, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class PaperTable:
    """One table of the paper. name: of its file. kind, modality: of the runs it is for. frames: that it is over."""

    name: str
    title: str
    kind: Literal["kubric", "driving"]
    modality: Literal["rgb", "semantic"]
    frames: Span
    columns: tuple[Column, ...]
    rows: tuple[PaperRow, ...]


PICTURE_COLUMNS = (
    Column(heading="PSNR all", figure="psnr_db"),
    Column(heading="SSIM all", figure="ssim", digits=3),
    Column(heading="LPIPS all", figure="lpips", digits=3),
    Column(heading="PSNR occluded", figure="psnr_db", region="occluded"),
    Column(heading="SSIM occluded", figure="ssim", region="occluded", digits=3),
)
CLASS_COLUMNS = (
    Column(heading="mIoU all", figure="miou_common", digits=3),
    Column(heading="mIoU occluded", figure="miou_common", region="occluded", digits=3),
)

_LEARNT_PER_SCENE = (PaperRow(label="HexPlane"), PaperRow(label="4D-GS"), PaperRow(label="DynIBaR"))
_OTHERS = (
    *_LEARNT_PER_SCENE,
    PaperRow(label="Vanilla SVD"),
    PaperRow(label="ZeroNVS"),
    PaperRow(label="Reproject RGB-D"),
)


def _variants(reaches: tuple[str, ...], printed: Mapping[str, tuple[float | None, ...]]) -> tuple[PaperRow, ...]:
    """All variants of the model, with the figures that are known."""
    labels = [
        f"GCD ({', '.join(part for part in (path, reach, start) if part)})"
        for path in ("gradual", "direct")
        for reach in reaches
        for start in ("finetuned", "scratch")
    ]
    return tuple(PaperRow(label=label, printed=printed.get(label, ())) for label in labels)


PAPER_TABLES = (
    PaperTable(
        name="table1",
        title="Table 1: Kubric-4D",
        kind="kubric",
        modality="rgb",
        frames="2-last",
        columns=PICTURE_COLUMNS,
        rows=(
            *_OTHERS,
            PaperRow(label="GCD (gradual, max 90, finetuned)", printed=(20.30, 0.587, 0.408, 18.60, 0.527)),
            PaperRow(label="GCD (gradual, max 180, finetuned)"),
        ),
    ),
    PaperTable(
        name="table2",
        title="Table 2: Kubric-4D, ablation, last frame",
        kind="kubric",
        modality="rgb",
        frames="last",
        columns=PICTURE_COLUMNS,
        rows=_variants(
            ("max 90", "max 180"),
            {
                "GCD (gradual, max 90, finetuned)": (17.88,),
                "GCD (direct, max 90, finetuned)": (17.23,),
                "GCD (gradual, max 180, finetuned)": (17.81,),
                "GCD (direct, max 180, finetuned)": (16.65,),
            },
        ),
    ),
    PaperTable(
        name="table3",
        title="Table 3: ParallelDomain-4D, RGB",
        kind="driving",
        modality="rgb",
        frames="2-last",
        columns=PICTURE_COLUMNS,
        rows=(*_OTHERS, PaperRow(label="GCD (gradual, finetuned)", printed=(25.04, 0.731, 0.358, 24.70, 0.733))),
    ),
    PaperTable(
        name="table4",
        title="Table 4: ParallelDomain-4D, RGB, ablation, last frame",
        kind="driving",
        modality="rgb",
        frames="last",
        columns=PICTURE_COLUMNS,
        rows=_variants(("",), {"GCD (gradual, finetuned)": (23.47,)}),
    ),
    PaperTable(
        name="table5",
        title="Table 5: ParallelDomain-4D, semantic",
        kind="driving",
        modality="semantic",
        frames="2-last",
        columns=CLASS_COLUMNS,
        rows=(PaperRow(label="Reproject Sem-D"), PaperRow(label="GCD (gradual, finetuned)", printed=(0.434, 0.382))),
    ),
    PaperTable(
        name="table6",
        title="Table 6: ParallelDomain-4D, semantic, ablation, last frame",
        kind="driving",
        modality="semantic",
        frames="last",
        columns=CLASS_COLUMNS,
        rows=_variants(("",), {"GCD (gradual, finetuned)": (0.390,)}),
    ),
)
"""All six. Source: GCD, section 5; what the tables print is given where it is known to us."""


def tables_for(note: RunNote) -> tuple[PaperTable, ...]:
    """The paper's tables that a run belongs in; none for pairs of our own."""
    if note.protocol == "pairs":
        return ()
    return tuple(each for each in PAPER_TABLES if (each.kind, each.modality) == (note.kind, note.modality))


_BASELINES = (
    ("hexplane", "HexPlane"),
    ("4dgs", "4D-GS"),
    ("4dgaussian", "4D-GS"),
    ("dynibar", "DynIBaR"),
    ("vanillasvd", "Vanilla SVD"),
    ("zeronvs", "ZeroNVS"),
    ("reprojectrgbd", "Reproject RGB-D"),
    ("reprojectsemd", "Reproject Sem-D"),
)


def row_label(method: str, details: Mapping[str, str], table: PaperTable) -> str | None:
    """The row of a table that a method belongs in; None for a method that the paper does not have.

    A baseline is known by its name. A model is known by the words of its name and of its family: gradual or direct, 90
    or 180, scratch; without "direct" it is gradual, without "scratch" finetuned.
    """
    known = _baseline(method)
    if known is not None:
        return known
    told = f"{method} {details.get('family', '')}".lower()
    if not is_model(method, details) and not re.search(r"gcd|gradual|direct", method.lower()):
        return None
    parts = ["direct" if re.search(r"direct|jumpy", told) else "gradual"]
    if table.kind == "kubric":
        reach = re.search(r"(?<!\d)(90|180)(?!\d)", method) or re.search(r"(?:kubric|max)[ _-]?(90|180)(?!\d)", told)
        if reach is None:
            return None
        parts.append(f"max {reach[1]}")
    parts.append("scratch" if "scratch" in told else "finetuned")
    return f"GCD ({', '.join(parts)})"


def is_model(method: str, details: Mapping[str, str]) -> bool:
    """Whether it is a model of ours, with weights of its own, and no baseline."""
    return "weights" in details and _baseline(method) is None


def _baseline(method: str) -> str | None:
    """The row of a baseline of the paper, by its name."""
    plain = re.sub(r"[^a-z0-9]", "", method.lower())
    return next((label for start, label in _BASELINES if plain.startswith(start)), None)
