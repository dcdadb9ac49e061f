"""Episodes of a robot as a LeRobot data set (format v3.0), with the cameras' calibration beside it.

Source: the LeRobotDataset v3.0 format as its documentation describes it: many episodes a file, `meta/episodes` says
where each begins. The calibration is ours, see `folder`.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from gcd_train.errors import DataError
from gcd_train.lerobot.folder import CameraCalibration, load_arrow, load_av, write_cameras

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


Statistics = dict[str, NDArray[np.float64]]
"""min, max, mean and std of each number, and the count of rows, [1]."""


def _statistics(rows: NDArray[Any]) -> Statistics:
    """Of rows [T, N]."""
    values = rows.astype(np.float64)
    spread = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    return {**spread, "count": np.array([len(values)])}


def _together(parts: Sequence[Statistics]) -> Statistics:
    """Of all rows that some statistics are of."""
    count = np.stack([part["count"] for part in parts])
    mean = sum(part["mean"] * part["count"] for part in parts) / count.sum()
    square = sum((part["std"] ** 2 + part["mean"] ** 2) * part["count"] for part in parts) / count.sum()
    return {
        "min": np.min([part["min"] for part in parts], 0),
        "max": np.max([part["max"] for part in parts], 0),
        "mean": mean,
        "std": np.sqrt(np.maximum(square - mean**2, 0.0)),
        "count": count.sum(0),
    }


@dataclass(slots=True)
class _Video:
    """The file a camera is writing now, and how many frames it has."""

    container: Any
    stream: Any
    frames: int = 0


class LeRobotWriter:
    """Writes a data set episode by episode into an empty folder; complete when it is closed.

    Raises DataError without the extra `lerobot`, or if an episode does not fit the others.
    """

    def __init__(self, folder: Path, cameras: dict[str, CameraCalibration], options: ExportOptions) -> None:
        self._folder, self._cameras, self._options = folder, cameras, options
        self._arrow, self._parquet = load_arrow()
        self._av = load_av()
        self._count, self._frames, self._tasks = 0, 0, dict[str, int]()
        self._statistics: dict[str, list[Statistics]] = {}
        self._videos: dict[str, _Video] = {}
        self._tables: list[Any] = []
        self._episodes: list[dict[str, Any]] = []
        (folder / "meta").mkdir(parents=True, exist_ok=True)

    def add(self, episode: LoggedEpisode, pictures: Iterator[Mapping[str, Bytes]]) -> None:
        """Append an episode; `pictures` gives a picture [H, W, 3] of every camera for each of its rows."""
        lengths = {len(rows) for rows in episode.features.values()}
        begins = {name: self._video(name).frames for name in self._cameras}
        statistics = self._encode(pictures)
        frames = next(iter(self._videos.values())).frames - next(iter(begins.values()))
        if lengths != {frames}:
            raise DataError(f"an episode has {frames} pictures and {sorted(lengths)} rows; give one for each")
        columns = self._columns(episode, frames)
        statistics |= {name: _statistics(values) for name, values in columns.items()}
        self._tables.append(self._arrow.table({name: self._column(name, values) for name, values in columns.items()}))
        self._episodes.append(self._episode(episode, frames, begins, statistics))
        self._count, self._frames = self._count + 1, self._frames + frames
        if self._count % self._options.episodes_a_file == 0:
            self._finish_files()

    def close(self) -> None:
        """Write what describes the set."""
        self._finish_files()
        statistics = {name: self._listed(name, _together(parts)) for name, parts in self._statistics.items()}
        _write(self._folder / "meta/stats.json", statistics)
        _write(self._folder / "meta/info.json", self._info())
        self._write_tasks()
        write_cameras(self._folder, self._cameras)

    @property
    def _place(self) -> dict[str, int]:
        number = self._count // self._options.episodes_a_file
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

    def _encode(self, pictures: Iterator[Mapping[str, Bytes]]) -> dict[str, Statistics]:
        """Append the pictures to the videos; statistics of the colours of some."""
        sampled: dict[str, list[NDArray[np.float64]]] = {name: [] for name in self._cameras}
        for number, seen in enumerate(pictures):
            for name, camera in self._cameras.items():
                picture = seen[name]
                if picture.shape != (camera.height, camera.width, 3):
                    raise DataError(f"{name} must be {camera.width} x {camera.height}, got a picture {picture.shape}")
                self._encode_one(self._video(name), picture)
                if number % _SAMPLED == 0:
                    sampled[name].append(picture[::4, ::4].reshape(-1, 3) / 255)
        return {name: _statistics(np.concatenate(rows)) for name, rows in sampled.items() if rows}

    def _encode_one(self, video: _Video, picture: Bytes) -> None:
        frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
        frame.pts, frame.time_base = video.frames, Fraction(1, self._options.fps)
        video.container.mux(video.stream.encode(frame))
        video.frames += 1

    def _columns(self, episode: LoggedEpisode, frames: int) -> dict[str, NDArray[Any]]:
        """Rows [T, N] of an episode by name: its features and LeRobot's own numbers."""
        columns = {name: np.ascontiguousarray(rows, np.float32) for name, rows in episode.features.items()}
        for name, rows in columns.items():
            width = self._statistics[name][0]["mean"].shape[0] if name in self._statistics else rows.shape[1]
            if width != rows.shape[1]:
                raise DataError(f"{name} had {width} numbers in the first episode and has {rows.shape[1]} in this one")
        task, steps = self._tasks.setdefault(episode.task, len(self._tasks)), np.arange(frames)
        numbers = (steps, np.full(frames, self._count), self._frames + steps, np.full(frames, task))
        own = [(steps / self._options.fps).astype(np.float32), *(row.astype(np.int64) for row in numbers)]
        return columns | {name: row[:, None] for name, row in zip(_OWN, own, strict=True)}

    def _column(self, name: str, values: NDArray[Any]) -> Any:
        """LeRobot's own are plain numbers, features are lists."""
        flat = self._arrow.array(values.reshape(-1))
        return flat if name in _OWN else self._arrow.FixedSizeListArray.from_arrays(flat, values.shape[1])

    def _episode(
        self, episode: LoggedEpisode, frames: int, begins: dict[str, int], statistics: dict[str, Statistics]
    ) -> dict[str, Any]:
        """The episode's row in meta/episodes."""
        place, fps = self._place, self._options.fps
        row: dict[str, Any] = {
            "episode_index": self._count,
            "tasks": [episode.task],
            "length": frames,
            "dataset_from_index": self._frames,
            "dataset_to_index": self._frames + frames,
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
        for name, seen in statistics.items():
            row.update({f"stats/{name}/{key}": value for key, value in self._listed(name, seen).items()})
            self._statistics.setdefault(name, []).append(seen)
        return row

    def _listed(self, name: str, statistics: Statistics) -> dict[str, list[Any]]:
        """As LeRobot writes it: a number each, or [3, 1, 1] for the channels of pictures."""
        shaped = name in self._cameras
        return {
            key: (row.reshape(3, 1, 1) if shaped and key != "count" else row).tolist()
            for key, row in statistics.items()
        }

    def _finish_files(self) -> None:
        """Close the videos and write the tables of the episodes since the last time."""
        for video in self._videos.values():
            video.container.mux(video.stream.encode())
            video.container.close()
        self._videos = {}
        if not self._tables:
            return
        number = (self._count - 1) // self._options.episodes_a_file
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
        """A table whose index is the task's words, as pandas writes it."""
        tasks, pa = self._tasks, self._arrow
        table = pa.table({"task_index": pa.array(list(tasks.values()), pa.int64()), "task": list(tasks)})
        columns = [
            {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": stored, "metadata": None}
            for name, kind, stored in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
        ]
        index = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.2.0"}
        self._parquet.write_table(
            table.replace_schema_metadata({"pandas": json.dumps(index)}), self._folder / "meta/tasks.parquet"
        )

    def _info(self) -> dict[str, Any]:
        return {
            "codebase_version": "v3.0",
            "robot_type": self._options.robot,
            "total_episodes": self._count,
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": _FILES_A_CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self._options.fps,
            "splits": {"train": f"0:{self._count}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
            "features": self._features(),
        }

    def _features(self) -> dict[str, Any]:
        told: dict[str, Any] = {name: self._video_feature(camera) for name, camera in self._cameras.items()}
        for name, parts in self._statistics.items():
            if name in self._cameras or name in _OWN:
                continue
            names = list(self._options.names.get(name, [])) or None
            told[name] = {"dtype": "float32", "shape": list(parts[0]["mean"].shape), "names": names}
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


def _write(path: Path, told: dict[str, Any]) -> None:
    path.write_text(json.dumps(told, indent=4) + "\n", encoding="utf-8")
