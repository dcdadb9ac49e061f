"""From latents to pictures: the VAE's decoder and, where the model has them, plane mix and class map."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gcd_model.class_head import class_map, nearest_classes
from gcd_model.config import SemanticClass
from gcd_model.networks import Networks
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
    """One view on the CPU: pixels [S, T, 3, H, W], RGB in [0, 1]; classes uint8 [S, T, H, W] or None."""

    pixels: Tensor
    classes: Tensor | None


def decode(
    networks: Networks,
    denoised: Denoised,
    stacks: Sequence[LayerStack | None],
    painted: tuple[SemanticClass, ...] = (),
) -> list[Pictures]:
    """Decode view by view, one clip at a time.

    stacks: one per view; None for models without plane mix. painted: the classes in whose colours the model paints.
    """
    views: list[Pictures] = []
    for v, stack in enumerate(stacks):
        logits = denoised.class_logits
        clips = [
            _decoded_clip(networks, latents, None if logits is None else logits[v, s], stack)
            for s, latents in enumerate(denoised.latents[v])
        ]
        if painted:
            clips = [(pixels, nearest_classes(pixels, painted)) for pixels, _ in clips]
        classes = [clip_classes for _, clip_classes in clips if clip_classes is not None]
        views.append(
            Pictures(
                pixels=torch.stack([pixels for pixels, _ in clips]), classes=torch.stack(classes) if classes else None
            )
        )
    return views


def _decoded_clip(
    networks: Networks, latents: Tensor, logits: Tensor | None, stack: LayerStack | None
) -> tuple[Tensor, Tensor | None]:
    """latents: [T, C, h, w], scaled. Pixels [T, 3, H, W] and class ids [T, H, W], on the CPU."""
    decoder, mix = networks.decoder, networks.plane_mix
    unscaled = (latents / networks.config.vae.scale).to(decoder.stem.weight)
    decoded = decoder(unscaled, len(latents))
    if mix is not None and stack is not None:
        decoded, logits = mix(decoded, stack.warped, stack.valid, latents.to(decoded), logits)
    classes = None if logits is None else class_map(logits, *decoded.shape[-2:]).cpu()
    return to_pixels(decoded).cpu(), classes
