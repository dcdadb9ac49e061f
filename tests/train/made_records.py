"""Records of evaluations as tests need them: made up, in the shapes that measuring gives."""

from collections.abc import Mapping, Sequence

import msgspec

from gcd_train.evaluation.store import ClipRecord, Counted, Region, RegionRecord, RunNote

FRAMES = 4
FPS = 10.0


def region(
    psnr_db: Sequence[float | None] | None = None,
    *,
    ssim: float = 0.5,
    draws: int = 1,
    counts: Sequence[tuple[int, int, int]] | None = None,
    frames: int = FRAMES,
    gradient: Sequence[float | None] | None = (1.0,) * FRAMES,
    pixels: Sequence[float] = (0.5,) * FRAMES,
) -> RegionRecord:
    """A region with this PSNR in each frame of each draw, one SSIM, and the same counted pixels in each frame.

    gradient: of the view; the target's is 2 where there are pixels.
    """
    each = None if psnr_db is None else tuple(psnr_db)
    alike = None if each is None else tuple(None if value is None else ssim for value in each)
    counted: Counted = tuple(counts or ())
    return RegionRecord(
        pixels=tuple(pixels)[:frames],
        psnr_db=None if each is None else (each,) * draws,
        ssim=None if alike is None else (alike,) * draws,
        diversity=None if each is None or draws < 2 else (0.01,) * frames,
        gradient=None if each is None or gradient is None else (tuple(gradient)[:frames],) * draws,
        gradient_target=tuple(2.0 if share else None for share in pixels)[:frames],
        confusion=None if counts is None else (counted,) * frames,
    )


def record(
    method: str = "model",
    key: str = "scn00001.sample_00",
    *,
    scene: str | None = None,
    regions: Mapping[Region, RegionRecord] | None = None,
    psnr_db: float = 20.0,
    change: tuple[float, float, float] | None = None,
    privileged: bool = False,
    draws: int = 1,
    lpips: float | None = None,
    gradient: Sequence[float] | None = (1.0,) * FRAMES,
    step: Sequence[float] | None = (1.0,) * (FRAMES - 1),
    seconds: float = 1.0,
) -> ClipRecord:
    """A record of four frames. Regions: by default all pixels, with one PSNR in all frames."""
    made = dict(regions or {"all": region((psnr_db,) * FRAMES, draws=draws, gradient=gradient)})
    return ClipRecord(
        method=method,
        privileged=privileged,
        key=key,
        scene=key.partition(".")[0] if scene is None else scene,
        change=change,
        frames=FRAMES,
        fps=FPS,
        draws=draws,
        seconds=seconds,
        regions=made,
        lpips=None if lpips is None else ((lpips,) * FRAMES,) * draws,
        step=None if step is None else (tuple(step),) * draws,
        step_target=(2.0,) * (FRAMES - 1),
    )


NOTE = RunNote(
    command="gcd-train evaluate --data held-out --out run",
    made="2026-01-01T00:00:00+00:00",
    versions={"gcd-node": "0.1.0", "torch": "2", "python": "3.11"},
    data=("held-out",),
    data_identity="0123456789ab",
    kind="orbit",
    modality="rgb",
    protocol="pairs",
    frames=FRAMES,
    height=32,
    width=48,
    seed=3,
)


def note(**changes: object) -> RunNote:
    """What a run says of itself: pairs of an orbit, with these changes."""
    return msgspec.structs.replace(NOTE, **changes)
