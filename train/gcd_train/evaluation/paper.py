"""The paper's tables 1 to 6: their rows, their columns, and the figures that the paper prints.

Printed figures stand beside measured ones as the paper's own data and are never put in their place.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from gcd_train.evaluation.statistics import FigureName, Span
from gcd_train.evaluation.store import Region, RunNote


@dataclass(frozen=True, kw_only=True, slots=True)
class Column:
    """One figure on some pixels, or of a class by its id. digits: behind the point."""

    heading: str
    figure: FigureName | int
    region: Region = "all"
    digits: int = 2


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


@dataclass(frozen=True, kw_only=True, slots=True)
class PaperTable:
    """One table of the paper. kind, modality: of the runs it is for. frames: that it is over.

    rows: label, as it stands there, to the printed figures by column, None for none.
    gains: what the text says of it: how much better one half of the variants is than the other in the first column, in
        the mean.
    """

    title: str
    kind: Literal["kubric", "driving"]
    modality: Literal["rgb", "semantic"]
    frames: Span
    rows: Mapping[str, tuple[float | None, ...]]
    gains: tuple[tuple[str, str, float], ...] = ()

    @property
    def name(self) -> str:
        """Of its file: `table1`."""
        return self.title.partition(":")[0].replace(" ", "").lower()

    @property
    def columns(self) -> tuple[Column, ...]:
        """What it is of."""
        return PICTURE_COLUMNS if self.modality == "rgb" else CLASS_COLUMNS


PAPER_TABLES = (
    PaperTable(
        title="Table 1: Kubric-4D, ablation, last frame",
        kind="kubric",
        modality="rgb",
        frames="last",
        rows={
            "GCD (direct, max 90, scratch)": (15.96, 0.450, 0.575, 15.85, 0.470),
            "GCD (direct, max 180, scratch)": (14.71, 0.426, 0.611, 15.15, 0.458),
            "GCD (gradual, max 90, scratch)": (16.92, 0.486, 0.542, 16.59, 0.494),
            "GCD (gradual, max 180, scratch)": (16.63, 0.479, 0.552, 16.34, 0.491),
            "GCD (direct, max 90, finetuned)": (17.23, 0.494, 0.507, 16.69, 0.492),
            "GCD (direct, max 180, finetuned)": (16.65, 0.471, 0.529, 16.18, 0.470),
            "GCD (gradual, max 90, finetuned)": (17.88, 0.521, 0.486, 17.33, 0.514),
            "GCD (gradual, max 180, finetuned)": (17.81, 0.521, 0.488, 17.20, 0.515),
        },
        gains=(("gradual", "direct", 1.17), ("max 90", "max 180", 0.55), ("finetuned", "scratch", 1.34)),
    ),
    PaperTable(
        title="Table 2: ParallelDomain-4D, RGB, ablation, last frame",
        kind="driving",
        modality="rgb",
        frames="last",
        rows={
            "GCD (direct, scratch)": (22.49, 0.622, 0.487, 22.62, 0.653),
            "GCD (gradual, scratch)": (22.73, 0.632, 0.467, 22.76, 0.664),
            "GCD (direct, finetuned)": (23.32, 0.664, 0.440, 23.29, 0.691),
            "GCD (gradual, finetuned)": (23.47, 0.670, 0.425, 23.52, 0.696),
        },
    ),
    PaperTable(
        title="Table 3: ParallelDomain-4D, semantic, ablation, last frame",
        kind="driving",
        modality="semantic",
        frames="last",
        rows={
            "GCD (direct, scratch)": (0.312, 0.286),
            "GCD (gradual, scratch)": (0.344, 0.321),
            "GCD (direct, finetuned)": (0.367, 0.354),
            "GCD (gradual, finetuned)": (0.390, 0.377),
        },
    ),
    PaperTable(
        title="Table 4: Kubric-4D, baselines",
        kind="kubric",
        modality="rgb",
        frames="2-last",
        rows={
            "HexPlane": (15.38, 0.428, 0.568, 14.71, 0.428),
            "4D-GS": (14.92, 0.388, 0.584, 14.55, 0.392),
            "DynIBaR": (12.86, 0.356, 0.646, 12.78, 0.358),
            "Vanilla SVD": (13.85, 0.312, 0.556, 13.66, 0.326),
            "ZeroNVS": (15.68, 0.396, 0.508, 14.18, 0.368),
            "GCD (gradual, max 90, finetuned)": (20.30, 0.587, 0.408, 18.60, 0.527),
            "Reproject RGB-D": (12.51, 0.537, 0.416, None, None),
        },
    ),
    PaperTable(
        title="Table 5: ParallelDomain-4D, RGB, baselines",
        kind="driving",
        modality="rgb",
        frames="2-last",
        rows={
            "Vanilla SVD": (12.88, 0.400, 0.658, 13.96, 0.466),
            "ZeroNVS": (18.88, 0.490, 0.555, 19.29, 0.552),
            "GCD (gradual, finetuned)": (25.04, 0.731, 0.358, 24.70, 0.733),
            "Reproject RGB-D": (17.66, 0.459, 0.441, None, None),
        },
    ),
    PaperTable(
        title="Table 6: ParallelDomain-4D, semantic, baselines",
        kind="driving",
        modality="semantic",
        frames="2-last",
        rows={
            "GCD (gradual, finetuned)": (0.434, 0.382),
            "Reproject Sem-D": (0.373, None),
        },
    ),
)
"""All six, in the paper's order, with all that they print. Source: Van Hoorick et al. 2024 (GCD), section 5."""


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
    or 180, scratch; without "direct" it is gradual, without "scratch" finetuned. The paper's are shown no points.
    """
    if "splat" in details:
        return None
    if (known := _baseline(method)) is not None:
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
