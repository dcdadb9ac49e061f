"""LeRobot data sets as pairs of calibrated cameras: training with real robots, without the package lerobot.

Two cameras filmed the same moments, so one is the source, the other the target, and the calibration says how they stand
to each other.

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
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import torch

from gcd_model.errors import FileError, ModelError
from gcd_model.geometry import require_rigid
from gcd_model.small_files import decode_json, read_json, read_small
from gcd_train.data.files import MOST_TEXT, FileFault
from gcd_train.data.sample import Bytes, DrawnSamples, Sample
from gcd_train.data.videos import Doubles, FileLens, Side, nearest_pictures, sample_of
from gcd_train.errors import DataError

CAMERA_FILE = "meta/cameras.json"
CHUNK = 1000
"""Files a folder."""
_SLACK_S = 1e-4
_EXAMPLE = (
    '{"cameras": {"observation.images.front": {"width": 640, "height": 480, "fx": 600.0, "fy": 600.0, "cx": 320.0, '
    '"cy": 240.0, "base_from_camera": [[1, 0, 0, 0.4], [0, -1, 0, 0], [0, 0, -1, 1.2], [0, 0, 0, 1]]}}}'
)


def extra(module: str) -> Any:
    """A module of the extra `lerobot`. Raises DataError if it is not installed."""
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise DataError(
            f"LeRobot data sets need the extra `lerobot`: pip install 'gcd-node[lerobot]' ({package} is missing)"
        ) from error


class CameraCalibration(FileLens, frozen=True, kw_only=True):
    """One camera, and where it stands, once for all or by the name of a feature. synthetic: it never stood there; such
    cameras are learned from only where somebody names them."""

    base_from_camera: tuple[tuple[float, ...], ...] | None = None
    pose_feature: str | None = None
    synthetic: bool = False

    @property
    def pose(self) -> Doubles | None:
        """base_from_camera [4, 4] of a camera that stands still."""
        return None if self.base_from_camera is None else np.asarray(self.base_from_camera, np.float64)


class CameraFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All calibrated cameras, by the name of their feature, for one `observation.images.front`."""

    cameras: dict[str, CameraCalibration]


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
        if (camera.base_from_camera is None) == (camera.pose_feature is None):
            raise FileFault(path, f"must give {name} either base_from_camera or pose_feature")
        try:
            camera.lens  # noqa: B018  refuses what is no pinhole
            if camera.pose is not None:
                require_rigid(torch.from_numpy(camera.pose), f"base_from_camera of {name}")
        except (ModelError, ValueError) as error:
            raise FileFault(path, f"is wrong about {name}: {error}") from error
    return cameras


class Feature(msgspec.Struct, frozen=True, kw_only=True):
    """One column or camera. Here and below unknown fields are allowed: the format is not ours and grows."""

    dtype: str
    shape: tuple[int, ...] = ()
    info: dict[str, Any] | None = None


class Info(msgspec.Struct, frozen=True, kw_only=True):
    """`meta/info.json`, as far as it matters here."""

    codebase_version: str
    fps: float
    features: dict[str, Feature]
    data_path: str
    video_path: str | None = None
    chunks_size: int = CHUNK

    @property
    def videos(self) -> tuple[str, ...]:
        """The cameras: features that are videos."""
        return tuple(name for name, feature in self.features.items() if feature.dtype == "video")


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


def read_set(folder: Path) -> tuple[Info, tuple[EpisodePlace, ...]]:
    """What a data set says of itself, and its episodes by number. Raises DataError: it is none, or has none; FileFault:
    what it says is damaged."""
    info = _read_info(folder)
    rows = _episodes_v3 if info.codebase_version.startswith("v3") else _episodes_v2
    episodes = tuple(sorted(rows(folder, info), key=lambda episode: episode.number))
    if not episodes:
        raise DataError(f"{folder} has no episodes; record or export some")
    return info, episodes


