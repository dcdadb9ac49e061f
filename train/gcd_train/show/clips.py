"""A clip of a scene in one of the published layouts, ready to look at."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model.errors import FileError
from gcd_model.geometry import (
    DRIVING_GOAL_TARGET,
    LOOK_AT,
    Intrinsics,
    center_crop_box,
    from_pose,
    spherical_trajectory,
)
from gcd_model.small_files import read_json
from gcd_train.datasets.dataset4d import Dataset4D
from gcd_train.datasets.kubric4d import Kubric4D
from gcd_train.datasets.picture_files import MOST_TEXT, bytes_read
from gcd_train.datasets.pictures_of_draws import trained_picture
from gcd_train.datasets.trajectories import DRIVING, DRIVING_FRAMES, KUBRIC_FRAMES, MAX90, FrameSampling, generator
from gcd_train.errors import DataError, RecipeError
from gcd_train.layouts import kubric4d_names
from gcd_train.layouts.manifest import read_manifest
from gcd_train.pointcloud import depth_visibility, render_lens, splat, visibility
from gcd_train.scene_view import SceneView
from gcd_train.show.colours import SKY_M, instance_colour
from gcd_train.show.footage import Bytes, Footage, LabelName
from gcd_train.show.targets import Poses, target_pictures

Number = TypeVar("Number", bound=np.generic)

_WIDTH = 384
_SHAPE = 1.5  # of the trained pictures


@dataclass(frozen=True, kw_only=True, slots=True)
class ShowOptions:
    """Which clip. start, stride: frames of the scene, drawn with the seed where None. seed: of clip and camera path.

    exact: draw the target from a scene's kept geometry where there is one, else always from points.
    """

    start: int | None = None
    stride: int | None = None
    seed: int = 0
    exact: bool = True


@dataclass(frozen=True, kw_only=True, slots=True)
class _Path:
    """world_from_source: f64 [4, 4]. world_from_target: f64 [T, 4, 4]. told: the path in words."""

    world_from_source: NDArray[np.float64]
    world_from_target: Poses
    told: str


def dataset_clip(data: Dataset4D, scene: str, options: ShowOptions) -> Footage:
    """A clip of a scene. Raises: FileFault naming the file that cannot be read, RecipeError for frames that are not."""
    before = bytes_read()
    on_sphere = isinstance(data, Kubric4D)
    numbers, stride = _frame_numbers(data.frames(scene), KUBRIC_FRAMES if on_sphere else DRIVING_FRAMES, options)
    views = [data.views(scene, number, [data.source_camera])[0] for number in numbers]
    width = min(_WIDTH, views[0].lens.width)
    size = (width, round(width / _SHAPE))
    lens = render_lens(views[0].lens, *size)
    pose = views[0].world_from_camera
    path = _orbit(pose, len(numbers), options.seed) if on_sphere else _drive(len(numbers))
    targets = target_pictures(data, scene, numbers, path.world_from_target, lens, exact=options.exact)
    seen = [
        visibility(view, at, lens, width=size[0], height=size[1])
        if targets.depth is None
        else depth_visibility(view, targets.depth[number], at, lens)
        for number, (view, at) in enumerate(zip(views, path.world_from_target, strict=True))
    ]
    labels, kind, names = _labels(data, scene, views, size)
    return Footage(
        title=_title(data.folder(scene), "Kubric-4D" if on_sphere else "ParallelDomain-4D"),
        layout=str(data.folder(scene)),
        path=path.told,
        frame_numbers=numbers,
        fps=data.fps / stride,
        scene_frames=data.frames(scene),
        scene_fps=data.fps,
        cameras=tuple(data.cameras),
        source_camera=data.source_camera,
        hfov_deg=lens.hfov_deg,
        source=np.stack([trained_picture(view.rgb, *size) for view in views]),
        target=targets.colour,
        target_is=targets.told,
        splat=np.stack([_splatted(view, at, lens) for view, at in zip(views, path.world_from_target, strict=True)]),
        visible=np.stack(seen),
        visible_is="published rule" if targets.depth is None else "depths agree within 2 %",
        surface=np.ones_like(seen, np.bool_) if targets.depth is None else _is_surface(targets.depth),
        labels=labels,
        kind=kind,
        names=names,
        depth=np.stack([nearest_resized(view.depth, *size) for view in views]),
        world_from_source=np.repeat(path.world_from_source[None], len(numbers), axis=0),
        world_from_target=path.world_from_target,
        look_at=LOOK_AT if on_sphere else DRIVING_GOAL_TARGET,
        world="world: z up, ground at z = 0" if on_sphere else "vehicle: x ahead, y left, z up, ground at z = 0",
        bytes_read=bytes_read() - before,
    )


def _title(folder: Path, layout: str) -> str:
    """Scene, layout and, of our own scenes, the world it was made in."""
    try:
        world = read_manifest(folder).world
        scale = " (1 m here is 1 dm)" if world.startswith("tabletop") else ""
        return f"{folder.name}, {world} world{scale}, {layout} layout"
    except DataError:
        return f"{folder.name}, {layout} layout"


def _is_surface(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    return (depth > 0) & (depth < SKY_M)


def nearest_resized(picture: NDArray[Number], width: int, height: int) -> NDArray[Number]:
    """Depth or ids [H, W] cropped and resized as `trained_picture` does colours, without mixing neighbours."""
    left, top, across, along = center_crop_box(picture.shape[1], picture.shape[0], width / height)
    rows = top + ((np.arange(height) + 0.5) * along / height).astype(np.intp)
    columns = left + ((np.arange(width) + 0.5) * across / width).astype(np.intp)
    return picture[rows[:, None], columns]


def _frame_numbers(frames: int, sampling: FrameSampling, options: ShowOptions) -> tuple[tuple[int, ...], int]:
    """The clip's frames and stride; of a scene that is too short all of its frames."""
    clip = sampling.clip
    strides = sampling.strides if options.stride is None else (options.stride,)
    if options.stride is None and options.start is None and sampling.last_start(frames, 1) < 0:
        return tuple(range(min(frames, clip))), 1
    reaching = replace(sampling, strides=strides, reach_last=True, reverse=0.0, latest_start=None)
    if options.start is None:
        numbers, stride, _ = reaching.draw(generator(options.seed, 0), frames)
        return numbers, stride
    for stride in strides if options.stride else (1,):
        if 0 <= options.start <= reaching.last_start(frames, stride):
            return tuple(range(options.start, options.start + clip * stride, stride)), stride
    stride = options.stride or 1
    raise RecipeError(
        f"the scene has {frames} frames: with stride {stride} a clip of {clip} may start at 0 to "
        f"{reaching.last_start(frames, stride)}, got {options.start}; change --start or --stride"
    )


