"""A clip of a scene in one of the published layouts, ready to look at."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model.errors import FileError
from gcd_model.geometry import (
    DRIVING_GOAL_TARGET,
    LOOK_AT,
    Intrinsics,
    from_pose,
    spherical_trajectory,
)
from gcd_model.small_files import read_json
from gcd_train.data.dataset4d import Dataset4D
from gcd_train.data.files import MOST_TEXT, bytes_read
from gcd_train.data.kubric4d import Kubric4D
from gcd_train.data.paths import DRIVING, DRIVING_FRAMES, KUBRIC_FRAMES, MAX90, FrameSampling, generator
from gcd_train.data.pictures import trained_picture
from gcd_train.data.sample import SceneView
from gcd_train.errors import DataError, RecipeError, RenderError
from gcd_train.evaluation.clips import nearest_resized
from gcd_train.layouts import kubric4d
from gcd_train.layouts.manifest import GEOMETRY, SceneManifest, read_manifest
from gcd_train.look.clip import SKY_M, Bytes, Footage, LabelName, instance_colour, splatted
from gcd_train.pointcloud import depth_visibility, published_picture, render_lens, visibility
from gcd_train.scenes.frozen import FrozenScene

Poses = NDArray[np.float64]
_CAMERAS = 6


@dataclass(frozen=True, kw_only=True, slots=True)
class TargetPictures:
    """colour: u8 [T, H, W, 3]. depth: f32 [T, H, W] metres, None where it is not known. told: how they were made."""

    colour: Bytes
    depth: NDArray[np.float32] | None
    told: str


def target_pictures(
    data: Dataset4D, scene: str, numbers: Sequence[int], world_from_target: Poses, lens: Intrinsics, *, exact: bool
) -> TargetPictures:
    """The scene's frames `numbers` from poses [T, 4, 4]. Raises FileFault naming what cannot be read."""
    folder = data.folder(scene)
    if exact and (folder / GEOMETRY).exists():
        try:
            manifest = read_manifest(folder)
            return _rendered(FrozenScene.load(folder / GEOMETRY), manifest, numbers, world_from_target, lens)
        except RenderError:
            pass  # no renderer on this machine; points need none
    cameras = _nearest(data, scene, numbers[0], world_from_target)
    colour = [
        published_picture(
            [_thinned(view) for view in data.views(scene, number, cameras)],
            pose,
            lens,
            width=lens.width,
            height=lens.height,
        )
        for number, pose in zip(numbers, world_from_target, strict=True)
    ]
    return TargetPictures(colour=np.stack(colour), depth=None, told=f"points of the\n{len(cameras)} nearest cameras")


def _rendered(
    scene: FrozenScene, manifest: SceneManifest, numbers: Sequence[int], poses: Poses, lens: Intrinsics
) -> TargetPictures:
    try:
        from gcd_train.scenes.renderer import Renderer  # an extra
    except ImportError as error:
        raise RenderError(f"no renderer ({error})") from error
    if manifest.world_from_vehicle is not None:
        poses = np.array(manifest.world_from_vehicle, np.float64)[list(numbers)] @ poses
    moments = replace(scene, poses=scene.poses[list(numbers)], focus=scene.focus[list(numbers)], hfov_deg=lens.hfov_deg)
    with Renderer(lens.width, lens.height, oversample=1) as renderer:
        views = [view for _, _, view in renderer.views(moments, {"target": poses})]
    return TargetPictures(
        colour=np.stack([view.rgb for view in views]),
        depth=np.stack([view.depth for view in views]),
        told="rendered from the\nscene's geometry",
    )


