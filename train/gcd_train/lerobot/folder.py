"""What a LeRobot data set says of itself: its features, and where each episode's rows and pictures lie.

Source: the documented formats v3.0 (several episodes a file, placed by `meta/episodes`) and v2.1 (one file an episode).

`meta/cameras.json`: where the cameras of a LeRobot data set stand; LeRobot itself has no field for it.

    {"cameras": {"observation.images.front": {
        "width": 640, "height": 480, "fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 240.0,
        "base_from_camera": [[1, 0, 0, 0.4], [0, -1, 0, 0], [0, 0, -1, 1.2], [0, 0, 0, 1]]}}}

Pixels count from the top left corner of the picture (an OpenCV calibration: add 0.5 to cx and cy); no distortion. The
base is the robot's, metres; camera axes are x right, y down, z ahead. A camera that moves has, instead of
`base_from_camera`, a `pose_feature`: the name of a feature with its base_from_camera of each frame, 16 numbers row by
row.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model.errors import FileError, ModelError
from gcd_model.geometry import Intrinsics, require_rigid
from gcd_model.small_files import decode_json, read_json, read_small
from gcd_train.data.files import FileFault
from gcd_train.errors import DataError

_INSTALL = "LeRobot data sets need the extra `lerobot`: pip install 'gcd-node[lerobot]'"


def load_arrow() -> tuple[Any, Any]:
    """pyarrow and pyarrow.parquet. Raises DataError if they are not installed."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise DataError(f"{_INSTALL} (pyarrow is missing)") from error
    return pyarrow, pyarrow.parquet


def load_av() -> Any:
    """PyAV. Raises DataError if it is not installed."""
    try:
        import av
    except ImportError as error:
        raise DataError(f"{_INSTALL} (av is missing)") from error
    return av


CAMERA_FILE = "meta/cameras.json"
Rows = tuple[tuple[float, ...], ...]


