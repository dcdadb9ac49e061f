"""Episodes of a robot as a LeRobot data set (format v3.0), with the cameras' calibration beside it.

Source: the LeRobotDataset v3.0 format as its documentation describes it: many episodes a file, `meta/episodes` says
where each begins. The calibration is ours, see `folder`.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from gcd_train.errors import DataError
from gcd_train.lerobot.folder import CameraCalibration, load_arrow, load_av, write_cameras


@dataclass(slots=True)
class Spread:
    """Least, greatest, mean and deviation of what has passed."""

    count: int = 0
    low: Any = None
    high: Any = None
    total: Any = 0.0
    squares: Any = 0.0

    def add(self, rows: NDArray[Any]) -> None:
        """Count rows [T, N]."""
        values = rows.astype(np.float64)
        low, high = values.min(0), values.max(0)
        self.low = low if self.low is None else np.minimum(self.low, low)
        self.high = high if self.high is None else np.maximum(self.high, high)
        self.count += len(values)
        self.total = self.total + values.sum(0)
        self.squares = self.squares + (values**2).sum(0)

    def join(self, other: "Spread") -> None:
        """Count what another has counted."""
        self.low = other.low if self.low is None else np.minimum(self.low, other.low)
        self.high = other.high if self.high is None else np.maximum(self.high, other.high)
        self.count += other.count
        self.total, self.squares = self.total + other.total, self.squares + other.squares

    def told(self, *, picture: bool) -> dict[str, list[Any]]:
        """As LeRobot writes it: a number each, or [3, 1, 1] for the channels of pictures."""
        mean = self.total / self.count
        deviation = np.sqrt(np.maximum(self.squares / self.count - mean**2, 0.0))
        rows = {"min": self.low, "max": self.high, "mean": mean, "std": deviation}
        shaped = {name: (row.reshape(3, 1, 1) if picture else row).tolist() for name, row in rows.items()}
        return {**shaped, "count": [self.count]}


Bytes = NDArray[np.uint8]
_SAMPLED = 8
"""Every so many frames' pictures go into the statistics."""
_FILE = "chunk-{chunk:03d}/file-{file:03d}"
_FILES_A_CHUNK = 1000
_OWN = ("timestamp", "frame_index", "episode_index", "index", "task_index")


@dataclass(frozen=True, kw_only=True, slots=True)
class LoggedEpisode:
    """What one episode adds.

    features: name -> [T, N] numbers, joint positions and what else there is a name for. task: in words.
    """

    features: Mapping[str, NDArray[np.floating[Any]]]
    task: str


@dataclass(frozen=True, kw_only=True, slots=True)
class ExportOptions:
    """How a set is written.

    robot: its name. fps: of rows and videos. names: what the numbers of a feature are called. crf: quality of H.264,
    lower is better. episodes_a_file: after so many, the next files begin.
    """

    robot: str
    fps: int
    names: Mapping[str, Sequence[str]]
    crf: int = 18
    episodes_a_file: int = 100


@dataclass(slots=True)
class _Video:
    """The file a camera is writing now, and how many frames it has."""

    container: Any
    stream: Any
    frames: int = 0


@dataclass(slots=True)
class _Totals:
    episodes: int = 0
    frames: int = 0
    tasks: dict[str, int] = field(default_factory=dict[str, int])


