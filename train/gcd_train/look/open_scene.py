"""From a path to what is shown: which layout it is, and which clip; clips of pair shards."""

import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import DRIVING_GOAL_TARGET, LOOK_AT, Intrinsics
from gcd_model.small_files import decode_json
from gcd_train.data.dataset4d import read_ontology
from gcd_train.data.files import ZIP_FAULTS, read_member
from gcd_train.data.kubric4d import Kubric4D
from gcd_train.data.pairs import PairedClip, PairedClips
from gcd_train.data.parallel_domain4d import ParallelDomain4D
from gcd_train.data.sample import SceneView
from gcd_train.errors import DataError, RecipeError
from gcd_train.layouts import kubric4d, parallel_domain4d
from gcd_train.look.clip import SKY_M, Footage, LabelName, instance_colour, splatted
from gcd_train.look.scene_clip import ShowOptions, dataset_clip
from gcd_train.pointcloud import depth_visibility


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
    scale = " (1 m here is 1 dm)" if clips.world.name.startswith("tabletop") else ""
    shown = Footage(
        title=f"pair shard, {clips.world.name} world{scale}, seed {clip.seed}",
        layout=str(clips.places[index][0]),
        path="the driving path, up and back\nat a sine pace",
        frame_numbers=tuple(range(clips.frames)),
        fps=clips.fps,
        scene_frames=clips.frames,
        scene_fps=clips.fps * clips.world.stride,
        cameras=tuple(poses),
        source_camera="source",
        hfov_deg=lens.hfov_deg,
        source=clip.source,
        target=clip.target,
        target_is="rendered exactly",
        splat=np.stack([splatted(view, pose, lens) for view, _, pose in targets]),
        visible=np.stack([depth_visibility(view, depth, pose, lens) for view, depth, pose in targets]),
        visible_is="depths agree within 2 %",
        surface=(clip.target_depth > 0) & (clip.target_depth < SKY_M),
        labels=(clip.source_classes if clips.classes else clip.source_instances).astype(np.int32),
        kind="class" if clips.classes else "instance",
        names=_names(clips, clip),
        depth=clip.source_depth,
        world_from_source=poses["source"],
        world_from_target=poses["target"],
        look_at=LOOK_AT if clips.mount is None else DRIVING_GOAL_TARGET,
        world="world: z up, ground at z = 0",
    )
    if clips.mount is not None:
        vehicle_from_source = clips.mount.vehicle_from_camera.numpy()
        return replace(
            shown,
            world_from_source=np.repeat(vehicle_from_source[None], clips.frames, axis=0),
            world_from_target=vehicle_from_source @ np.linalg.inv(poses["source"]) @ poses["target"],
            world="vehicle: x ahead, y left, z up, ground at z = 0",
        )
    orbit = clips.orbit(index)
    azimuth_deg, elevation_deg, radius_m = orbit.change
    return replace(
        shown,
        path=f"{azimuth_deg:+.1f}\N{DEGREE SIGN} azimuth, {elevation_deg:+.1f}\N{DEGREE SIGN} elevation,\n"
        f"{radius_m:+.1f} m radius, gradual",
        frame_numbers=orbit.frame_numbers,
        scene_frames=orbit.frame_numbers[-1] + 1,
    )


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


def open_scene(path: Path, options: ShowOptions, clip_seed: int | None = None) -> Footage:
    """The clip of a scene folder, or of a folder of pair shards.

    clip_seed: of which clip, in pair shards only.
    Raises: DataError if there is no such folder or it is of no known layout, FileFault (a DataError) naming the file
    that cannot be read, RecipeError for options that do not fit.
    """
    path = path.resolve()
    if path.suffix == ".zip" or (path / "world.json").exists():
        if options.start is not None or options.stride is not None:
            raise RecipeError(
                "pair shards hold finished clips: leave out --start and --stride, or name one with --clip"
            )
        return pair_clip(path.parent if path.suffix == ".zip" else path, _seed_of(path, clip_seed))
    if clip_seed is not None:
        raise RecipeError("--clip names a clip of pair shards; choose one of a scene with --start, --stride and --seed")
    if not path.is_dir():
        raise DataError(f"{path} is no folder; give a scene such as scn00000 or scene_000000, or pair shards")
    if kubric4d.scene_number(path.name) is not None:
        # with the views that are there: to look at a scene not all are needed
        every = enumerate(kubric4d.CAMERAS)
        views = [camera for view, camera in every if kubric4d.metadata_path(path, view).exists()]
        orbits = Kubric4D(path.parent, [path.name], cameras=views or kubric4d.CAMERAS, instances=True)
        return dataset_clip(orbits, path.name, options)
    if parallel_domain4d.scene_number(path.name) is not None:
        cameras = [camera for camera in parallel_domain4d.CAMERAS if (path / "rgb" / camera).is_dir()]
        classes = (path / "semantic_segmentation_2d").is_dir()
        drives = ParallelDomain4D(
            path.parent,
            [path.name],
            cameras=cameras or parallel_domain4d.CAMERAS,
            classes=classes,
            ontology=read_ontology(parallel_domain4d.ontology_folder(path)) if classes else None,
        )
        return dataset_clip(drives, path.name, options)
    raise DataError(_guess(path))


def _seed_of(path: Path, clip_seed: int | None) -> int | None:
    """The clip to show: as asked, or the first of a shard that was named itself."""
    if clip_seed is not None or path.suffix != ".zip":
        return clip_seed
    number = path.stem.split("-")[1:2]
    return int(number[0]) if number and number[0].isdecimal() else None


def _guess(path: Path) -> str:
    """What to give instead of a folder that is no scene."""
    inside = sorted(child.name for child in path.iterdir() if child.is_dir())
    scenes = [
        name
        for name in inside
        if kubric4d.scene_number(name) is not None or parallel_domain4d.scene_number(name) is not None
    ]
    if scenes:
        return f"{path} is a set of {len(scenes)} scenes; show one, such as {path / scenes[0]}"
    return (
        f"{path} is no scene: its name is neither scnNNNNN (Kubric-4D) nor scene_NNNNNN (ParallelDomain-4D), and it "
        "has no world.json (pair shards); give the folder of one scene, with its own name"
    )
