"""Episodes in the unified scene layout of AnyViewBench and Kubric-5D: names, reader, writer, export of our scenes.

    splits.json                              {"groups": {"argoverse": ["argoverse_A", ...], ...}}, not in Kubric-5D
    SPLIT/EPISODE/metadata.json              cameras, resolution [H, W], num_frames, framerate
    SPLIT/EPISODE/rgb/cam0/0000000000.jpg    each frame, or rgb/cam0.mp4 with all
    SPLIT/EPISODE/lowdim/cam0/0000000000.npz each frame's `intrinsics` [3, 3] and `extrinsics` [4, 4], or
                                             lowdim/cam0.npz with [T, 3, 3] and [T, 4, 4]

In the benchmark cam1 is the input, cam0 the target; both may move. Kubric-5D has cam00 to cam15. Extrinsics are world
from camera, intrinsics a pinhole in pixels of the stored pictures. Source: README and PROTOCOL page of
TRI-ML/AnyView-DVS (Van Hoorick et al. 2026). They do not say, and this is assumed: camera axes are x right, y down, z
ahead; pixels count from the picture's corner; all cameras of an episode have its resolution; `groups` lists the splits
of each; an episode lies below a folder called as its split, the last of such; without splits.json there is one split.
"""

import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated

import cv2
import msgspec
import numpy as np
import torch
from msgspec import Meta

from gcd_model.errors import FileError, ModelError
from gcd_model.geometry import CameraMount, Intrinsics, require_rigid, to_pose
from gcd_model.small_files import decode_json, read_json
from gcd_train.data import kubric4d, parallel_domain4d
from gcd_train.data.dataset4d import Dataset4D, layout_in
from gcd_train.data.encodings import Doubles, read_colour, sized
from gcd_train.data.files import MANIFEST, MOST_TEXT, FileFault, SceneFiles, read, read_manifest, read_npz
from gcd_train.data.kubric4d import Kubric4D
from gcd_train.data.pairs import PairedClips
from gcd_train.data.parallel_domain4d import ParallelDomain4D
from gcd_train.data.pictures import geometry_poses
from gcd_train.data.sample import Bytes
from gcd_train.errors import DataError, RecipeError
from gcd_train.files import new_folder, write_whole
from gcd_train.pictures import video_frames

TARGET, SOURCE = "cam0", "cam1"
SPLITS, METADATA, FETCH = "splits.json", "metadata.json", "fetch_manifest.json"
"""Index of a benchmark; facts of an episode; what an episode without pixels (Ego-Exo4D, Waymo) is rebuilt by."""
_SUFFIXES = (".jpg", ".jpeg", ".png")
_MOST_SIDE, _MOST_FRAMES, _MOST_DEPTH = 1 << 14, 100_000, 4
SKEW = 1e-3
"""Of a focal length: what is less is no change of a lens, and no entry that a pinhole has not."""
_JPEG_OFF = 8  # levels, more than what is lost by `_JPEG`
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]


class _Splits(msgspec.Struct, frozen=True):
    """Others' file: what else stands in it is not known."""

    groups: dict[str, tuple[str, ...]]


class _Metadata(msgspec.Struct, frozen=True):
    """Others' file: what else stands in it (modalities) is not needed."""

    cameras: tuple[str, ...]
    resolution: tuple[Annotated[int, Meta(ge=1, le=_MOST_SIDE)], Annotated[int, Meta(ge=1, le=_MOST_SIDE)]]
    num_frames: Annotated[int, Meta(ge=1, le=_MOST_FRAMES)]
    framerate: Annotated[float, Meta(gt=0, le=1e4)]


