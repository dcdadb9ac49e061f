"""`gcd-train show`: from a path to the clip that is shown, of a scene in a published layout or of pair shards."""

import os
import zipfile
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from typer import Option

from gcd_model.geometry import DRIVING_GOAL_TARGET, LOOK_AT, Intrinsics, from_pose, spherical_trajectory
from gcd_model.small_files import decode_json
from gcd_train.data import kubric4d, parallel_domain4d
from gcd_train.data.dataset4d import Dataset4D, Ontology, OntologyItem, layout_of, read_ontology
from gcd_train.data.files import GEOMETRY, ZIP_FAULTS, read_manifest, read_member
from gcd_train.data.kubric4d import Kubric4D
from gcd_train.data.pairs import PairedClips
from gcd_train.data.parallel_domain4d import ParallelDomain4D
from gcd_train.data.paths import DRIVING, DRIVING_FRAMES, KUBRIC_FRAMES, MAX90, Draw, FrameSampling, generator
from gcd_train.data.pictures import PictureOptions, pictures_of
from gcd_train.data.sample import Sample, SceneView
from gcd_train.data.visibility import depth_visibility, render_lens
from gcd_train.errors import DataError, RecipeError, RenderError
from gcd_train.look.sheet import Footage, Poses

_WIDTH = 384
_SHAPE = 1.5  # of the trained pictures
_STAGE, _VEHICLE = "world: z up, ground at z = 0", "vehicle: x ahead, y left, z up, ground at z = 0"


@dataclass(frozen=True, kw_only=True, slots=True)
class ShowOptions:
    """Which clip is shown: options of `gcd-train show`."""

    seed: Annotated[
        int | None,
        Option(min=0, help="Draws clip and camera path; of pair shards the clip's own."),
    ] = None
    points: Annotated[
        bool, Option("--points", help="Draw the target from the cameras' points, not from geometry.npz.")
    ] = False


def open_scene(path: Path, options: ShowOptions) -> Footage:
    """The clip of a scene folder, or of a folder of pair shards.

    Raises: DataError if there is no such folder or it is of no known layout, FileFault (a DataError) naming the file
    that cannot be read, RecipeError for a seed of no clip.
    """
    path = path.resolve()
    if path.suffix == ".zip" or (path / "world.json").exists():
        return _pair_clip(path, options.seed)
    if not path.is_dir():
        raise DataError(f"{path} is no folder; give a scene such as scn00000 or scene_000000, or pair shards")
    return _scene_clip(_data_set(path), path.name, options)


def _data_set(path: Path) -> Dataset4D:
    """Of one scene, with the cameras that are there: to look at it not all are needed. Raises DataError, FileFault."""
    layout = layout_of(path.name)
    if layout == "kubric4d":
        views = [camera for camera in kubric4d.CAMERAS if os.path.lexists(kubric4d.metadata_path(path, camera))]
        return Kubric4D(path.parent, [path.name], cameras=views or kubric4d.CAMERAS, instances=True)
    if layout == "parallel_domain4d":
        cameras = [camera for camera in parallel_domain4d.CAMERAS if (path / "rgb" / camera).is_dir()]
        classes = (path / "semantic_segmentation_2d").is_dir()
        return ParallelDomain4D(
            path.parent,
            [path.name],
            cameras=cameras or parallel_domain4d.CAMERAS,
            classes=classes,
            ontology=read_ontology(parallel_domain4d.ontology_folder(path)) if classes else None,
        )
    scenes = sorted(child.name for child in path.iterdir() if child.is_dir() and layout_of(child.name))
    if scenes:
        raise DataError(f"{path} is a set of {len(scenes)} scenes; show one, such as {path / scenes[0]}")
    raise DataError(
        f"{path} is no scene: its name is neither scnNNNNN (Kubric-4D) nor scene_NNNNNN (ParallelDomain-4D), and it "
        "has no world.json (pair shards); give the folder of one scene, with its own name"
    )


