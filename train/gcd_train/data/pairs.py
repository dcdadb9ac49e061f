"""Clips of data folders: what the source camera saw, and what the target camera saw at the same times."""

import hashlib
import re
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model.config import CameraControl
from gcd_model.errors import FileError
from gcd_model.geometry import (
    CameraMount,
    Intrinsics,
    Spherical,
    SphericalDelta,
    Trajectory,
    driving_trajectory,
    spherical_trajectory,
)
from gcd_model.small_files import decode_json
from gcd_train.data.files import ZIP_FAULTS, read_member
from gcd_train.data.sample import Bytes, Clips, Sample
from gcd_train.errors import DataError
from gcd_train.scenes.worlds import DEPTH_UNIT_M, Orbit, World, read_world

_FOLDER_SEEDS = 10**12
"""Clips of the second folder count from here, of the third from twice this: no clip's own number is as large."""


class _Scene(msgspec.Struct, frozen=True):
    orbit: Orbit


@dataclass(frozen=True, kw_only=True, slots=True)
class PairedClip:
    """One clip. Colour [T, H, W, 3]; depth in metres along the optical axis, 0 for sky; ids [T, H, W]."""

    source: Bytes
    target: Bytes
    source_depth: NDArray[np.float32]
    target_depth: NDArray[np.float32]
    source_classes: Bytes
    target_classes: Bytes
    source_instances: Bytes
    seed: int


@dataclass(eq=False)
class PairedClips(Clips):
    """All clips of some folders, read when asked for, safe to share between processes.

    One folder's clips are ordered by their number. Those of several alternate, so that the first ones are a fair mix.
    worlds: what each folder says about itself. places: shard and name of each clip. folders: in which folder it lies,
    empty where there is but one. depth: whether samples have the source's. frames, height, width: T, H, W. hfov_deg:
    angle across the pictures. mount: how the source camera really sits on the vehicle.
    """

    worlds: tuple[World, ...]
    places: tuple[tuple[Path, str], ...]
    folders: tuple[int, ...] = ()
    depth: bool = False

    def __post_init__(self) -> None:
        world = self.world
        self.frames, self.height, self.width = world.frames, world.height, world.width
        self.hfov_deg, self.fps, self.classes = world.hfov_deg, world.fps, world.classes
        self.camera: CameraControl = "none" if world.camera == "fixed" else "spherical"
        self.mount: CameraMount | None = None
        if world.camera == "fixed":
            options = world.options
            self.mount = CameraMount(height_m=options.height_m, tilt_deg=options.tilt_deg, hfov_deg=world.hfov_deg)
        # in other folders than the first, made different from all others
        self.seeds = [int(name) + _FOLDER_SEEDS * self._folder(index) for index, (_, name) in enumerate(self.places)]
        described = [msgspec.json.encode(msgspec.structs.replace(each, clips_per_shard=0)) for each in self.worlds]
        self.origin = hashlib.sha256(b"\n".join(described)).hexdigest()[:8]

    @classmethod
    def open(cls, folder: Path | str | Sequence[Path | str], limit: int | None = None) -> Self:
        """Find the clips of a folder, of several, or of all data folders in one, at most `limit` in all.

        Shards still being written are left out.

        Raises: DataError if one is no data folder, a shard is damaged, there is no clip, or the folders differ in size,
            frames, rate, lens, classes, camera control or path.
        """
        found = data_folders(folder)
        worlds = tuple(read_world(each) for each in found)
        _require_alike(found, worlds)
        places = [_places(each, world) for each, world in zip(found, worlds, strict=True)]
        order = _alternating([len(each) for each in places])[:limit]
        return cls(worlds, tuple(places[i][k] for i, k in order), tuple(i for i, _ in order) if len(found) > 1 else ())

    @property
    def world(self) -> World:
        """What the first folder says about itself; the others are alike in all but name, seeds and options."""
        return self.worlds[0]

    def scene(self, index: int) -> tuple[str, int]:
        """World and seed of the scene that a clip was cut from."""
        world = self.worlds[self._folder(index)]
        return world.name, world.scene_of(int(self.places[index][1]))

    @property
    def scenes(self) -> dict[str, str]:
        """World and seed of all scenes there are clips of, with the world."""
        return {f"{world} {seed}": world for world, seed in map(self.scene, range(len(self)))}

    def name(self, index: int) -> str:
        """Of a clip in its world: the number it was made from, in digits."""
        return self.places[index][1]

    def __getitem__(self, index: int) -> PairedClip:
        return PairedClip(
            source=self._colour(index, "source"),
            target=self._colour(index, "target"),
            source_depth=self._depth(index, "source"),
            target_depth=self._depth(index, "target"),
            source_classes=self._classes(index, "source"),
            target_classes=self._classes(index, "target"),
            source_instances=self._strip(index, "source.instances"),
            seed=self.seeds[index],
        )

    def sample(self, number: int, /) -> Sample:
        """See Clips."""
        number %= len(self)
        path = self.trajectory(number)
        return Sample(
            source=self._colour(number, "source"),
            target=self._colour(number, "target"),
            target_classes=self._classes(number, "target") if self.classes else None,
            source_from_target=path.source_from_target.numpy(),
            start=path.source,
            deltas=None if path.delta is None else path.delta.numpy(),
            fps=self.fps,
            scene=str(self.scene(number)),
            frame_numbers=tuple(range(self.frames)),
            lens=Intrinsics.from_hfov(self.hfov_deg, self.width, self.height),
            source_depth=self._depth(number, "source") if self.depth else None,
        )

    def trajectory(self, index: int, /) -> Trajectory:
        """The path from source to target. For an orbit its source stands at azimuth 0: only the change in it counts.

        Raises: DataError if the shard is damaged.
        """
        if self.world.camera == "fixed":
            return driving_trajectory(frames=self.frames, move_time=self.world.move_time, mount=self.mount)
        orbit = self.orbit(index)
        azimuth_deg, elevation_deg, radius_m = orbit.change
        return spherical_trajectory(
            Spherical(azimuth_deg=0.0, elevation_deg=orbit.start[1], radius_m=orbit.start[2]),
            SphericalDelta(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, radius_m=radius_m),
            frames=self.frames,
            move_time=self.frames - 1,
        )

    def orbit(self, index: int) -> Orbit:
        """How a clip of an orbit world was cut from its scene. Raises DataError for others, or a damaged shard."""
        path, name = self.places[index]
        try:
            return decode_json(self._read(index, "scene.json"), _Scene).orbit
        except FileError as error:
            raise DataError(f"{path}: {name}/scene.json {error}; generate the shard again") from error

    def _folder(self, index: int) -> int:
        return self.folders[index] if self.folders else 0

    def _colour(self, index: int, camera: str) -> Bytes:
        return np.ascontiguousarray(self._strip(index, f"{camera}.rgb")[..., ::-1])

    def _depth(self, index: int, camera: str) -> NDArray[np.float32]:
        return self._strip(index, f"{camera}.depth").astype(np.float32) * np.float32(DEPTH_UNIT_M)

    def _classes(self, index: int, camera: str) -> Bytes:
        if not self.classes:
            return np.zeros((self.frames, self.height, self.width), np.uint8)
        return self._strip(index, f"{camera}.classes")

    def _read(self, index: int, file: str) -> bytes:
        path, name = self.places[index]
        try:
            with zipfile.ZipFile(path) as archive:
                return read_member(archive, f"{name}/{file}")
        except ZIP_FAULTS as error:
            raise DataError(
                f"{path}: clip {name} cannot be read ({error}); delete the shard and generate again"
            ) from error

    def _strip(self, index: int, kind: str) -> NDArray[np.uint8]:
        data = self._read(index, f"{kind}.png")
        strip = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if strip is None or strip.shape[:2] != (self.frames * self.height, self.width):
            path, name = self.places[index]
            raise DataError(f"{path}: {name}/{kind}.png is damaged; delete the shard and generate again")
        return strip.reshape(self.frames, self.height, *strip.shape[1:])  # pyright: ignore[reportReturnType]