def read_groups(root: Path) -> dict[str, tuple[str, ...]]:
    """The splits of each group of a benchmark. Raises DataError: no such file, no split, or one in two groups."""
    path = root / SPLITS
    try:
        groups = read_json(path, _Splits, MOST_TEXT).groups
    except FileError as error:
        raise DataError(
            f"{path} {error}; give the folder that AnyViewBench was unpacked to, or one of `gcd-train export anyview`"
        ) from error
    splits = [split for group in groups.values() for split in group]
    if not splits or len(set(splits)) < len(splits):
        raise DataError(f"{path} must name each split once, in one group, got {splits or 'none'}")
    return groups


def find_episodes(root: Path, splits: Sequence[str]) -> dict[str, dict[str, Path]]:
    """Folders of the episodes by split and name, in order, linked ones, too; of a split that is not there none.

    Raises: DataError: the folder cannot be read, an episode has no metadata, lies in a folder of no split or has
        another's name, or folders lie too deep to look for one.
    """
    found: dict[str, dict[str, Path]] = {split: {} for split in splits}

    def passed_on(error: OSError) -> None:
        raise DataError(f"{root} cannot be read ({error}); check its rights") from error

    for place, folders, files in os.walk(root, onerror=passed_on, followlinks=True):
        parts = (root.name, *Path(place).relative_to(root).parts)
        if METADATA not in (*folders, *files):
            if {"rgb", "lowdim"} & set(folders):
                raise DataError(f"{place} is an episode without {METADATA}; download it again, or take it out")
            folders[:] = sorted(name for name in folders if not name.startswith("."))
            if folders and len(parts) > _MOST_DEPTH + 1:
                raise DataError(f"{place} has folders deeper than an episode lies ({_MOST_DEPTH}); take them out")
            continue
        folders.clear()
        split = next((part for part in reversed(parts) if part in found), None)
        if split is None:
            raise DataError(f"{place} is an episode in no folder of a split that {SPLITS} names; take it out")
        name = "-".join(parts[len(parts) - parts[::-1].index(split) :]) or split
        if found[split].setdefault(name, Path(place)) != Path(place):
            raise DataError(f"{place} and {found[split][name]} would both be called {name}; rename one")
    return found


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraVideo:
    """What one camera of an episode filmed. pictures: T of u8 [H, W, 3]. lenses: T, in pixels of these. poses:
    world_from_camera, f64 [T, 4, 4], metres; any world."""

    pictures: Sequence[Bytes]
    lenses: Sequence[Intrinsics]
    poses: Doubles