def _scene_clip(data: Dataset4D, scene: str, options: ShowOptions) -> Footage:
    """A clip of a scene. Raises FileFault naming the file that cannot be read."""
    on_sphere, folder, every = isinstance(data, Kubric4D), data.folder(scene), data.frames(scene)
    seed = options.seed or 0
    sampling = replace(KUBRIC_FRAMES if on_sphere else DRIVING_FRAMES, reach_last=True, reverse=0.0, latest_start=None)
    if sampling.last_start(every, 1) < 0:  # a scene that is too short is shown whole
        numbers, stride = tuple(range(min(every, sampling.clip))), 1
    else:
        numbers, stride = sampling.draw(generator(seed, 0), every)
    views = [data.views(scene, number, [data.source_camera])[0] for number in numbers]
    width = min(_WIDTH, views[0].lens.width)
    lens, pose = render_lens(views[0].lens, width, round(width / _SHAPE)), views[0].world_from_camera
    still, poses, path = _orbit(pose, len(numbers), seed) if on_sphere else _drive(len(numbers))
    draw = Draw(frame_numbers=numbers, fps=data.fps / stride, world_from_source=still, world_from_target=poses)
    sample, target_is = _sample(data, scene, draw, (lens.width, lens.height), exact=not options.points)
    layout = "Kubric-4D layout" if on_sphere else "ParallelDomain-4D layout"
    with suppress(DataError):  # of our own scenes, the world
        layout = f"{_world_name(read_manifest(folder).world)}, {layout}"
    return Footage(
        title=f"{folder.name}, {layout}",
        path=path,
        scene=f"{every} frames at {data.fps:g} fps, {len(data.cameras)} cameras",
        source_camera=data.source_camera,
        lens=lens,
        views=views,
        poses=poses,
        sample=sample,
        target_is=target_is,
        ontology=data.ontology if all(view.classes is not None for view in views) else None,
        look_at=LOOK_AT if on_sphere else DRIVING_GOAL_TARGET,
        world=_STAGE if on_sphere else _VEHICLE,
    )


def _orbit(world_from_source: NDArray[np.float64], frames: int, seed: int) -> tuple[Poses, Poses, str]:
    """The source's pose, the target's and the path in words: as training draws it (max90, gradual)."""
    start = from_pose(torch.from_numpy(world_from_source))
    change = MAX90.change(generator(seed, 1), start)
    path = spherical_trajectory(start, change, frames=frames, move_time=frames - 1)
    words = (
        f"azimuth {change.azimuth_deg:+.1f}°, elevation {change.elevation_deg:+.1f}°, "
        f"radius {change.radius_m:+.1f} m, from {start.azimuth_deg:.0f}°, {start.elevation_deg:.0f}°, "
        f"{start.radius_m:.1f} m"
    )
    return world_from_source, world_from_source @ path.source_from_target.numpy(), words


def _drive(frames: int) -> tuple[Poses, Poses, str]:
    """The same of ParallelDomain-4D's path, gradual."""
    draw = replace(DRIVING, frames=FrameSampling(clip=frames, reach_last=True)).draw(generator(0, 0), frames, 1.0)
    from_x, _, from_z = draw.world_from_target[0, :3, 3]
    to_x, _, to_z = draw.world_from_target[-1, :3, 3]
    words = f"up and back at a sine pace, x {from_x:.1f} to {to_x:.1f} m, z {from_z:.2f} to {to_z:.2f} m"
    return draw.world_from_source, draw.world_from_target, words


def _sample(data: Dataset4D, scene: str, draw: Draw, size: tuple[int, int], *, exact: bool) -> tuple[Sample, str]:
    """The target and what of it the source camera saw, and how they were made. Raises DataError, FileFault."""
    options = PictureOptions(size=size, visible=True)
    if exact and (data.folder(scene) / GEOMETRY).exists():
        with suppress(RenderError):  # no renderer on this machine; points need none
            exactly = pictures_of(data, replace(options, exact=True)).sample(scene, draw)
            return exactly, "rendered from the scene's geometry"
    return pictures_of(data, options).sample(scene, draw), f"points of all {len(data.cameras)} cameras"


