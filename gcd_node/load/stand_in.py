"""A model that does nothing, for measuring everything around a model: it gives a ready picture after a set time."""

import time
from collections.abc import Sequence

import torch
from msgspec.structs import replace
from torch.nn.functional import interpolate

from gcd_model import (
    FAMILIES,
    SVD_14,
    Augmentation,
    Cancelled,
    Clip,
    NonFiniteError,
    RenderOptions,
    SourceFeatures,
    Traits,
    Trajectory,
    View,
)

_COARSE = 8
_LOOK_S = 0.005


class StandInModel:
    """Implements ViewSynthesizer with the published model's 14 frames, steered by angles.

    work_s: how long a rendering takes.
    nan_every: every so many renderings one fails as a network does that went astray; 0 for never.
    """

    def __init__(self, *, width: int = 384, height: int = 256, work_s: float = 0.0, nan_every: int = 0) -> None:
        """Draw the picture. width, height: pixels, multiples of 64."""
        config = replace(SVD_14, width=width, height=height)
        self.traits = Traits(
            name="stand-in",
            config=config,
            family=FAMILIES["kubric90"],
            move_time=config.frames - 1,
            sha256_12="0" * 12,
            precision="float32",
            device="cpu",
            trained=False,
        )
        self._samples = _picture(config.frames, height, width)
        self._work_s, self._nan_every = work_s, nan_every
        self._rendered = 0
        self.taken_ns = 0
        """When it was last given a frame, or a window to render; monotonic clock."""

    def encode(
        self, clip: Clip, augmentation: Augmentation | None = None, extra: torch.Tensor | None = None
    ) -> SourceFeatures:
        """See ViewSynthesizer; only a few pixels of the clip are kept."""
        self.taken_ns = time.monotonic_ns()
        latents = clip.video[:, :, ::_COARSE, ::_COARSE]
        return SourceFeatures(tokens=None, latents=latents, extra=extra, fps=clip.fps, augmentation=0.0)

    def render(
        self, features: SourceFeatures, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        """See ViewSynthesizer. Always the same picture, whatever is asked for."""
        self.taken_ns = time.monotonic_ns()
        options = RenderOptions() if options is None else options
        self._work(options)
        self._rendered += 1
        if self._nan_every and self._rendered % self._nan_every == 0:
            raise NonFiniteError("the stand-in pretends to have produced NaN; it will not do so the next time")
        samples = self._samples.expand(options.samples, -1, -1, -1, -1)
        return [
            View(samples=samples, latents=features.latents[None], trajectory=path, motion_bucket=127.0)
            for path in trajectories
        ]

    def _work(self, options: RenderOptions) -> None:
        until_s = time.monotonic() + self._work_s
        while (left_s := until_s - time.monotonic()) > 0:
            if options.cancel is not None and options.cancel.is_set():
                raise Cancelled("the stand-in was told to stop")
            time.sleep(min(_LOOK_S, left_s))
        if options.progress is not None:
            options.progress(1, 1)


def _picture(frames: int, height: int, width: int) -> torch.Tensor:
    """u8 [1, T, 3, H, W], in memory as it is sent: smooth patches of colour, so that it compresses as pictures do."""
    chance = torch.Generator().manual_seed(0)
    coarse = torch.rand(frames, 3, height // _COARSE, width // _COARSE, generator=chance)
    drawn = interpolate(coarse, size=(height, width), mode="bilinear")
    levels = (drawn * 255).round().to(torch.uint8)
    return levels.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)[None]