def _orbit(world_from_source: NDArray[np.float64], frames: int, seed: int) -> _Path:
    """A path as training draws it (max90, gradual), from where the source camera really stands."""
    import torch

    start = from_pose(torch.from_numpy(world_from_source))
    change = MAX90.change(generator(seed, 1), start)
    path = spherical_trajectory(start, change, frames=frames, move_time=frames - 1)
    return _Path(
        world_from_source=world_from_source,
        world_from_target=world_from_source @ path.source_from_target.numpy(),
        told=(
            f"azimuth {change.azimuth_deg:+.1f}°, elevation {change.elevation_deg:+.1f}°,\n"
            f"radius {change.radius_m:+.1f} m, from {start.azimuth_deg:.0f}°, {start.elevation_deg:.0f}°, "
            f"{start.radius_m:.1f} m"
        ),
    )


def _drive(frames: int) -> _Path:
    """ParallelDomain-4D's path, gradual."""
    draw = replace(DRIVING, frames=FrameSampling(clip=frames, reach_last=True)).draw(generator(0, 0), frames, 1.0)
    from_x, _, from_z = draw.world_from_target[0, :3, 3]
    to_x, _, to_z = draw.world_from_target[-1, :3, 3]
    return _Path(
        world_from_source=draw.world_from_source,
        world_from_target=draw.world_from_target,
        told=f"up and back at a sine pace\nx {from_x:.1f} to {to_x:.1f} m, z {from_z:.2f} to {to_z:.2f} m",
    )


def _splatted(view: SceneView, world_from_camera: NDArray[np.float64], lens: Intrinsics) -> Bytes:
    return (splat([view], world_from_camera, lens).colour * 255).round().byte().cpu().numpy()


def _labels(
    data: Dataset4D, scene: str, views: list[SceneView], size: tuple[int, int]
) -> tuple[NDArray[np.int32] | None, str, tuple[LabelName, ...]]:
    """Ids over time, whether they are classes or instances, and their names."""
    ontology = data.ontology
    if ontology is not None and all(view.classes is not None for view in views):
        ids = [view.classes for view in views]
        names = tuple(LabelName(id=item.id, name=item.name, colour=item.colour) for item in ontology.items)
        return np.stack([nearest_resized(i, *size) for i in ids if i is not None]).astype(np.int32), "class", names
    found = [view.instances for view in views if view.instances is not None]
    if len(found) < len(views):
        return None, "class", ()
    labels = np.stack([nearest_resized(ids, *size) for ids in found]).astype(np.int32)
    told = _asset_names(data.folder(scene), data.source_camera)
    names = tuple(
        LabelName(id=int(i), name=told.get(int(i), f"instance {i}") if i else "background", colour=instance_colour(i))
        for i in np.unique(labels)
    )
    return labels, "instance", names


class _Asset(msgspec.Struct, frozen=True):
    asset_id: str = ""


class _Assets(msgspec.Struct, frozen=True):
    instances: tuple[_Asset, ...] = ()


def _asset_names(folder: Path, camera: str) -> dict[int, str]:
    """What instances 1, 2, ... are called in the metadata of a Kubric-4D view; empty where it does not tell."""
    path = kubric4d_names.metadata_path(folder, int(camera.removeprefix("view") or 0))
    try:
        assets = read_json(path, _Assets, MOST_TEXT).instances
    except FileError:
        return {}  # names are decoration; the reader has checked what matters in this file
    return {number: f"{asset.asset_id} ({number})" for number, asset in enumerate(assets, 1) if asset.asset_id}
