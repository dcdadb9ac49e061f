"""A clip of pair shards (`gcd-train generate WORLD --pairs`), ready to look at."""

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import DRIVING_GOAL_TARGET, LOOK_AT, Intrinsics
from gcd_model.small_files import decode_json
from gcd_train.array_files import ZIP_FAULTS, read_member
from gcd_train.datasets.paired import PairedClip, PairedClips
from gcd_train.errors import DataError, RecipeError
from gcd_train.pointcloud import depth_visibility, splat
from gcd_train.scene_view import SceneView
from gcd_train.show.colours import SKY_M, instance_colour
from gcd_train.show.footage import Footage, LabelName


def pair_clip(folder: Path, seed: int | None) -> Footage:
    """The clip of a seed, by default the first. Raises: DataError naming the shard, RecipeError for an unknown seed."""
    clips = PairedClips.open(folder)
    seeds = [clips.seed(number) for number in range(len(clips))]
    if seed is not None and seed not in seeds:
        raise RecipeError(f"{folder} has no clip of seed {seed}; it has {len(seeds)}, {seeds[0]} to {seeds[-1]}")
    index = 0 if seed is None else seeds.index(seed)
    clip = clips[index]
    poses, hfov_deg = _told(*clips.places[index])
    lens = Intrinsics.from_hfov(hfov_deg, clips.width, clips.height)
    views = [
        SceneView(rgb=rgb, depth=depth, classes=None, instances=None, world_from_camera=pose, lens=lens)
        for rgb, depth, pose in zip(clip.source, clip.source_depth, poses["source"], strict=True)
    ]
    targets = list(zip(views, clip.target_depth, poses["target"], strict=True))
    setting = _setting(clips, index, poses)
    return Footage(
        title=f"pair shard, {clips.world.name} world{_scale(clips)}, seed {clip.seed}",
        layout=str(clips.places[index][0]),
        path=setting.path,
        frame_numbers=setting.frame_numbers,
        fps=clips.fps,
        scene_frames=setting.scene_frames,
        scene_fps=clips.fps * clips.world.stride,
        cameras=tuple(poses),
        source_camera="source",
        hfov_deg=lens.hfov_deg,
        source=clip.source,
        target=clip.target,
        target_is="rendered exactly",
        splat=np.stack(
            [(splat([view], pose, lens).colour * 255).round().byte().cpu().numpy() for view, _, pose in targets]
        ),
        visible=np.stack([depth_visibility(view, depth, pose, lens) for view, depth, pose in targets]),
        visible_is="depths agree within 2 %",
        surface=(clip.target_depth > 0) & (clip.target_depth < SKY_M),
        labels=(clip.source_classes if clips.classes else clip.source_instances).astype(np.int32),
        kind="class" if clips.classes else "instance",
        names=_names(clips, clip),
        depth=clip.source_depth,
        world_from_source=setting.world_from_source,
        world_from_target=setting.world_from_target,
        look_at=setting.look_at,
        world=setting.axes,
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class _Setting:
    """What differs between a drive and an orbit; the fields are those of `Footage`."""

    path: str
    frame_numbers: tuple[int, ...]
    scene_frames: int
    world_from_source: NDArray[np.float64]
    world_from_target: NDArray[np.float64]
    look_at: tuple[float, float, float]
    axes: str


def _setting(clips: PairedClips, index: int, poses: dict[str, NDArray[np.float64]]) -> _Setting:
    if clips.mount is not None:
        vehicle_from_source = clips.mount.vehicle_from_camera.numpy()
        return _Setting(
            path="the driving path, up and back\nat a sine pace",
            frame_numbers=tuple(range(clips.frames)),
            scene_frames=clips.frames,
            world_from_source=np.repeat(vehicle_from_source[None], clips.frames, axis=0),
            world_from_target=vehicle_from_source @ np.linalg.inv(poses["source"]) @ poses["target"],
            look_at=DRIVING_GOAL_TARGET,
            axes="vehicle: x ahead, y left, z up, ground at z = 0",
        )
    orbit = clips.orbit(index)
    azimuth_deg, elevation_deg, radius_m = orbit.change
    return _Setting(
        path=f"{azimuth_deg:+.1f}\N{DEGREE SIGN} azimuth, {elevation_deg:+.1f}\N{DEGREE SIGN} elevation,\n"
        f"{radius_m:+.1f} m radius, gradual",
        frame_numbers=orbit.frame_numbers,
        scene_frames=orbit.frame_numbers[-1] + 1,
        world_from_source=poses["source"],
        world_from_target=poses["target"],
        look_at=LOOK_AT,
        axes="world: z up, ground at z = 0",
    )


def _scale(clips: PairedClips) -> str:
    return " (1 m here is 1 dm)" if clips.world.name.startswith("tabletop") else ""


def _names(clips: PairedClips, clip: PairedClip) -> tuple[LabelName, ...]:
    if clips.classes:
        return tuple(LabelName(id=i, name=kind.name, colour=kind.colour) for i, kind in enumerate(clips.classes))
    numbers = np.unique(clip.source_instances).tolist()
    told = {0: "background"}
    return tuple(LabelName(id=i, name=told.get(i, f"instance {i}"), colour=instance_colour(i)) for i in numbers)


def _told(shard: Path, name: str) -> tuple[dict[str, NDArray[np.float64]], float]:
    """Poses [T, 4, 4] by camera, and the horizontal field of view, of a clip's `scene.json`."""
    try:
        with zipfile.ZipFile(shard) as archive:
            told = decode_json(read_member(archive, f"{name}/scene.json"), dict[str, Any])
        poses = {camera: np.array(rows, np.float64) for camera, rows in told["world_from_camera"].items()}
        return {camera: poses[camera] for camera in ("source", "target")}, float(told["facts"]["hfov_deg"])
    except (*ZIP_FAULTS, TypeError, AttributeError) as error:
        raise DataError(
            f"{shard}: {name}/scene.json is damaged ({error}); delete the shard, generate it again"
        ) from error
