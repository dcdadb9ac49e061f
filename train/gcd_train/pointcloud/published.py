"""The picture a training sample shows: points drawn a little larger, holes filled, blurred, made smaller."""

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.geometry import Intrinsics
from gcd_train.data.sample import SceneView
from gcd_train.pointcloud.holes import fill_holes
from gcd_train.pointcloud.options import SplatOptions
from gcd_train.pointcloud.pixel_map import Doubles
from gcd_train.pointcloud.splat import Bytes, splat

OVERSIZE = 1.09375
"""Drawn at 420 x 280 for 384 x 256."""


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
    *,
    width: int = 384,
    height: int = 256,
    values: Sequence[Bytes] | None = None,
    options: SplatOptions | None = None,
    device: str | torch.device | None = None,
    kernel: int = 21,
    sigma: float = 5.25,
) -> Tensor:
    """A target picture the published way, on the device, without waiting for it.

    Args:
        views, world_from_camera, values, options, device: see splat().
        lens: of the data set's pictures, of any size; see render_lens(). width, height: of the result, pixels.
        kernel, sigma: see fill_holes().
    Returns:
        float32 [height, width, C] in 0..1. With `options.published` a hole is what is black, in each three channels;
        a black surface with colour behind it is none, as the released float64 keeps a trace of that colour.
    Raises:
        DataError, RecipeError: see splat().
    Source: Generative Camera Dolly, as released.
    """
    options = options or SplatOptions()
    larger = render_lens(lens, round(width * OVERSIZE), round(height * OVERSIZE))
    drawn = splat(views, world_from_camera, larger, values=values, options=options, device=device)
    if options.published:
        parts = [
            fill_holes(part, lit, kernel=kernel, sigma=sigma)
            for part, lit in zip(drawn.colour.split(3, -1), drawn.lit.unbind(-1), strict=True)
        ]
        filled = torch.cat(parts, dim=-1)
    else:
        filled = fill_holes(drawn.colour, drawn.covered, kernel=kernel, sigma=sigma)
    planes = filled.permute(2, 0, 1)[None]  # [1, C, H, W]
    smaller = F.interpolate(planes, size=(height, width), mode="bilinear", align_corners=False, antialias=False)
    return smaller[0].permute(1, 2, 0)


def published_picture(
    views: Sequence[SceneView],
    world_from_camera: Doubles,
    lens: Intrinsics,
    *,
    width: int = 384,
    height: int = 256,
    values: Sequence[Bytes] | None = None,
    options: SplatOptions | None = None,
    device: str | torch.device | None = None,
) -> NDArray[np.uint8]:
    """published_tensor() as u8 [height, width, C] in memory: digits are cut off as published, or rounded without
    `options.published`."""
    picture = published_tensor(
        views, world_from_camera, lens, width=width, height=height, values=values, options=options, device=device
    )
    half = 0.0 if options is not None and options.published else 0.5
    return (picture * 255 + half).clamp(0, 255).to(torch.uint8).cpu().numpy()
