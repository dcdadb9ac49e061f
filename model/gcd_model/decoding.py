"""From latents to pictures: the VAE's decoder and, where the model has them, plane mix and class map."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gcd_model.class_head import class_map, nearest_classes
from gcd_model.config import SemanticClass
from gcd_model.download import Download
from gcd_model.engine import Engine
from gcd_model.vae import to_pixels


@dataclass(frozen=True, kw_only=True, slots=True)
class Denoised:
    """What sampling gave, V views and S samples of each.

    latents: [V, S, T, C, h, w], scaled. class_logits: [V, S, T, K, h', w'], or None without class head.
    """

    latents: Tensor
    class_logits: Tensor | None


@dataclass(frozen=True, kw_only=True, slots=True)
class LayerStack:
    """The source warped along one view's path: warped [T, L, 3, H, W] in [-1, 1], valid bool [T, L, H, W]."""

    warped: Tensor
    valid: Tensor


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


def decode(
    engine: Engine, scale: float, denoised: Denoised, stacks: Sequence[LayerStack | None], finish: Finish | None = None
) -> list[Pictures]:
    """Decode view by view, one clip at a time; while one is decoded, the one before it arrives on the CPU.

    scale: of the VAE. stacks: one per view; None for models without plane mix.
    """
    finish = Finish() if finish is None else finish
    views: list[list[_Coming]] = []
    for v, stack in enumerate(stacks):
        logits = denoised.class_logits
        views.append(
            [
                _decoded_clip(engine, scale, latents, None if logits is None else logits[v, s], stack, finish)
                for s, latents in enumerate(denoised.latents[v])
            ]
        )
    return [_arrived(clips) for clips in views]


def _decoded_clip(
    engine: Engine, scale: float, latents: Tensor, logits: Tensor | None, stack: LayerStack | None, finish: Finish
) -> _Coming:
    """latents: [T, C, h, w], scaled. Pixels [T, 3, H, W] and class ids [T, H, W]."""
    decoded = engine.decode(latents / scale)
    if stack is not None:
        decoded, logits = engine.mix(decoded, stack.warped, stack.valid, latents, logits)
    pixels = to_pixels(decoded)
    classes = None if logits is None else class_map(logits, *decoded.shape[-2:])
    if finish.painted:
        classes = nearest_classes(pixels, finish.painted)
    return _Coming(
        pixels=Download(whole_levels(pixels) if finish.whole_levels else pixels),
        classes=None if classes is None else Download(classes),
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