@dataclass(frozen=True, kw_only=True, slots=True)
class Episode:
    """One folder, whose cameras are all there. frames: T of all. fps: of them. height, width: of the pictures."""

    folder: Path
    frames: int
    fps: float
    height: int
    width: int

    @classmethod
    def open(cls, folder: Path, cameras: Sequence[str] = (SOURCE, TARGET)) -> "Episode | None":
        """Looks at what is there, without reading pictures. None: an episode that comes without pixels.

        Raises: FileFault: metadata cannot be used, a camera is missing, or it has another number of frames.
        """
        path = folder / METADATA
        try:
            told = decode_json(read(path, MOST_TEXT), _Metadata)
        except FileError as error:
            raise FileFault(path, f"is no metadata of an episode: it {error}") from error
        lacking = [camera for camera in cameras if camera not in told.cameras]
        if lacking:
            raise FileFault(path, f"names the cameras {', '.join(told.cameras) or 'none'}, and not {lacking[0]}")
        (height, width), frames = told.resolution, told.num_frames
        episode = cls(folder=folder, frames=frames, fps=told.framerate, height=height, width=width)
        stored = [folder / "rgb" / camera for camera in cameras]
        if (folder / FETCH).is_file() and not any(each.is_dir() or _video(each).is_file() for each in stored):
            return None
        for camera in cameras:
            episode._require(folder / "rgb" / camera, _SUFFIXES, ".mp4")
            episode._require(folder / "lowdim" / camera, (".npz",), ".npz")
        return episode

    def read(self, camera: str, frames: int) -> CameraVideo:
        """The first so many frames of a camera. Raises FileFault: a file is missing, damaged or does not fit."""
        lenses, poses = self._cameras(self.folder / "lowdim" / camera, frames)
        return CameraVideo(pictures=self._pictures(self.folder / "rgb" / camera, frames), lenses=lenses, poses=poses)

    def _require(self, place: Path, suffixes: Sequence[str], whole: str) -> None:
        """Raises FileFault unless a camera has one file in place of the folder, or one a frame."""
        if not place.is_dir():
            if not place.with_name(place.name + whole).is_file():
                raise FileFault(place, f"is missing, and {place.name}{whole} too: download the episode again")
            return
        stems = sorted(path.stem for path in place.iterdir() if path.suffix in suffixes)
        wanted = [_stem(number) for number in range(self.frames)]
        if stems != wanted:
            odd = next(iter(sorted(set(stems) ^ set(wanted))), "a frame twice")
            raise FileFault(
                place, f"holds {len(stems)} frames, {METADATA} says {self.frames}; first that does not fit: {odd}"
            )

    def _pictures(self, place: Path, frames: int) -> list[Bytes]:
        size = (self.height, self.width, METADATA)
        if not place.is_dir():
            kept, count = list[Bytes](), 0
            for count, picture in enumerate(video_frames(_video(place)), start=1):
                kept += [sized(_video(place), picture, *size)] if count <= frames else []
                if count > self.frames:
                    break
            if count != self.frames:
                many = "more" if count > self.frames else f"{count}"
                raise FileFault(_video(place), f"holds {many} frames, {METADATA} says {self.frames}")
            return kept
        stored = {path.stem: path for path in place.iterdir() if path.suffix in _SUFFIXES}
        paths = [stored[_stem(number)] for number in range(frames)]
        return [sized(path, read_colour(path), *size) for path in paths]

    def _cameras(self, place: Path, frames: int) -> tuple[list[Intrinsics], Doubles]:
        if place.is_dir():
            paths = [place / f"{_stem(number)}.npz" for number in range(frames)]
            each = [_matrices(path, (3, 3), (4, 4)) for path in paths]
            inside, poses = (np.stack(part) for part in zip(*each, strict=True))
        else:
            place = place.with_name(place.name + ".npz")
            inside, poses = (rows[:frames] for rows in _matrices(place, (self.frames, 3, 3), (self.frames, 4, 4)))
        try:
            rigid = require_rigid(torch.from_numpy(poses), "extrinsics").numpy()
            return [self._lens(rows) for rows in inside], rigid
        except (ModelError, ValueError) as error:
            raise FileFault(place, f"holds no usable camera: {error}") from error

    def _lens(self, rows: Doubles) -> Intrinsics:
        fx, fy, cx, cy = (float(rows[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
        lens = Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=self.width, height=self.height)
        off = np.abs(rows - lens.matrix.numpy()) / np.array([[fx], [fy], [1.0]])
        if not float(off.max()) <= SKEW:
            raise ValueError(f"intrinsics must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {rows.round(3).tolist()}")
        return lens


def _stem(number: int) -> str:
    return f"{number:010d}"


def _video(place: Path) -> Path:
    return place.with_name(place.name + ".mp4")


def _matrices(path: Path, *shapes: tuple[int, ...]) -> tuple[Doubles, Doubles]:
    """Intrinsics and extrinsics of these shapes. Nothing is unpickled. Raises FileFault."""
    arrays, found = read_npz(path), list[Doubles]()
    for name, shape in zip(("intrinsics", "extrinsics"), shapes, strict=True):
        array = arrays.get(name)
        if array is None or array.dtype.kind not in "fiu" or array.shape != shape:
            got = "none" if array is None else f"{array.dtype} {list(array.shape)}"
            raise FileFault(path, f"must hold {name} {list(shape)}, got {got}")
        found.append(array.astype(np.float64))
    return found[0], found[1]


# --- writing ---------------------------------------------------------------------------------------------------------


def write_episode(folder: Path, videos: Mapping[str, CameraVideo], fps: float) -> None:
    """An episode into an empty folder, frame by frame: JPEG of the highest quality, poses in float64.

    videos: by camera, all of as many frames of one size. Raises OSError, which names the file, if the disk is full.
    """
    files = SceneFiles(folder)
    for camera, video in videos.items():
        for number, (picture, lens, pose) in enumerate(zip(video.pictures, video.lenses, video.poses, strict=True)):
            _, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), _JPEG)
            files.write(folder / "rgb" / camera / f"{_stem(number)}.jpg", data.tobytes())
            arrays = io.BytesIO()
            np.savez(arrays, intrinsics=lens.matrix.numpy(), extrinsics=pose)
            files.write(folder / "lowdim" / camera / f"{_stem(number)}.npz", arrays.getvalue())
    video = next(iter(videos.values()))
    height, width = video.pictures[0].shape[:2]
    told = _Metadata(
        cameras=tuple(sorted(videos)), resolution=(height, width), num_frames=len(video.pictures), framerate=fps
    )
    files.write(folder / METADATA, msgspec.json.format(msgspec.json.encode(told), indent=1))


