"""A world that is one painted ground plane under a sky, drawn by following each pixel's ray: no renderer.

Seen from a vehicle, or by a camera that goes over the sphere about a stage.
"""

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import cv2
import msgspec
import numpy as np
import torch
from torch import Tensor

from gcd_model.geometry import (
    CameraMount,
    Spherical,
    SphericalDelta,
    Trajectory,
    spherical_trajectory,
)
from gcd_train.data.pairs import PairedClip, PairedClips
from gcd_train.evaluation.clips import PairedSet
from gcd_train.evaluation.measure import predicted_and_measured as measured
from gcd_train.evaluation.predictors import CameraPair, Predictor, SourceClip, pixel_rays
from gcd_train.evaluation.statistics import ClipTable, Sums
from gcd_train.scenes.worlds import DEPTH_UNIT_M, Orbit, World

SKY, ROAD, TERRAIN = 0, 1, 4
STAGE_SOURCE = Spherical(azimuth_deg=0.0, elevation_deg=20.0, radius_m=14.0)


def picture(vehicle_from_camera: Tensor, rays: Tensor, phase: float) -> tuple[Tensor, Tensor, Tensor]:
    """Colour [H, W, 3] in [0, 1], depth [H, W] (0: sky) and classes [H, W] of the plane."""
    turned = rays @ vehicle_from_camera[:3, :3].T
    depth = -vehicle_from_camera[2, 3] / turned[..., 2]
    ground = (depth > 0) & (depth < 200)
    points = vehicle_from_camera[:3, 3] + turned * depth[..., None]
    x, y = points[..., 0], points[..., 1]
    colour = torch.stack([0.5 + 0.3 * torch.sin(y / 4 + phase), 0.5 + 0.3 * torch.cos(x / 9), 0.4 + 0 * x], dim=-1)
    colour = torch.where(ground[..., None], colour, 0.8)
    labels = torch.where(ground, torch.where(y.abs() < 3, ROAD, TERRAIN), SKY)
    return colour, torch.where(ground, depth, 0.0), labels


def plane_clip(cameras: CameraPair, phase: float = 0.0) -> PairedClip:
    """The plane as both cameras of a clip see it."""
    still = cameras.ground_from_source
    moving = still @ cameras.source_from_target
    source = [picture(still, pixel_rays(cameras.source), phase) for _ in moving]
    target = [picture(pose, pixel_rays(cameras.target), phase) for pose in moving]
    s_rgb, s_depth, s_labels = (torch.stack(kind) for kind in zip(*source, strict=True))
    t_rgb, t_depth, t_labels = (torch.stack(kind) for kind in zip(*target, strict=True))
    return PairedClip(
        source=_bytes(s_rgb * 255),
        target=_bytes(t_rgb * 255),
        source_depth=s_depth.numpy().astype(np.float32),
        target_depth=t_depth.numpy().astype(np.float32),
        source_classes=_bytes(s_labels),
        target_classes=_bytes(t_labels),
        source_instances=_bytes(0 * s_labels),
        seed=0,
    )


def _bytes(values: Tensor) -> np.ndarray:
    return values.double().round().to(torch.uint8).numpy()


