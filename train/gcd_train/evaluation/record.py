"""What evaluation keeps of one method on one clip: enough for every table, for any choice of frames and pixels."""

from typing import Literal, TypeAlias, get_args

import msgspec

Region: TypeAlias = Literal["all", "visible", "occluded"]
"""Which pixels of the target: all, those the source camera saw too, or the others."""

REGIONS: tuple[Region, ...] = get_args(Region)

FRAMES_IN, LPIPS = "frames in", "lpips"
"""In what a note says of a method: where another method's frames lie, and which LPIPS it was measured with."""

Frames: TypeAlias = tuple[float | None, ...]
"""A value of each frame, from the first; None where there is no pixel to measure."""

Counted: TypeAlias = tuple[tuple[int, int, int], ...]
"""Pixels of one frame as (true class, predicted class, how many), only what occurs; predicted 255 is no class."""


class RegionRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One method's figures on some pixels of one clip.

    pixels: share of the frame that they are, T. psnr_db, ssim: [S][T]. diversity: T, None for fewer than two draws.
    gradient, gradient_target: [S][T] and T, mean length of the gradient. confusion: [T], summed over draws; None where
    there are no classes.
    """

    pixels: tuple[float, ...]
    psnr_db: tuple[Frames, ...] | None = None
    ssim: tuple[Frames, ...] | None = None
    diversity: Frames | None = None
    gradient: tuple[Frames, ...] | None = None
    gradient_target: Frames | None = None
    confusion: tuple[Counted, ...] | None = None


class ClipRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One method on one clip of T frames, in S draws.

    method: its name. privileged: whether it is given the exact depth, or further cameras. key: of the clip in its set.
    scene: the clip's; errors are over scenes. change: azimuth and elevation in degrees and radius in metres from source
    to goal; None for the fixed path of driving. fps: of the clip. seconds: that the method took. regions: by name;
    "visible" and "occluded" are missing where nobody knows what the source camera saw.
    lpips: [S][T], None where no weights were given. step, step_target: [S][T-1] and T-1, mean change from frame to
    frame. grid_confusion: as in a region, at the class grid. Where the method makes no pictures all else is None.
    """

    method: str
    privileged: bool
    key: str
    scene: str
    change: tuple[float, float, float] | None
    frames: int
    fps: float
    draws: int
    seconds: float
    regions: dict[Region, RegionRecord]
    lpips: tuple[Frames, ...] | None = None
    step: tuple[tuple[float, ...], ...] | None = None
    step_target: tuple[float, ...]
    grid_confusion: tuple[Counted, ...] | None = None


class RunNote(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What all records of a run have in common; `run.json`.

    command: the line that began it. made: UTC, ISO 8601. versions: of gcd-node, torch, python. data: folders.
    data_identity: digest of the clips. kind: "kubric", "driving" or "orbit": which tables they belong to.
    modality: of the target pictures. protocol: "paper", "released" or "pairs". fps: frames per second of the clips.
    rates: empty where all have that one; else all that clips may have, of which `fps` is the highest, and each record
    tells its clip's. classes: names, empty for none.
    methods: name to what it is: a weight file's digest, steps, guidance, draws, seed, views; all as text.
    """

    command: str
    made: str
    versions: dict[str, str]
    data: tuple[str, ...]
    data_identity: str
    kind: Literal["kubric", "driving", "orbit"]
    modality: Literal["rgb", "semantic"]
    protocol: Literal["paper", "released", "pairs"]
    frames: int
    height: int
    width: int
    fps: float
    rates: tuple[float, ...] = ()
    seed: int
    classes: tuple[str, ...] = ()
    methods: dict[str, dict[str, str]] = {}