def _read_info(folder: Path) -> Info:
    path = folder / "meta/info.json"
    if not path.exists():
        raise DataError(f"{folder} is no LeRobot data set: {path} is missing; give the folder that holds `meta`")
    try:
        info = read_json(path, Info, MOST_TEXT)
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
    videos = info.videos
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
    path = folder / "meta/episodes.jsonl"
    try:
        rows = [decode_json(line, _Row) for line in read_small(path, MOST_TEXT).splitlines() if line.strip()]
    except FileError as error:
        raise FileFault(path, f"is no list of episodes: it {error}") from error
    for row in rows:
        numbers = {"episode_index": row.episode_index, "episode_chunk": row.episode_index // max(1, info.chunks_size)}
        yield EpisodePlace(
            number=row.episode_index,
            length=row.length,
            data=_inside(folder, info.data_path, numbers),
            videos={name: (_video(folder, info, name, numbers), 0.0) for name in info.videos},
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
    arrow, parquet = extra("pyarrow"), extra("pyarrow.parquet")
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


class LeRobotPairs(DrawnSamples):
    """Samples of a LeRobot data set.

    frames: T. fps: of the clips, at most the set's own, which is the default; rows and pictures are taken that are
    nearest in time. size: width and height of the samples; pictures are cropped about their middle to its shape and
    resized; of two lenses both sides have the narrower one. A row or picture may lie half a frame of the set from
    the time it is taken for.
    cameras: features to choose from, by default all that are calibrated and not synthetic; source and target are drawn
    from them.
    calibration: a file in place of the set's meta/cameras.json. repeats: the set counts as so many times its episodes.
    episodes: which of the set's, from the first number up to the second, as in a slice: (-10, None) are the last ten.

    Raises: DataError, FileFault: no data set, no calibration, or an option does not fit.
    """

    def __init__(
        self,
        folder: Path,
        seed: int = 0,
        *,
        frames: int = 14,
        fps: float | None = None,
        size: tuple[int, int] = (384, 256),
        cameras: tuple[str, ...] | None = None,
        calibration: Path | None = None,
        repeats: int = 400,
        episodes: tuple[int, int | None] = (0, None),
    ) -> None:
        for module in ("pyarrow.parquet", "av"):  # what is not installed is said now, not sample by sample
            extra(module)
        self.info, every = read_set(folder)
        self.episodes = every[slice(*episodes)]
        if not self.episodes:
            raise DataError(f"{folder} has {len(every)} episodes, none of them in {episodes}")
        super().__init__(seed, repeats * len(self.episodes))
        self._calibrations = read_cameras(folder, calibration)
        real = tuple(name for name, camera in self._calibrations.items() if not camera.synthetic)
        self.cameras = self._chosen(cameras or real)
        self.fps = fps or self.info.fps
        if self.fps > self.info.fps * 1.001:
            raise DataError(f"clips of {self.fps:g} frames per second were wanted, {folder} has {self.info.fps:g}")
        self._frames, self._size, self._tolerance_s = frames, size, 0.5 / self.info.fps + _SLACK_S

    def _place(self, number: int) -> tuple[str, Path]:
        episode = self.episodes[number % len(self.episodes)]
        return episode.name, episode.data

    def _chosen(self, cameras: tuple[str, ...]) -> tuple[str, ...]:
        """Calibrated cameras that the set has."""
        videos = self.info.videos
        uncalibrated = [name for name in cameras if name not in self._calibrations]
        missing = [name for name in cameras if name not in videos]
        if uncalibrated or missing:
            raise DataError(
                f"{', '.join(uncalibrated or missing)}: {'not calibrated' if uncalibrated else 'no video of the set'}; "
                f"calibrated are {', '.join(self._calibrations)}, videos are {', '.join(videos)}"
            )
        if len(set(cameras)) < 2:
            raise DataError(f"pairs need two cameras or more, got {', '.join(cameras)}")
        return tuple(sorted(set(cameras)))

    def _made(self, number: int, random: np.random.Generator) -> Sample:
        episode = self.episodes[number % len(self.episodes)]
        cameras = [self.cameras[int(k)] for k in random.choice(len(self.cameras), 2, replace=False)]
        moving = {feature for name in cameras if (feature := self._calibrations[name].pose_feature)}
        rows = read_rows(episode.data, ["timestamp", *sorted(moving)], episode.number)
        times = row_times(episode, rows)
        chosen = self._window(episode, times, random)
        taken = [rows[row] for row in chosen]
        sides = [
            Side(
                self._pictures(episode, name, times[list(chosen)]),
                self._calibrations[name].lens,
                row_poses(episode, self._calibrations[name], taken),
            )
            for name in cameras
        ]
        return sample_of(sides, self._size, fps=self.fps, scene=episode.name, frame_numbers=chosen)

    def _window(self, episode: EpisodePlace, times: Doubles, random: np.random.Generator) -> tuple[int, ...]:
        """The rows of a clip."""
        span = (self._frames - 1) / self.fps
        latest = int(np.searchsorted(times, times[-1] - span + self._tolerance_s, side="right"))
        if latest < 1:
            raise FileFault(
                episode.data,
                f"has only {times[-1] - times[0]:.2f} s of {episode.name}; {self._frames} frames at "
                f"{self.fps:g} a second take {span:.2f} s",
            )
        wanted = times[int(random.integers(latest))] + np.arange(self._frames) / self.fps
        chosen = np.abs(times[:, None] - wanted).argmin(0)
        late = np.abs(times[chosen] - wanted)
        if late.max() > self._tolerance_s:
            gap = wanted[int(late.argmax())]
            raise FileFault(episode.data, f"has no row of {episode.name} near {gap:.3f} s: a gap in its timestamps")
        return tuple(chosen.tolist())

    def _pictures(self, episode: EpisodePlace, camera: str, times_s: Doubles) -> list[Bytes]:
        path, begin = episode.videos[camera]
        pictures = nearest_pictures(path, [begin + time for time in times_s.tolist()], self._tolerance_s, extra("av"))
        (height, width), calibration = pictures[0].shape[:2], self._calibrations[camera]
        if (width, height) != (calibration.width, calibration.height):
            said = f"{calibration.width} x {calibration.height}"
            raise FileFault(path, f"is {width} x {height}, its calibration says {said}")
        return pictures


def _number(value: float | list[float]) -> float:
    """A number that some sets keep as a list of one."""
    return float(value[0] if isinstance(value, list) else value)


def row_times(episode: EpisodePlace, rows: Sequence[Mapping[str, Any]]) -> Doubles:
    """Timestamps of an episode's rows, seconds: they rise, and are as many as the set says. Raises FileFault."""
    times = np.array([_number(row["timestamp"]) for row in rows])
    if len(times) != episode.length or not len(times):
        raise FileFault(episode.data, f"has {len(times)} rows of {episode.name}, meta says {episode.length}")
    wrong = np.flatnonzero(~(np.diff(times) > 0))
    if not np.isfinite(times).all() or len(wrong):
        row = int(wrong[0]) + 1 if len(wrong) else int(np.flatnonzero(~np.isfinite(times))[0])
        raise FileFault(episode.data, f"has timestamps out of order at row {row} of {episode.name}")
    return times


def row_poses(episode: EpisodePlace, camera: CameraCalibration, rows: Sequence[Mapping[str, Any]]) -> Doubles:
    """base_from_camera [T, 4, 4]. Raises FileFault if the feature holds no poses."""
    if camera.pose is not None:
        return np.tile(camera.pose, (len(rows), 1, 1))
    feature = camera.pose_feature or ""
    numbers = [row[feature] for row in rows]
    if any(len(pose) != 16 for pose in numbers):
        raise FileFault(episode.data, f"must have 16 numbers in {feature}, base_from_camera row by row")
    poses = np.asarray(numbers, np.float64).reshape(-1, 4, 4)
    try:
        require_rigid(torch.from_numpy(poses), feature)
    except ModelError as error:
        raise FileFault(episode.data, f"holds no poses in {feature}: {error}") from error
    return poses
