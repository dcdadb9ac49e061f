"""The picture a training sample shows: points drawn a little larger, holes filled, blurred, made smaller; and what of
it the source camera saw too.
"""

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.geometry import Intrinsics
from gcd_train.data.encodings import Bytes, Doubles, Floats
from gcd_train.data.sample import SceneView
from gcd_train.data.splat import NEAREST_M, PixelMap, splat

OVERSIZE = 1.09375
"""Drawn at 420 x 280 for 384 x 256."""
_LEAST = 1e-7
_BLACK = 1e-7
WIDE, NARROW = (21, 5.25), (3, 0.75)
"""How holes are filled in pictures to train on, and in those that tell what is visible: pixels, odd, and sigma."""
_BLUR_SIGMA = 0.6
_TOLERANCE = 0.02  # share of the depth by which two surfaces that are the same may differ


def render_lens(lens: Intrinsics, width: int, height: int) -> Intrinsics:
    """A data set's camera for pictures of another size, as if the larger dimension had been cropped in the centre.

    Args:
        lens: of the data set's own pictures. width, height: of the picture that is wanted, pixels.
    Returns:
        A lens of that size: angles across stay where the wanted picture is relatively wider, angles along where it is
        narrower; square pixels stay square.
    Source: Generative Camera Dolly, as released.
    """
    same = lens.resized(width, height)
    across, along = width / lens.width, height / lens.height
    fx, fy = (same.fx, lens.fy * across) if across > along else (lens.fx * along, same.fy)
    return Intrinsics(fx=fx, fy=fy, cx=same.cx, cy=same.cy, width=width, height=height)


def published_tensor(
    views: Sequence[SceneView],
    world_from_camera: Doubles,
    lens: Intrinsics,
    size: tuple[int, int],
    *,
    values: Sequence[Bytes] | None = None,
    published: bool = False,
    device: str | None = None,
    filling: tuple[int, float] = WIDE,
) -> Tensor:
    """A target picture the published way, on the device.

    Args:
        views, world_from_camera, values, published, device: see splat().
        lens: of the data set's pictures, of any size; see render_lens(). size: width and height of the result, pixels.
    Returns:
        float32 [height, width, C] in 0..1. With `published` a hole is what is black, in each three channels; a black
        surface with colour behind it is none, as the released float64 keeps a trace of that colour.
    Source: Generative Camera Dolly, as released.
    """
    width, height = size
    larger = render_lens(lens, round(width * OVERSIZE), round(height * OVERSIZE))
    drawn = splat(views, world_from_camera, larger, values=values, published=published, device=device)
    parts, seen = [drawn.colour], [drawn.covered]
    if published:
        parts, seen = list(drawn.colour.split(3, -1)), list(drawn.lit.unbind(-1))
    filled = torch.cat([fill_holes(part, there, filling) for part, there in zip(parts, seen, strict=True)], dim=-1)
    planes = filled.permute(2, 0, 1)[None]  # [1, C, H, W]
    smaller = F.interpolate(planes, size=(height, width), mode="bilinear", align_corners=False, antialias=False)
    return smaller[0].permute(1, 2, 0)


def quantised(picture: Tensor, *, published: bool = False) -> Bytes:
    """A picture of published_tensor() as u8: digits are cut off with `published`, else rounded."""
    return (picture * 255 + (0.0 if published else 0.5)).clamp(0, 255).to(torch.uint8).cpu().numpy()


def fill_holes(colour: Tensor, covered: Tensor, filling: tuple[int, float] = WIDE) -> Tensor:
    """Holes take the weighted mean of what is around them; then the whole picture is blurred a little, over 3 x 3.

        filled = G(colour * covered) / max(G(covered), 1e-7)        where not covered, G a Gaussian of so many pixels

    Holes with nothing covered within the kernel stay black. Pictures go on beyond their edges mirrored.

    Args:
        colour: float32 [H, W, C]. covered: bool [H, W].
    Returns:
        [H, W, C].
    Source: Generative Camera Dolly, point renderer as released; the mirrored edges are our reading.
    """
    held = covered[..., None].to(colour.dtype)
    blurred = _blur(torch.cat([colour * held, held], dim=-1), *filling)
    filled = torch.where(covered[..., None], colour, blurred[..., :-1] / blurred[..., -1:].clamp(min=_LEAST))
    return _blur(filled, 3, _BLUR_SIGMA)


