"""Clips of a data folder: what the source camera saw, and what the target camera saw at the same times."""

import hashlib
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model.config import SemanticClass
from gcd_model.geometry import CameraMount
from gcd_train.errors import DataError
from gcd_train.scenes.writer import DEPTH_UNIT_M, World, read_world

Bytes = NDArray[np.uint8]


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
    target_instances: Bytes
    seed: int


@dataclass(frozen=True, slots=True)
class PairedClips:
    """All clips of a folder, ordered by seed; read when asked for, safe to share between processes."""

    world: World
    places: tuple[tuple[Path, str], ...]

    @classmethod
    def open(cls, folder: Path | str, limit: int | None = None) -> Self:
        """Find the clips of a folder, at most `limit`; shards still being written are left out.

        Raises: DataError if it is no data folder, a shard is damaged, or there is no clip.
        """
        folder = Path(folder)
        world = read_world(folder)
        places: list[tuple[Path, str]] = []
        for path in sorted(folder.glob("shard-*.zip")):
            places += [(path, name) for name in _clip_names(path)]
        places = sorted({name: (path, name) for path, name in reversed(places)}.values(), key=lambda place: place[1])
        if not places:
            raise DataError(f"{folder} holds no finished shard; run `gcd-train generate {world.name}` to its end")
        return cls(world, tuple(places[:limit]))

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, index: int) -> PairedClip:
        return PairedClip(
            source=self._colour(index, "source"),
            target=self._colour(index, "target"),
            source_depth=self._strip(index, "source.depth").astype(np.float32) * np.float32(DEPTH_UNIT_M),
            target_depth=self._strip(index, "target.depth").astype(np.float32) * np.float32(DEPTH_UNIT_M),
            source_classes=self._strip(index, "source.classes"),
            target_classes=self.target_classes(index),
            source_instances=self._strip(index, "source.instances"),
            target_instances=self._strip(index, "target.instances"),
            seed=self.seed(index),
        )

    def rgb(self, index: int) -> tuple[Bytes, Bytes]:
        """Source and target pictures alone."""
        return self._colour(index, "source"), self._colour(index, "target")

    def target_classes(self, index: int) -> Bytes:
        """Class ids of the target view alone, [T, H, W]."""
        return self._strip(index, "target.classes")

    def seed(self, index: int) -> int:
        """The seed a clip was made from."""
        return int(self.places[index][1])

    @property
    def classes(self) -> tuple[SemanticClass, ...]:
        """The ontology, by id."""
        return self.world.classes

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.world.fps

    @property
    def mount(self) -> CameraMount:
        """How the source camera really sits on the vehicle."""
        options = self.world.options
        return CameraMount(height_m=options.height_m, tilt_deg=options.tilt_deg, hfov_deg=self.world.hfov_deg)

    @property
    def origin(self) -> str:
        """Names the world and its options, whatever number of clips there is."""
        told = msgspec.json.encode(msgspec.structs.replace(self.world, clips_per_shard=0), order="deterministic")
        return hashlib.sha256(told).hexdigest()[:8]

    @property
    def frames(self) -> int:
        """T."""
        return self.world.frames

    @property
    def height(self) -> int:
        """H."""
        return self.world.height

    @property
    def width(self) -> int:
        """W."""
        return self.world.width

    def _colour(self, index: int, camera: str) -> Bytes:
        return np.ascontiguousarray(self._strip(index, f"{camera}.rgb")[..., ::-1])

    def _strip(self, index: int, kind: str) -> NDArray[np.uint8]:
        path, name = self.places[index]
        try:
            with zipfile.ZipFile(path) as archive:
                data = archive.read(f"{name}/{kind}.png")
        except (OSError, KeyError, zipfile.BadZipFile) as error:
            raise DataError(
                f"{path}: clip {name} cannot be read ({error}); delete the shard and generate again"
            ) from error
        strip = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if strip is None or strip.shape[:2] != (self.frames * self.height, self.width):
            raise DataError(f"{path}: {name}/{kind}.png is damaged; delete the shard and generate again")
        return strip.reshape(self.frames, self.height, *strip.shape[1:])  # pyright: ignore[reportReturnType]


def require_apart(training: PairedClips, held_out: PairedClips) -> None:
    """Raises DataError if two sets share scenes: what was learned from them says nothing about others."""
    shared = {training.seed(i) for i in range(len(training))} & {held_out.seed(i) for i in range(len(held_out))}
    if shared and training.world.name == held_out.world.name:
        raise DataError(
            f"training and held-out clips share {len(shared)} scenes, first: seed {min(shared)}; generate the held-out "
            "ones with --first-seed 1000000"
        )


def _clip_names(path: Path) -> list[str]:
    try:
        with zipfile.ZipFile(path) as archive:
            names = {name.split("/")[0] for name in archive.namelist()}
    except (OSError, zipfile.BadZipFile) as error:
        raise DataError(f"{path} is damaged ({error}); delete it and generate again") from error
    if not all(re.fullmatch(r"\d{8,12}", name) for name in names):
        raise DataError(f"{path} holds something else than clips named by their seed; take it out of the folder")
    return sorted(names)