@dataclass
class PlaneClips(PairedClips):
    """Clips of that world with different paint, each a scene. paths: of the clips of an orbit; empty in driving."""

    clips: tuple[PairedClip, ...] = ()
    paths: tuple[Trajectory, ...] = ()

    @classmethod
    def make(cls, count: int, *, frames: int = 4, height: int = 32, width: int = 48) -> Self:
        cameras = CameraPair.driving(CameraMount(), frames=frames, height=height, width=width)
        return cls._of([cameras] * count, name="driving", fps=10.0, hfov_deg=85.0)

    @classmethod
    def orbits(cls, changes: Sequence[SphericalDelta], *, frames: int = 4, height: int = 32, width: int = 48) -> Self:
        """One clip for each change of azimuth, elevation and radius, without classes."""
        lens = 53.13
        paths = tuple(
            spherical_trajectory(STAGE_SOURCE, change, frames=frames, move_time=frames - 1) for change in changes
        )
        cameras = [CameraPair.orbit(path, hfov_deg=lens, height=height, width=width) for path in paths]
        return cls._of(cameras, paths, name="drop", camera="orbit", fps=12.0, hfov_deg=lens, classes=())

    @classmethod
    def _of(cls, cameras: Sequence[CameraPair], paths: tuple[Trajectory, ...] = (), **options: Any) -> Self:
        clips = tuple(plane_clip(pair, phase=float(number)) for number, pair in enumerate(cameras))
        frames, height, width = clips[0].source.shape[:3]
        size = {"frames": frames, "height": height, "width": width, "oversample": 1, "clips_per_shard": len(clips)}
        places = tuple((Path("plane.zip"), f"{number:08d}") for number in range(len(clips)))
        return cls(worlds=(World(**options, **size),), places=places, clips=clips, paths=paths)

    def write(self, folder: Path, first_seed: int = 0) -> Path:
        """A data folder with these clips in one shard, under seeds from `first_seed` on."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "world.json").write_bytes(msgspec.json.encode(self.world))
        with zipfile.ZipFile(folder / f"shard-{first_seed:08d}-{len(self)}.zip", "w") as archive:
            for number, clip in enumerate(self.clips, start=first_seed):
                if self.paths:
                    archive.writestr(f"{number:08d}/scene.json", _told(self.paths[number - first_seed]))
                for kind, strip in _strips(clip).items():
                    archive.writestr(f"{number:08d}/{kind}.png", cv2.imencode(".png", strip)[1].tobytes())
        return folder

    def __len__(self) -> int:
        return len(self.clips)

    def __getitem__(self, index: int) -> PairedClip:
        return self.clips[index]

    def scene(self, index: int) -> tuple[str, int]:
        return "plane", index

    def trajectory(self, index: int, /) -> Trajectory:
        return self.paths[index] if self.paths else super().trajectory(index)


def _told(path: Trajectory) -> bytes:
    start, goal = path.source, path.goal_delta
    orbit = Orbit(
        start=(start.azimuth_deg, start.elevation_deg, start.radius_m),
        change=(goal.azimuth_deg, goal.elevation_deg, goal.radius_m),
        frame_numbers=tuple(range(path.frames)),
    )
    return msgspec.json.encode({"orbit": orbit})


def _strips(clip: PairedClip) -> dict[str, np.ndarray]:
    strips: dict[str, np.ndarray] = {}
    for side in ("source", "target"):
        strips[f"{side}.rgb"] = getattr(clip, side)[..., ::-1]
        strips[f"{side}.depth"] = np.rint(getattr(clip, f"{side}_depth") / DEPTH_UNIT_M).astype(np.uint16)
        strips[f"{side}.classes"] = getattr(clip, f"{side}_classes")
        strips[f"{side}.instances"] = clip.source_instances
    return {kind: np.ascontiguousarray(np.concatenate(frames)) for kind, frames in strips.items()}


def seen_of(clip: PairedClip, cameras: CameraPair | None = None, **more: Any) -> SourceClip:
    """What a predictor gets of a clip; by default from the usual vehicle. more: other fields."""
    frames, height, width = clip.source.shape[:3]
    usual = CameraPair.driving(CameraMount(), frames=frames, height=height, width=width)
    given = {
        "source": clip.source,
        "source_depth": clip.source_depth,
        "source_classes": clip.source_classes,
        "fps": 10.0,
    }
    return SourceClip(cameras=cameras or usual, **(given | more))


def evaluated(predictors: Sequence[Predictor], clips: PlaneClips) -> list[Sums]:
    """Figures of each on these pairs."""
    pairs = PairedSet.of(clips, "plane")
    of = [[measured(each, pairs.clip(key), classes=pairs.classes)[1] for key in pairs.keys] for each in predictors]
    return [ClipTable.of(records, len(pairs.classes)).scene_sums() for records in of]
