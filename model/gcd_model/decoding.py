"""From latents to pictures: the VAE's decoder and, where the model paints classes, their map."""

from dataclasses import dataclass

import torch
from torch import Tensor

from gcd_model.colours import nearest_classes
from gcd_model.config import SemanticClass
from gcd_model.download import Download
from gcd_model.engine import Engine
from gcd_model.vae import to_pixels


@dataclass(frozen=True, kw_only=True, slots=True)
class Pictures:
    """One view on the CPU: pixels [S, T, 3, H, W], RGB; classes uint8 [S, T, H, W] or None.

    pixels: float32 in [0, 1], or whole levels, uint8 in 0..255. finite: what was decoded held neither NaN nor Inf.
    """

    pixels: Tensor
    classes: Tensor | None
    finite: bool


@dataclass(frozen=True, kw_only=True, slots=True)
class Finish:
    """What becomes of decoded pictures.

    painted: the classes in whose colours the model paints. whole_levels: as uint8.
    """

    painted: tuple[SemanticClass, ...] = ()
    whole_levels: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class _Coming:
    """A decoded clip that may still be arriving. finite: bool, on the device."""

    pixels: Download
    classes: Download | None
    finite: Tensor


def decode(engine: Engine, latents: Tensor, finish: Finish | None = None) -> list[Pictures]:
    """Decode view by view, one clip at a time; while one is decoded, the one before it arrives on the CPU.

    latents: [V, S, T, C, h, w], unscaled: V views, S samples of each.
    """
    finish = Finish() if finish is None else finish
    views = [[_decoded_clip(engine, clip, finish) for clip in view] for view in latents]
    return [_arrived(clips) for clips in views]


def _decoded_clip(engine: Engine, latents: Tensor, finish: Finish) -> _Coming:
    """latents: [T, C, h, w]. Pixels [T, 3, H, W] and class ids [T, H, W]."""
    decoded = engine.decode(latents)
    pixels = to_pixels(decoded)
    return _Coming(
        pixels=Download(whole_levels(pixels) if finish.whole_levels else pixels),
        classes=Download(nearest_classes(pixels, finish.painted)) if finish.painted else None,
        finite=decoded.isfinite().all(),
    )


def whole_levels(pixels: Tensor) -> Tensor:
    """[0, 1] -> uint8 in 0..255, the nearest level."""
    return (pixels * 255).round().to(torch.uint8)


def _arrived(clips: list[_Coming]) -> Pictures:
    """The samples of one view."""
    classes = [clip.classes.result() for clip in clips if clip.classes is not None]
    return Pictures(
        pixels=torch.stack([clip.pixels.result() for clip in clips]),
        classes=torch.stack(classes) if classes else None,
        finite=all(clip.finite.item() for clip in clips),
    )