@dataclass(frozen=True, kw_only=True)
class EpisodeExport:
    """Writes scenes in a published layout, or pairs, one episode at a time, in any process.

    data: what is exported. out: the benchmark's folder. views: input and target camera of scenes; pairs have their own.
    """

    data: Dataset4D | PairedClips
    out: Path
    views: tuple[tuple[str, str], ...] = ()

    @classmethod
    def of(cls, source: Path, out: Path, views: Sequence[str] = (), limit: int | None = None) -> "EpisodeExport":
        """views: `INPUT:TARGET` each; by default of scenes the source camera and the one farthest from it. limit: only
        the first so many scenes or clips.

        Raises: DataError: there is nothing to export, or no such camera. RecipeError: views of pairs, or not two.
        """
        source, out, layout = source.resolve(), out.resolve(), layout_in(source)
        if source == out or source in out.parents:
            raise RecipeError(f"{out} lies in {source}, where nothing is written; choose another OUT")
        if layout is None:
            if views:
                raise RecipeError(f"{source} holds pairs, which have two cameras each: leave out --view")
            return cls(data=PairedClips.open(source, limit), out=out)
        chosen = [tuple(view.split(":")) for view in views]
        if any(len(view) != 2 or view[0] == view[1] for view in chosen):
            raise RecipeError(f"--view wants INPUT:TARGET, two cameras of a scene, got {', '.join(views)}")
        names = tuple(dict.fromkeys(name for view in chosen for name in view))
        if layout == "kubric4d":
            data = Kubric4D(source, cameras=names or kubric4d.CAMERAS)
        else:
            every = names or parallel_domain4d.CAMERAS
            first = parallel_domain4d.FORWARD if not names else names[0]
            data = ParallelDomain4D(source, cameras=every, classes=False, source_camera=first)
        pairs = [(view[0], view[1]) for view in chosen] or [(data.source_camera, _farthest(data))]
        return cls(data=data.only(data.scenes[:limit]), out=out, views=tuple(pairs))

    @cached_property
    def items(self) -> tuple[str, ...]:
        """Of all episodes group, split and name, `drop/drop-view4-view10/scn00000`; scene by scene.

        Raises DataError where two would have one name.
        """
        data = self.data
        if isinstance(data, PairedClips):
            worlds = [(data.scene(number)[0], data.name(number)) for number in range(len(data))]
            items = tuple(f"{world}/{world}-pairs/{name}" for world, name in worlds)
            if len(set(items)) < len(items):
                raise DataError("a clip is there twice, in two folders of one world; export the folders one by one")
            return items
        folders = [data.folder(scene) for scene in data.scenes]
        groups = [read_manifest(at).world if (at / MANIFEST).is_file() else layout_in(data.root) for at in folders]
        scenes = list(zip(groups, data.scenes, strict=True))
        return tuple(f"{group}/{group}-{one}-{other}/{scene}" for group, scene in scenes for one, other in self.views)

    def __call__(self, item: str) -> bool:
        """Write an episode; whether it was not there.

        Raises: DataError: it cannot be read. OSError: nor written. RecipeError: one of another scene has its name.
        """
        _, split, name = item.split("/")
        place, there = self.items.index(item), self.out / split / name
        views = dict(zip((SOURCE, TARGET), self.views[place % len(self.views)], strict=True)) if self.views else {}
        if there.exists():
            data = self.data
            first = data[place].source[0] if isinstance(data, PairedClips) else data.view(name, views[SOURCE], 0).rgb
            known = read_colour(there / "rgb" / SOURCE / f"{_stem(0)}.jpg")
            if known.shape != first.shape or int(np.abs(known.astype(int) - first).max()) > _JPEG_OFF:
                raise RecipeError(f"{there} is an episode of another scene of this name; export to another folder")
            return False
        with new_folder(self.out / split, name) as folder:
            if isinstance(self.data, PairedClips):
                write_episode(folder, _pair(self.data, place), self.data.fps)
            else:
                videos = {camera: _filmed(self.data, name, view) for camera, view in views.items()}
                write_episode(folder, videos, self.data.fps)
        return True

    def finish(self) -> tuple[str, ...]:
        """Name the splits that have episodes in splits.json; gives all. Raises DataError for another file there."""
        begun = (self.out / SPLITS).exists()
        groups = {name: list(splits) for name, splits in read_groups(self.out).items()} if begun else {}
        for group, split, name in (item.split("/") for item in self.items):
            if (self.out / split / name).is_dir() and split not in (known := groups.setdefault(group, [])):
                known.append(split)
        if groups:
            write_whole(self.out / SPLITS, msgspec.json.format(msgspec.json.encode({"groups": groups}), indent=1))
        return tuple(split for splits in groups.values() for split in splits)