class LeRobotWriter:
    """Writes a data set episode by episode into an empty folder; complete when it is closed.

    Raises DataError without the extra `lerobot`, or if an episode does not fit the others.
    """

    def __init__(self, folder: Path, cameras: dict[str, CameraCalibration], options: ExportOptions) -> None:
        self._folder, self._cameras, self._options = folder, cameras, options
        self._arrow, self._parquet = load_arrow()
        self._av = load_av()
        self._totals, self._spread = _Totals(), dict[str, Spread]()
        self._videos: dict[str, _Video] = {}
        self._tables: list[Any] = []
        self._episodes: list[dict[str, Any]] = []
        self._widths: dict[str, int] = {}
        (folder / "meta").mkdir(parents=True, exist_ok=True)

    def add(self, episode: LoggedEpisode, pictures: Iterator[Mapping[str, Bytes]]) -> None:
        """Append an episode; `pictures` gives a picture [H, W, 3] of every camera for each of its rows."""
        lengths = {len(rows) for rows in episode.features.values()}
        if len(lengths) != 1:
            raise DataError(f"an episode's features must be of one length, got {sorted(lengths)}")
        begins = {name: self._video(name).frames for name in self._cameras}
        spread: dict[str, Spread] = {}
        frames = self._encode(pictures, spread)
        if frames != lengths.pop():
            raise DataError(f"an episode has {frames} pictures and other numbers of rows; give one for each")
        table = self._rows(episode, frames, spread)
        self._tables.append(table)
        self._episodes.append(self._told(episode, frames, begins, spread))
        self._totals.episodes += 1
        self._totals.frames += frames
        if self._totals.episodes % self._options.episodes_a_file == 0:
            self._finish_files()

    def close(self) -> None:
        """Write what describes the set."""
        self._finish_files()
        statistics = {name: spread.told(picture=name in self._cameras) for name, spread in self._spread.items()}
        _write(self._folder / "meta/stats.json", statistics)
        _write(self._folder / "meta/info.json", self._info())
        self._write_tasks()
        write_cameras(self._folder, self._cameras)

    @property
    def _place(self) -> dict[str, int]:
        number = self._totals.episodes // self._options.episodes_a_file
        return {"chunk": number // _FILES_A_CHUNK, "file": number % _FILES_A_CHUNK}

    def _video(self, name: str) -> _Video:
        if name not in self._videos:
            path = self._folder / "videos" / name / f"{_FILE.format(**self._place)}.mp4"
            path.parent.mkdir(parents=True, exist_ok=True)
            container = self._av.open(str(path), "w")
            stream = container.add_stream("libx264", rate=self._options.fps)
            camera = self._cameras[name]
            stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, "yuv420p"
            stream.time_base = Fraction(1, self._options.fps)
            stream.codec_context.gop_size = 2  # as LeRobot's own: any frame is near a key frame
            stream.options = {"crf": str(self._options.crf), "preset": "fast", "bf": "0"}
            self._videos[name] = _Video(container, stream)
        return self._videos[name]

    def _encode(self, pictures: Iterator[Mapping[str, Bytes]], spread: dict[str, Spread]) -> int:
        count = 0
        for count, seen in enumerate(pictures, start=1):
            for name, camera in self._cameras.items():
                picture = seen[name]
                if picture.shape != (camera.height, camera.width, 3):
                    raise DataError(f"{name} must be {camera.width} x {camera.height}, got a picture {picture.shape}")
                self._encode_one(self._video(name), picture)
                if (count - 1) % _SAMPLED == 0:
                    spread.setdefault(name, Spread()).add(picture[::4, ::4].reshape(-1, 3) / 255)
        return count

    def _encode_one(self, video: _Video, picture: Bytes) -> None:
        frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
        frame.pts, frame.time_base = video.frames, Fraction(1, self._options.fps)
        video.container.mux(video.stream.encode(frame))
        video.frames += 1

    def _rows(self, episode: LoggedEpisode, frames: int, spread: dict[str, Spread]) -> Any:
        pa = self._arrow
        columns: dict[str, Any] = {}
        for name, rows in episode.features.items():
            values = np.ascontiguousarray(rows, np.float32)
            wide = self._widths.setdefault(name, values.shape[1])
            if wide != values.shape[1]:
                raise DataError(f"{name} had {wide} numbers in the first episode and has {values.shape[1]} in this one")
            columns[name] = pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), wide)
            spread[name] = Spread()
            spread[name].add(values)
        task = self._totals.tasks.setdefault(episode.task, len(self._totals.tasks))
        steps = np.arange(frames)
        numbers = (steps, np.full(frames, self._totals.episodes), self._totals.frames + steps, np.full(frames, task))
        own = [(steps / self._options.fps).astype(np.float32), *(row.astype(np.int64) for row in numbers)]
        for name, row in zip(_OWN, own, strict=True):
            columns[name] = pa.array(row)
            spread[name] = Spread()
            spread[name].add(row[:, None])
        return pa.table(columns)

    def _told(
        self, episode: LoggedEpisode, frames: int, begins: dict[str, int], spread: dict[str, Spread]
    ) -> dict[str, Any]:
        """The episode's row in meta/episodes."""
        place, fps = self._place, self._options.fps
        row: dict[str, Any] = {
            "episode_index": self._totals.episodes,
            "tasks": [episode.task],
            "length": frames,
            "dataset_from_index": self._totals.frames,
            "dataset_to_index": self._totals.frames + frames,
            "data/chunk_index": place["chunk"],
            "data/file_index": place["file"],
            "meta/episodes/chunk_index": place["chunk"],
            "meta/episodes/file_index": place["file"],
        }
        for name, first in begins.items():
            row[f"videos/{name}/chunk_index"] = place["chunk"]
            row[f"videos/{name}/file_index"] = place["file"]
            row[f"videos/{name}/from_timestamp"] = first / fps
            row[f"videos/{name}/to_timestamp"] = (first + frames) / fps
        for name, seen in spread.items():
            told = seen.told(picture=name in self._cameras)
            row.update({f"stats/{name}/{key}": value for key, value in told.items()})
            self._spread.setdefault(name, Spread()).join(seen)
        return row

    def _finish_files(self) -> None:
        """Close the videos and write the tables of the episodes since the last time."""
        for video in self._videos.values():
            video.container.mux(video.stream.encode())
            video.container.close()
        self._videos = {}
        if not self._tables:
            return
        number = (self._totals.episodes - 1) // self._options.episodes_a_file
        name = f"{_FILE.format(chunk=number // _FILES_A_CHUNK, file=number % _FILES_A_CHUNK)}.parquet"
        for table, room in (
            (self._arrow.concat_tables(self._tables), "data"),
            (self._arrow.Table.from_pylist(self._episodes), "meta/episodes"),
        ):
            path = self._folder / room / name
            path.parent.mkdir(parents=True, exist_ok=True)
            self._parquet.write_table(table, path)
        self._tables, self._episodes = [], []

    def _write_tasks(self) -> None:
        """A table whose index is the task's words, as pandas would write it."""
        tasks, pa = self._totals.tasks, self._arrow
        table = pa.table({"task_index": pa.array(list(tasks.values()), pa.int64()), "task": list(tasks)})
        told = {
            "index_columns": ["task"],
            "column_indexes": [],
            "columns": [_pandas_column("task_index", "int64"), _pandas_column("task", "unicode")],
            "creator": {"library": "pyarrow", "version": pa.__version__},
            "pandas_version": "2.2.0",
        }
        table = table.replace_schema_metadata({"pandas": json.dumps(told)})
        self._parquet.write_table(table, self._folder / "meta/tasks.parquet")

    def _info(self) -> dict[str, Any]:
        return {
            "codebase_version": "v3.0",
            "robot_type": self._options.robot,
            "total_episodes": self._totals.episodes,
            "total_frames": self._totals.frames,
            "total_tasks": len(self._totals.tasks),
            "chunks_size": _FILES_A_CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self._options.fps,
            "splits": {"train": f"0:{self._totals.episodes}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
            "features": self._features(),
        }

    def _features(self) -> dict[str, Any]:
        told: dict[str, Any] = {name: self._video_feature(camera) for name, camera in self._cameras.items()}
        for name, wide in self._widths.items():
            names = list(self._options.names.get(name, [])) or None
            told[name] = {"dtype": "float32", "shape": [wide], "names": names}
        for name in _OWN:
            told[name] = {"dtype": "float32" if name == "timestamp" else "int64", "shape": [1], "names": None}
        return told

    def _video_feature(self, camera: CameraCalibration) -> dict[str, Any]:
        info = {
            "video.height": camera.height,
            "video.width": camera.width,
            "video.codec": "h264",
            "video.pix_fmt": "yuv420p",
            "video.is_depth_map": False,
            "video.fps": self._options.fps,
            "video.channels": 3,
            "has_audio": False,
        }
        shape = [camera.height, camera.width, 3]
        return {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"], "info": info}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            for video in self._videos.values():
                video.container.close()


def _pandas_column(name: str, kind: str) -> dict[str, Any]:
    kept = "object" if kind == "unicode" else kind
    return {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": kept, "metadata": None}


def _write(path: Path, told: dict[str, Any]) -> None:
    path.write_text(json.dumps(told, indent=4) + "\n", encoding="utf-8")
