"""`gcd-manifest.json`: what one of our scene folders says about itself, with a checksum of every file."""

import hashlib
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

import msgspec

from gcd_model.errors import FileError
from gcd_model.small_files import read_json
from gcd_train.errors import DataError

MANIFEST = "gcd-manifest.json"
GEOMETRY = "geometry.npz"
"""The scene ready to draw (`FrozenScene`), beside the manifest."""

_MOST_BYTES = 1 << 24  # 16 cameras of 1000 frames in five layers
Matrix = tuple[tuple[float, float, float, float], ...]


class SceneManifest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Written last, so that a scene that has one is whole.

    layout: which names and encodings. world, seed, edition: what was drawn; the edition rises whenever a world draws
    another scene for the same seed. version: of this package. compact: WebP and depth codes in place of the
    published encodings. cameras: their names, in order. hfov_deg: of every camera. world_from_vehicle: [T][4][4],
    where the vehicle is in the frame of `geometry.npz`; None where poses are told in the world itself. facts: what the
    world tells of the whole scene. files: relative path -> SHA-256, without the manifest.
    """

    layout: Literal["kubric4d", "parallel_domain4d"]
    world: str
    seed: int
    version: str
    edition: int
    frames: int
    fps: float
    width: int
    height: int
    oversample: int
    compact: bool
    hfov_deg: float
    cameras: tuple[str, ...]
    files: dict[str, str]
    world_from_vehicle: tuple[Matrix, ...] | None = None
    facts: dict[str, float | str] = {}
    format: Literal[1] = 1


class SceneFiles:
    """Writes into one scene folder and keeps the SHA-256 of every file for its manifest."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.checksums: dict[str, str] = {}
        self.size = 0

    def write(self, path: Path, data: bytes) -> None:
        """One file; its folder is made when needed. Raises OSError, which names it, for one if the disk is full."""
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            path.write_bytes(data)
        except OSError as error:  # a full disk does not say for which file
            raise OSError(error.errno, error.strerror, str(path)) from error
        self.checksums[path.relative_to(self.folder).as_posix()] = hashlib.sha256(data).hexdigest()
        self.size += len(data)


def package_version() -> str:
    """Of this package; `unknown` in a tree that was never installed."""
    try:
        return version("gcd-node")
    except PackageNotFoundError:
        return "unknown"


def read_manifest(scene: Path) -> SceneManifest:
    """Of a scene folder. Raises DataError if it has none, or one that cannot be read."""
    path = scene / MANIFEST
    if not path.exists():
        raise DataError(f"{scene} has no {MANIFEST}: it was not made by `gcd-train generate`")
    try:
        return read_json(path, SceneManifest, _MOST_BYTES)
    except FileError as error:
        raise DataError(f"{path} {error}; delete the scene and generate it again") from error


def faults(scene: Path) -> Iterator[str]:
    """One line for every file of a scene folder that is missing, cannot be read, or is not as it was written.

    Files that other programs added are no fault. Raises: DataError as `read_manifest`.
    """
    for name, wanted in read_manifest(scene).files.items():
        try:
            if (scene / name).exists() and not (scene / name).is_file():
                yield f"{scene / name} is no regular file"
                continue
            with (scene / name).open("rb") as file:
                came = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            yield f"{scene / name} cannot be read ({error.strerror})"
            continue
        if came != wanted:
            yield f"{scene / name} is not as it was written: SHA-256 {came[:12]}…, wanted {wanted[:12]}…"