class CameraCalibration(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One camera: its pinhole in pixels, and where it stands, once for all or by the name of a feature."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    base_from_camera: Rows | None = None
    pose_feature: str | None = None

    @property
    def lens(self) -> Intrinsics:
        """The pinhole. Raises OptionError or ShapeError if it is none."""
        return Intrinsics(fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy, width=self.width, height=self.height)

    @property
    def pose(self) -> NDArray[np.float64] | None:
        """base_from_camera [4, 4] of a camera that stands still."""
        return None if self.base_from_camera is None else np.asarray(self.base_from_camera, np.float64)


class CameraFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All calibrated cameras, by the name of their feature, for one `observation.images.front`."""

    cameras: dict[str, CameraCalibration]


_EXAMPLE = (
    '{"cameras": {"observation.images.front": {"width": 640, "height": 480, "fx": 600.0, "fy": 600.0, "cx": 320.0, '
    '"cy": 240.0, "base_from_camera": [[1, 0, 0, 0.4], [0, -1, 0, 0], [0, 0, -1, 1.2], [0, 0, 0, 1]]}}}'
)


def read_cameras(folder: Path, calibration: Path | None = None) -> dict[str, CameraCalibration]:
    """The calibration of a data set, from its own file or from another one.

    Raises:
        DataError: there is none; the message shows what to write. FileFault: it is wrong.
    """
    path = calibration or folder / CAMERA_FILE
    if not path.exists():
        raise DataError(
            f"{path} is missing: LeRobot keeps no camera poses, and pairs of cameras need them; write one there, or "
            f"give another with --calibration FILE; for example {_EXAMPLE}"
        )
    try:
        cameras = read_json(path, CameraFile).cameras
    except FileError as error:
        raise FileFault(path, f"is no camera calibration: it {error}; for example {_EXAMPLE}") from error
    for name, camera in cameras.items():
        _check(path, name, camera)
    if len(cameras) < 2:
        raise FileFault(path, f"tells of {len(cameras)} camera(s), pairs need two or more")
    return cameras


def _check(path: Path, name: str, camera: CameraCalibration) -> None:
    if (camera.base_from_camera is None) == (camera.pose_feature is None):
        raise FileFault(path, f"must give {name} either base_from_camera or pose_feature")
    try:
        camera.lens  # noqa: B018  refuses what is no pinhole
        if camera.pose is not None:
            require_rigid(torch.from_numpy(camera.pose), f"base_from_camera of {name}")
    except (ModelError, ValueError) as error:
        raise FileFault(path, f"is wrong about {name}: {error}") from error


def write_cameras(folder: Path, cameras: dict[str, CameraCalibration]) -> None:
    """Write `meta/cameras.json` of a data set."""
    text = msgspec.json.format(msgspec.json.encode(CameraFile(cameras=cameras)), indent=1)
    (folder / CAMERA_FILE).write_bytes(text)


_CHUNK = 1000
_MOST_BYTES = 1 << 24


class Feature(msgspec.Struct, frozen=True, kw_only=True):
    """One column or camera. Unknown fields are allowed: the format is not ours and grows."""

    dtype: str
    shape: tuple[int, ...] = ()


class Info(msgspec.Struct, frozen=True, kw_only=True):
    """`meta/info.json`, as far as it matters here. Unknown fields are allowed: the format is not ours and grows."""

    codebase_version: str
    fps: float
    features: dict[str, Feature]
    data_path: str
    video_path: str | None = None
    chunks_size: int = _CHUNK


class _Row(msgspec.Struct, frozen=True, kw_only=True):
    """A line of `meta/episodes.jsonl`, as far as it matters here."""

    episode_index: Annotated[int, msgspec.Meta(ge=0)]
    length: Annotated[int, msgspec.Meta(ge=0)]


@dataclass(frozen=True, kw_only=True, slots=True)
class EpisodePlace:
    """Where an episode lies. videos: feature -> file and where the episode begins in it, seconds."""

    number: int
    length: int
    data: Path
    videos: Mapping[str, tuple[Path, float]]

    @property
    def name(self) -> str:
        """As reports call it."""
        return f"episode_{self.number:06d}"


@dataclass(frozen=True, kw_only=True, slots=True)
class LeRobotFolder:
    """A data set on disk; nothing of its rows and pictures is read yet."""

    folder: Path
    info: Info
    episodes: tuple[EpisodePlace, ...]

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Find the episodes.

        Raises: DataError if it is no LeRobot data set of version 2.1 or 3.0, FileFault if its `meta` is damaged.
        """
        info = _read_info(folder)
        rows = _episodes_v3 if info.codebase_version.startswith("v3") else _episodes_v2
        episodes = tuple(sorted(rows(folder, info), key=lambda episode: episode.number))
        if not episodes:
            raise DataError(f"{folder} has no episodes; record or export some")
        return cls(folder=folder, info=info, episodes=episodes)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Features that are videos."""
        return tuple(name for name, feature in self.info.features.items() if feature.dtype == "video")


def _read_info(folder: Path) -> Info:
    path = folder / "meta/info.json"
    if not path.exists():
        raise DataError(f"{folder} is no LeRobot data set: {path} is missing; give the folder that holds `meta`")
    try:
        info = read_json(path, Info, _MOST_BYTES)
    except FileError as error:
        raise FileFault(path, str(error)) from error
    if not info.codebase_version.startswith(("v3.", "v2.")):
        raise DataError(
            f"{path} says version {info.codebase_version}; this reads v3.0 and v2.1: convert it "
            "with the package lerobot"
        )
    if not info.fps > 0:
        raise FileFault(path, f"must have frames per second above 0, has {info.fps}")
    return info


def _episodes_v3(folder: Path, info: Info) -> Iterator[EpisodePlace]:
    videos = [name for name, feature in info.features.items() if feature.dtype == "video"]
    paths = sorted((folder / "meta/episodes").glob("chunk-*/file-*.parquet"))
    if not paths:
        raise FileFault(folder / "meta/episodes", "holds no chunk-000/file-000.parquet; a v3.0 set has one")
    keys = ("chunk_index", "file_index")
    wanted = ["episode_index", "length", *(f"data/{key}" for key in keys)]
    wanted += [f"videos/{name}/{key}" for name in videos for key in (*keys, "from_timestamp")]
    for row in (row for path in paths for row in read_rows(path, wanted)):
        films = {name: {key: int(row[f"videos/{name}/{key}"]) for key in keys} for name in videos}
        yield EpisodePlace(
            number=int(row["episode_index"]),
            length=int(row["length"]),
            data=_inside(folder, info.data_path, {key: int(row[f"data/{key}"]) for key in keys}),
            videos={
                name: (_video(folder, info, name, numbers), float(row[f"videos/{name}/from_timestamp"]))
                for name, numbers in films.items()
            },
        )


def _episodes_v2(folder: Path, info: Info) -> Iterator[EpisodePlace]:
    videos = [name for name, feature in info.features.items() if feature.dtype == "video"]
    path = folder / "meta/episodes.jsonl"
    try:
        rows = [decode_json(line, _Row) for line in read_small(path, _MOST_BYTES).splitlines() if line.strip()]
    except FileError as error:
        raise FileFault(path, f"is no list of episodes: it {error}") from error
    for row in rows:
        numbers = {"episode_index": row.episode_index, "episode_chunk": row.episode_index // max(1, info.chunks_size)}
        yield EpisodePlace(
            number=row.episode_index,
            length=row.length,
            data=_inside(folder, info.data_path, numbers),
            videos={name: (_video(folder, info, name, numbers), 0.0) for name in videos},
        )


def _video(folder: Path, info: Info, name: str, numbers: Mapping[str, int]) -> Path:
    if info.video_path is None:
        raise FileFault(folder / "meta/info.json", "has cameras but no video_path; pictures in rows are not supported")
    return _inside(folder, info.video_path, {**numbers, "video_key": name})


def _inside(folder: Path, template: str, numbers: Mapping[str, int | str]) -> Path:
    """The path that a template of `meta/info.json` gives; it may not lead out of the data set."""
    info = folder / "meta/info.json"
    try:
        path = folder / template.format(**numbers)
    except (KeyError, ValueError, IndexError, AttributeError) as error:
        raise FileFault(info, f"has a path template that cannot be filled: {template!r} ({error!r})") from error
    if not path.is_relative_to(folder) or ".." in path.parts[len(folder.parts) :]:
        raise FileFault(info, f"has a path template that leads out of the data set: {template!r}")
    return path


def read_rows(path: Path, columns: Sequence[str], episode: int | None = None) -> list[dict[str, Any]]:
    """Rows of a parquet file, of one episode if a number is given. Raises FileFault; DataError without pyarrow."""
    arrow, parquet = load_arrow()
    filters = None if episode is None else [("episode_index", "=", episode)]
    try:
        if path.exists() and not path.is_file():
            raise FileFault(path, "is no regular file")
        there = set(parquet.read_schema(path).names)
        missing = [name for name in columns if name not in there]
        if missing:
            raise FileFault(path, f"lacks the columns {', '.join(missing)}")
        rows: list[dict[str, Any]] = parquet.read_table(path, columns=list(columns), filters=filters).to_pylist()
    except FileNotFoundError as error:
        raise FileFault(path, "is missing: download or export the data set again") from error
    except (arrow.ArrowException, OSError, ValueError) as error:
        raise FileFault(path, f"is damaged ({error})") from error
    return rows
