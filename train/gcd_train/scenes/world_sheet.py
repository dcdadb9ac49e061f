"""A picture of what a world makes: one row a seed, one column a camera and a moment."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_train.errors import DataError
from gcd_train.scenes.description import Scene
from gcd_train.scenes.renderer import Renderer, Rendering

_GAP = 3


@dataclass(frozen=True, kw_only=True, slots=True)
class Look:
    """A camera at a time step; what of it: depth shows near as bright, ids have a colour each."""

    camera: str
    step: int
    shown: Literal["rgb", "depth", "instances", "classes"] = "rgb"


ORBIT_LOOKS = (
    Look(camera="view4", step=0),
    Look(camera="view4", step=12),
    Look(camera="view4", step=36),
    Look(camera="view0", step=12),
    Look(camera="view7", step=12),
    Look(camera="view7", step=12, shown="depth"),
    Look(camera="view7", step=12, shown="instances"),
)
"""What tells most of a scene with Kubric-4D's cameras: two low ones, a high one, depth and instances."""


def write_world_sheet(
    out: Path,
    world: Callable[[int], Scene],
    seeds: Sequence[int],
    looks: Sequence[Look] = ORBIT_LOOKS,
    *,
    width: int = 216,
    height: int = 144,
    palette: NDArray[np.uint8] | None = None,
) -> None:
    """Draw the looks of each seed, anti-aliased, into one PNG or JPEG.

    palette: RGB of every class, u8 [256, 3]; colours of our own without.
    Raises: RenderError where nothing can be drawn; DataError for an unknown ending, or a camera no scene has; OSError
    if the file cannot be written.
    """
    with Renderer(width, height, oversample=2) as renderer:
        rows = [_row(renderer, world(seed), looks, _colours() if palette is None else palette) for seed in seeds]
    sheet = np.concatenate([part for row in rows for part in (row, np.full_like(row[:_GAP], 255))][:-1])
    if not cv2.haveImageWriter(str(out)):
        raise DataError(f"{out} cannot be written: no picture format has this ending; give a path ending in .png")
    sheet = sheet & 0xF8 | 4  # five bits a channel halve the file, and nobody sees it at this size
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(cv2.imencode(out.suffix, sheet[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes())


def _row(renderer: Renderer, scene: Scene, looks: Sequence[Look], palette: NDArray[np.uint8]) -> NDArray[np.uint8]:
    missing = [look.camera for look in looks if look.camera not in scene.cameras]
    if missing:
        raise DataError(f"the scene has no camera {missing[0]!r}; it has {', '.join(scene.cameras)}")
    steps = sorted({look.step for look in looks})
    cameras = {look.camera for look in looks}
    brief = replace(
        scene,
        poses=scene.poses[steps],
        focus=scene.focus[steps],
        cameras={name: poses[steps] for name, poses in scene.cameras.items() if name in cameras},
    )
    views = renderer.render(brief)
    cells = [_cell(views[look.camera][steps.index(look.step)], look.shown, palette) for look in looks]
    gap = np.full((len(cells[0]), _GAP, 3), 255, np.uint8)
    return np.concatenate([part for cell in cells for part in (cell, gap)][:-1], axis=1)


def _cell(view: Rendering, shown: str, palette: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if shown == "depth":
        nearness = np.where(view.depth > 0, view.depth[view.depth > 0].min(initial=np.inf) / view.depth.clip(1e-3), 0)
        return np.repeat((255 * nearness.clip(0, 1)).astype(np.uint8)[..., None], 3, -1)
    if shown == "classes":
        return palette[view.classes]
    return view.rgb if shown == "rgb" else _colours()[view.instances]


def _colours() -> NDArray[np.uint8]:
    """Black and 255 colours that differ from their neighbours, [256, 3]."""
    hues = (np.arange(256) * 0.618034 * 180 % 180).astype(np.uint8)
    bright = np.where(np.arange(256) == 0, 0, 150 + 105 * (np.arange(256) % 2)).astype(np.uint8)
    wheel = np.stack([hues, np.full(256, 190, np.uint8), bright], -1)[None]
    return np.asarray(cv2.cvtColor(wheel, cv2.COLOR_HSV2RGB)[0], np.uint8)