def _farthest(data: Dataset4D) -> str:
    """The camera that stands farthest from the source, in the first scene."""
    at = {name: data.pose(data.scenes[0], name)[:3, 3] for name in data.cameras}
    return max(at, key=lambda name: float(np.linalg.norm(at[name] - at[data.source_camera])))


def _filmed(data: Dataset4D, scene: str, camera: str) -> CameraVideo:
    """All that a camera of a scene saw; poses of our driving scenes, which are the vehicle's, in the world."""
    views = [data.view(scene, camera, time) for time in range(data.frames(scene))]
    poses, folder = np.stack([view.world_from_camera for view in views]), data.folder(scene)
    if (folder / MANIFEST).is_file():
        poses = geometry_poses(folder, range(len(views))) @ poses
    return CameraVideo(pictures=[view.rgb for view in views], lenses=[view.lens for view in views], poses=poses)


def _pair(clips: PairedClips, number: int) -> dict[str, CameraVideo]:
    """Both sides of a clip; its world is the stage that the camera orbits, or the vehicle."""
    clip, path, mount = clips[number], clips.trajectory(number), clips.mount
    lens = Intrinsics.from_hfov(clips.hfov_deg, clips.width, clips.height)
    if mount is not None:
        stands, far = mount.vehicle_from_camera, Intrinsics.from_hfov(CameraMount().hfov_deg, lens.width, lens.height)
    else:
        assert path.source is not None, "a path over the sphere begins at a camera"
        stands, far = to_pose(path.source), lens
    poses = {SOURCE: stands.expand(clips.frames, 4, 4), TARGET: stands @ path.source_from_target}
    sides = {SOURCE: (clip.source, lens), TARGET: (clip.target, far)}
    return {
        camera: CameraVideo(pictures=list(frames), lenses=[own] * clips.frames, poses=poses[camera].numpy())
        for camera, (frames, own) in sides.items()
    }