def _nearest(data: Dataset4D, scene: str, time: int, world_from_target: Poses) -> list[str]:
    """The source and the cameras that see most of what the path sees: by place and direction at its ends and middle."""
    views = {camera: data.views(scene, time, [camera])[0] for camera in data.cameras}
    ends = world_from_target[[0, len(world_from_target) // 2, -1]]

    def far(camera: str) -> float:
        pose = views[camera].world_from_camera
        apart = np.linalg.norm(ends[:, :3, 3] - pose[:3, 3], axis=1)
        turned = 1.0 - ends[:, :3, 2] @ pose[:3, 2]
        return float((apart / 10.0 + turned).min())

    others = sorted((camera for camera in data.cameras if camera != data.source_camera), key=far)
    return [data.source_camera, *others[: _CAMERAS - 1]]


def _thinned(view: SceneView, factor: int = 2) -> SceneView:
    """Every other pixel of a view; a large picture still has more points than the target pixels."""
    if view.lens.width < 400:
        return view
    lens, first = view.lens, factor // 2
    rgb, depth = (np.ascontiguousarray(rows[first::factor, first::factor]) for rows in (view.rgb, view.depth))
    thin = Intrinsics(
        fx=lens.fx / factor,
        fy=lens.fy / factor,
        cx=(lens.cx - first - 0.5) / factor + 0.5,
        cy=(lens.cy - first - 0.5) / factor + 0.5,
        width=rgb.shape[1],
        height=rgb.shape[0],
    )
    return replace(view, rgb=rgb, depth=depth, classes=None, instances=None, lens=thin)


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
    still, poses, told = _orbit(pose, len(numbers), options.seed) if on_sphere else _drive(len(numbers))
    targets = target_pictures(data, scene, numbers, poses, lens, exact=options.exact)
    seen = [
        visibility(view, at, lens, width=size[0], height=size[1])
        if targets.depth is None
        else depth_visibility(view, targets.depth[number], at, lens)
        for number, (view, at) in enumerate(zip(views, poses, strict=True))
    ]
    labels, kind, names = _labels(data, scene, views, size)
    depth = targets.depth
    surface = np.ones_like(seen, np.bool_) if depth is None else (depth > 0) & (depth < SKY_M)
    return Footage(
        title=_title(data.folder(scene), "Kubric-4D" if on_sphere else "ParallelDomain-4D"),
        layout=str(data.folder(scene)),
        path=told,
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
        splat=np.stack([splatted(view, at, lens) for view, at in zip(views, poses, strict=True)]),
        visible=np.stack(seen),
        visible_is="published rule" if targets.depth is None else "depths agree within 2 %",
        surface=surface,
        labels=labels,
        kind=kind,
        names=names,
        depth=np.stack([nearest_resized(view.depth, *size) for view in views]),
        world_from_source=np.repeat(still[None], len(numbers), axis=0),
        world_from_target=poses,
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


def _orbit(world_from_source: NDArray[np.float64], frames: int, seed: int) -> tuple[Poses, Poses, str]:
    """The source's pose, the target's and the path in words: as training draws it (max90, gradual)."""
    start = from_pose(torch.from_numpy(world_from_source))
    change = MAX90.change(generator(seed, 1), start)
    path = spherical_trajectory(start, change, frames=frames, move_time=frames - 1)
    told = (
        f"azimuth {change.azimuth_deg:+.1f}°, elevation {change.elevation_deg:+.1f}°,\n"
        f"radius {change.radius_m:+.1f} m, from {start.azimuth_deg:.0f}°, {start.elevation_deg:.0f}°, "
        f"{start.radius_m:.1f} m"
    )
    return world_from_source, world_from_source @ path.source_from_target.numpy(), told


def _drive(frames: int) -> tuple[Poses, Poses, str]:
    """The same of ParallelDomain-4D's path, gradual."""
    draw = replace(DRIVING, frames=FrameSampling(clip=frames, reach_last=True)).draw(generator(0, 0), frames, 1.0)
    from_x, _, from_z = draw.world_from_target[0, :3, 3]
    to_x, _, to_z = draw.world_from_target[-1, :3, 3]
    told = f"up and back at a sine pace\nx {from_x:.1f} to {to_x:.1f} m, z {from_z:.2f} to {to_z:.2f} m"
    return draw.world_from_source, draw.world_from_target, told


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
    path = kubric4d.metadata_path(folder, int(camera.removeprefix("view") or 0))
    try:
        assets = read_json(path, _Assets, MOST_TEXT).instances
    except FileError:
        return {}  # names are decoration; the reader has checked what matters in this file
    return {number: f"{asset.asset_id} ({number})" for number, asset in enumerate(assets, 1) if asset.asset_id}