def data_folders(folder: Path | str | Sequence[Path | str]) -> list[Path]:
    """The data folders meant: one, several, or those in a folder that is none itself. Raises DataError."""
    if not isinstance(folder, Path | str):
        found = [each for one in folder for each in data_folders(one)]
        if not found:
            raise DataError("no data folder is given; name at least one")
        if len(set(found)) < len(found):
            raise DataError("the same data folder is given twice; name each once")
        return found
    one = Path(folder)
    inside = [] if (one / "world.json").exists() else sorted(path.parent for path in one.glob("*/world.json"))
    return inside or [one]


def _require_alike(folders: Sequence[Path], worlds: Sequence[World]) -> None:
    def common(world: World) -> tuple[object, ...]:
        size = world.width, world.height, world.frames, world.fps, world.hfov_deg
        return *size, world.camera, world.path, world.classes, None if world.camera == "orbit" else world.options

    for folder, world in zip(folders, worlds, strict=True):
        if common(world) != common(worlds[0]):
            raise DataError(
                f"{folder} and {folders[0]} do not go together: clips of one training are alike in size, frames, rate, "
                "lens, classes, camera and path; generate both with the same options"
            )


def _places(folder: Path, world: World) -> list[tuple[Path, str]]:
    """Shard and name of a folder's clips by number, each once."""
    places = [(path, name) for path in sorted(folder.glob("shard-*.zip")) for name in _clip_names(path)]
    if not places:
        raise DataError(f"{folder} holds no finished shard; run `gcd-train generate {world.name}` to its end")
    return sorted({name: (path, name) for path, name in reversed(places)}.values(), key=lambda place: int(place[1]))


def _alternating(counts: Sequence[int]) -> list[tuple[int, int]]:
    """Folder and place in it of all clips, each folder spread evenly over the whole."""
    every = [((k + 0.5) / count, i, k) for i, count in enumerate(counts) for k in range(count)]
    return [(i, k) for _, i, k in sorted(every)]


def _clip_names(path: Path) -> list[str]:
    try:
        with zipfile.ZipFile(path) as archive:
            names = {name.split("/")[0] for name in archive.namelist()}
    except ZIP_FAULTS as error:
        raise DataError(f"{path} is damaged ({error}); delete it and generate again") from error
    if not all(re.fullmatch(r"\d{8,12}", name) for name in names):
        raise DataError(f"{path} holds something else than clips named by their seed; take it out of the folder")
    return sorted(names)