def _world_name(world: str) -> str:
    return f"{world} world" + (" (1 m here is 1 dm)" if world.startswith("tabletop") else "")


def _pair_clip(path: Path, seed: int | None) -> Footage:
    """A finished clip as it was rendered, in its world or, in driving, in the vehicle's frame.

    seed: by default of the first clip of the shard or folder. Raises: DataError naming the shard, RecipeError for an
    unknown seed.
    """
    folder = path.parent if path.suffix == ".zip" else path
    if seed is None and path.suffix == ".zip" and (number := path.stem.split("-")[1:2]) and number[0].isdecimal():
        seed = int(number[0])
    clips = PairedClips.open(folder)
    if seed is not None and seed not in clips.seeds:
        low, high = clips.seeds[0], clips.seeds[-1]
        raise RecipeError(f"{folder} has no clip of seed {seed}; it has {len(clips)}, {low} to {high}")
    index = 0 if seed is None else clips.seeds.index(seed)
    clip, sample = clips[index], clips.sample(index)
    sources, targets = _pair_poses(*clips.places[index])
    lens = Intrinsics.from_hfov(clips.world.hfov_deg, clips.width, clips.height)
    if clips.mount is None:
        orbit = clips.orbit(index)
        words = "{:+.1f}° azimuth, {:+.1f}° elevation, {:+.1f} m radius, gradual".format(*orbit.change)
        sample = replace(sample, frame_numbers=orbit.frame_numbers)
    else:
        words, still = "the driving path, up and back at a sine pace", clips.mount.vehicle_from_camera.numpy()
        targets = still @ np.linalg.inv(sources) @ targets
        sources = np.broadcast_to(still, targets.shape)
    views = [
        SceneView(
            rgb=clip.source[t],
            depth=clip.source_depth[t],
            classes=clip.source_classes[t] if clips.classes else None,
            instances=clip.source_instances[t].astype(np.uint16),
            world_from_camera=sources[t],
            lens=lens,
        )
        for t in range(clips.frames)
    ]
    seen = [depth_visibility(view, clip.target_depth[t], targets[t], lens) for t, view in enumerate(views)]
    kinds = tuple(OntologyItem(id=i, name=each.name, colour=each.colour) for i, each in enumerate(clips.classes))
    return Footage(
        title=f"pair shard, {_world_name(clips.world.name)}, seed {clip.seed}",
        path=words,
        scene=f"{sample.frame_numbers[-1] + 1} frames at {clips.fps * clips.world.stride:g} fps, 2 cameras",
        source_camera="source",
        lens=lens,
        views=views,
        poses=targets,
        sample=replace(sample, visible=np.stack(seen), target_depth=clip.target_depth),
        target_is="rendered exactly",
        ontology=Ontology(kinds) if kinds else None,
        look_at=LOOK_AT if clips.mount is None else DRIVING_GOAL_TARGET,
        world=_STAGE if clips.mount is None else _VEHICLE,
    )


def _pair_poses(shard: Path, name: str) -> tuple[Poses, Poses]:
    """Of source and target, [T, 4, 4] each, from a clip's `scene.json`."""
    try:
        with zipfile.ZipFile(shard) as archive:
            poses = decode_json(read_member(archive, f"{name}/scene.json"), dict[str, Any])["world_from_camera"]
        return np.array(poses["source"], np.float64), np.array(poses["target"], np.float64)
    except (*ZIP_FAULTS, TypeError) as error:
        raise DataError(
            f"{shard}: {name}/scene.json is damaged ({error}); delete the shard, generate it again"
        ) from error