def _blur(picture: Tensor, kernel: int, sigma: float) -> Tensor:
    """[H, W, C] through a Gaussian, one axis after the other."""
    reach = kernel // 2
    away = torch.arange(-reach, reach + 1, device=picture.device, dtype=picture.dtype)
    weights = torch.softmax(-(away**2) / (2 * sigma**2), dim=0)
    planes = F.pad(picture.permute(2, 0, 1)[:, None], (reach, reach, reach, reach), mode="reflect")  # [C, 1, H, W]
    planes = F.conv2d(F.conv2d(planes, weights.view(1, 1, 1, -1)), weights.view(1, 1, -1, 1))
    return planes[:, 0].permute(1, 2, 0)


def visibility(
    source: SceneView,
    world_from_camera: Doubles,
    lens: Intrinsics,
    size: tuple[int, int],
    *,
    published: bool = False,
) -> NDArray[np.bool_]:
    """Where the source view alone, drawn as another camera sees it, shows anything: the published rule.

    Whether the target shows the same thing there is not asked, and what is black counts as hidden.

    Args:
        source: with depth. world_from_camera, lens, size, published: see published_tensor().
    Returns:
        bool [height, width]; the complement counts as occluded.
    Source: Generative Camera Dolly, evaluation as released: holes are filled over 3 pixels, not 21.
    """
    shown = published_tensor([source], world_from_camera, lens, size, published=published, filling=NARROW)
    return (shown.sum(-1) > _BLACK).numpy()


def depth_visibility(
    source: SceneView, target_depth: Floats, world_from_camera: Doubles, lens: Intrinsics
) -> NDArray[np.bool_]:
    """Where the source camera saw the very surface that the target shows, to 2 % of its depth.

    Each target pixel is looked up in the source's depth: at one of the four pixels around, or between them, where
    inverse depth is interpolated, as planes have it.

    Args:
        source: with depth. target_depth: f32 [H, W], planar, metres, 0 where nothing is known.
        world_from_camera, lens: of the target.
    Returns:
        bool [H, W]; False where either depth is not known.
    """
    pixels = PixelMap.between(world_from_camera, lens, source.world_from_camera, source.lens, 0.5)
    rays = pixels.across[None] + pixels.along[:, None]  # [H, W, 3]
    x, y, ahead = np.moveaxis(target_depth[..., None] * rays + pixels.offset, -1, 0)
    met = (target_depth > 0.0) & (ahead > NEAREST_M)
    column = x / np.where(met, ahead, 1.0) + source.lens.cx
    row = y / np.where(met, ahead, 1.0) + source.lens.cy
    met &= (column >= 0) & (column < source.lens.width) & (row >= 0) & (row < source.lens.height)
    agrees = np.zeros(met.shape, np.bool_)
    agrees[met] = _agrees(source.depth, column[met], row[met], ahead[met])
    return agrees


def _agrees(depth: Floats, column: Doubles, row: Doubles, wanted: Doubles) -> NDArray[np.bool_]:
    """[M]: whether a depth picture has the wanted depths at these places, counted from its corner."""
    left, top = np.floor(column - 0.5).astype(np.intp), np.floor(row - 0.5).astype(np.intp)
    right_share, lower_share = column - 0.5 - left, row - 0.5 - top
    found = np.zeros(len(wanted), np.bool_)
    inverse, weight = np.zeros(len(wanted)), np.zeros(len(wanted))
    for right in (0, 1):
        for lower in (0, 1):
            at = np.clip(top + lower, 0, depth.shape[0] - 1), np.clip(left + right, 0, depth.shape[1] - 1)
            near = depth[at].astype(np.float64)
            share = np.abs(1 - right - right_share) * np.abs(1 - lower - lower_share) * (near > 0)
            inverse += share / np.where(near > 0, near, 1.0)
            weight += share
            found |= np.abs(near - wanted) <= _TOLERANCE * wanted
    between = weight / np.where(inverse > 0, inverse, 1.0)
    return found | ((inverse > 0) & (np.abs(between - wanted) <= _TOLERANCE * wanted))
