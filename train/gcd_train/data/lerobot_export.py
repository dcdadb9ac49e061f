"""Episodes of a robot, as those of the tabletop world, as a LeRobot data set (format v3.0) with calibrated cameras.

Source: the LeRobotDataset v3.0 format as its documentation describes it: many episodes a file, `meta/episodes` says
where each begins. The calibration is ours, see `lerobot`.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics
from gcd_train.data.lerobot import CAMERA_FILE, CHUNK, CameraCalibration, CameraFile, extra
from gcd_train.errors import DataError, RecipeError, RunError
from gcd_train.files import new_folder
from gcd_train.scenes.drop.world import HFOV_DEG, orbit_cameras
from gcd_train.scenes.frozen import freeze
from gcd_train.scenes.renderer import Renderer
from gcd_train.scenes.tabletop.scene import UNITS_A_METRE, Episode, tabletop_episode, upright_base
from gcd_train.scenes.tabletop.simulation import FPS

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float64]
WRIST = "wrist"
_IMAGES = "observation.images."
_POSE_FEATURE = f"observation.camera_pose.{WRIST}"
_SAMPLED = 8
"""Every so many frames' pictures go into the statistics."""
_FILE = "chunk-{chunk:03d}/file-{file:03d}"
_OWN = ("timestamp", "frame_index", "episode_index", "index", "task_index")


@dataclass(frozen=True, kw_only=True, slots=True)
class LoggedEpisode:
    """What one episode adds.

    features: name -> [T, N] numbers, joint positions and what else there is a name for. task: in words.
    """

    features: Mapping[str, NDArray[np.floating[Any]]]
    task: str


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

    robot: its name. fps: of rows and videos. names: what the numbers of a feature are called. crf: quality of H.264,
    lower is better. episodes_a_file: after so many, the next files begin.
    Raises DataError without the extra `lerobot`, or if an episode does not fit the others.
    """

    def __init__(
        self,
        folder: Path,
        cameras: dict[str, CameraCalibration],
        *,
        robot: str,
        fps: int,
        names: Mapping[str, Sequence[str]],
        crf: int = 18,
        episodes_a_file: int = 100,
    ) -> None:
        self._folder, self._cameras, self._robot, self._fps = folder, cameras, robot, fps
        self._names, self._crf, self._episodes_a_file = names, crf, episodes_a_file
        self._arrow, self._parquet, self._av = extra("pyarrow"), extra("pyarrow.parquet"), extra("av")
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
        pa = self._arrow
        flat = {name: pa.array(values.reshape(-1)) for name, values in columns.items()}
        lists = {  # LeRobot's own are plain numbers
            name: pa.FixedSizeListArray.from_arrays(flat[name], values.shape[1])
            for name, values in columns.items()
            if name not in _OWN
        }
        self._tables.append(pa.table(flat | lists))
        self._episodes.append(self._episode(episode, frames, begins, statistics))
        self._count, self._frames = self._count + 1, self._frames + frames
        if self._count % self._episodes_a_file == 0:
            self._finish_files()

    def close(self) -> None:
        """Write what describes the set."""
        self._finish_files()
        statistics = {name: self._listed(name, _together(parts)) for name, parts in self._statistics.items()}
        for name, told in (("stats", statistics), ("info", self._info())):
            (self._folder / f"meta/{name}.json").write_text(json.dumps(told, indent=4) + "\n", encoding="utf-8")
        self._write_tasks()
        calibration = msgspec.json.format(msgspec.json.encode(CameraFile(cameras=self._cameras)), indent=1)
        (self._folder / CAMERA_FILE).write_bytes(calibration)

    @property
    def _place(self) -> dict[str, int]:
        number = self._count // self._episodes_a_file
        return {"chunk": number // CHUNK, "file": number % CHUNK}

    def _video(self, name: str) -> _Video:
        if name not in self._videos:
            path = self._folder / "videos" / name / f"{_FILE.format(**self._place)}.mp4"
            path.parent.mkdir(parents=True, exist_ok=True)
            container = self._av.open(str(path), "w")
            stream = container.add_stream("libx264", rate=self._fps)
            camera = self._cameras[name]
            stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, "yuv420p"
            stream.time_base = Fraction(1, self._fps)
            stream.codec_context.gop_size = 2  # as LeRobot's own: any frame is near a key frame
            stream.options = {"crf": str(self._crf), "preset": "fast", "bf": "0"}
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
                video, frame = (
                    self._video(name),
                    self._av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), "rgb24"),
                )
                frame.pts, frame.time_base = video.frames, Fraction(1, self._fps)
                video.container.mux(video.stream.encode(frame))
                video.frames += 1
                if number % _SAMPLED == 0:
                    sampled[name].append(picture[::4, ::4].reshape(-1, 3) / 255)
        return {name: _statistics(np.concatenate(rows)) for name, rows in sampled.items() if rows}

    def _columns(self, episode: LoggedEpisode, frames: int) -> dict[str, NDArray[Any]]:
        """Rows [T, N] of an episode by name: its features and LeRobot's own numbers."""
        columns = {name: np.ascontiguousarray(rows, np.float32) for name, rows in episode.features.items()}
        for name, rows in columns.items():
            width = self._statistics[name][0]["mean"].shape[0] if name in self._statistics else rows.shape[1]
            if width != rows.shape[1]:
                raise DataError(f"{name} had {width} numbers in the first episode and has {rows.shape[1]} in this one")
        task, steps = self._tasks.setdefault(episode.task, len(self._tasks)), np.arange(frames)
        numbers = (steps, np.full(frames, self._count), self._frames + steps, np.full(frames, task))
        own = [(steps / self._fps).astype(np.float32), *(row.astype(np.int64) for row in numbers)]
        return columns | {name: row[:, None] for name, row in zip(_OWN, own, strict=True)}

    def _episode(
        self, episode: LoggedEpisode, frames: int, begins: dict[str, int], statistics: dict[str, Statistics]
    ) -> dict[str, Any]:
        """The episode's row in meta/episodes."""
        place, fps = self._place, self._fps
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
        number = (self._count - 1) // self._episodes_a_file
        name = f"{_FILE.format(chunk=number // CHUNK, file=number % CHUNK)}.parquet"
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
            "robot_type": self._robot,
            "total_episodes": self._count,
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self._fps,
            "splits": {"train": f"0:{self._count}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
            "features": self._features(),
        }

    def _features(self) -> dict[str, Any]:
        told: dict[str, Any] = {}
        for name, camera in self._cameras.items():
            video: dict[str, Any] = {"height": camera.height, "width": camera.width, "codec": "h264"}
            video |= {"pix_fmt": "yuv420p", "is_depth_map": False, "fps": self._fps, "channels": 3}
            info = {f"video.{key}": value for key, value in video.items()} | {"has_audio": False}
            shape, axes = [camera.height, camera.width, 3], ["height", "width", "channels"]
            told[name] = {"dtype": "video", "shape": shape, "names": axes, "info": info}
        for name, parts in self._statistics.items():
            if name not in self._cameras and name not in _OWN:
                names = list(self._names.get(name, [])) or None
                told[name] = {"dtype": "float32", "shape": list(parts[0]["mean"].shape), "names": names}
        for name in _OWN:
            told[name] = {"dtype": "float32" if name == "timestamp" else "int64", "shape": [1], "names": None}
        return told

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            for video in self._videos.values():
                video.container.close()


@dataclass(frozen=True, kw_only=True, slots=True)
class TabletopExport:
    """How episodes are made.

    seeds: one an episode. frames: of an episode, at 24 Hz. cameras: of view0..view15 and wrist, which moves with the
    hand; the others stand where Kubric-4D has them, turned so that they look at every episode's robot alike.
    width, height: pixels. oversample: as in `Renderer`.
    """

    seeds: range
    frames: int = 120
    cameras: tuple[str, ...] = ("view0", "view4", "view9", WRIST)
    width: int = 320
    height: int = 240
    oversample: int = 2


def export_tabletop(out: Path, export: TabletopExport) -> Iterator[int]:
    """Write the data set `out`; yields how many episodes are done. The folder appears when all are.

    Raises:
        RecipeError: no such camera. RunError: `out` is there already, or cannot be written.
        RenderError, DataError: an extra is not installed.
    """
    poses = _base_from_cameras(export.cameras)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise RunError(f"{out} is there already; choose another folder, or remove it")
    names = {_POSE_FEATURE: [f"base_from_camera_{row}{column}" for row in range(4) for column in range(4)]}
    with (
        new_folder(out.absolute().parent, out.name) as folder,
        Renderer(export.width, export.height, oversample=export.oversample) as renderer,
        LeRobotWriter(
            folder, _calibrations(export, poses), robot="tabletop primitive", fps=round(FPS), names=names
        ) as writer,
    ):
        for done, seed in enumerate(export.seeds, start=1):
            episode = tabletop_episode(seed, frames=export.frames, skipped_s=0.0)
            features = {"observation.state": episode.motion.state, "action": episode.motion.action}
            if WRIST in export.cameras:
                base_from_wrist = np.linalg.inv(episode.world_from_base) @ episode.wrist
                features[_POSE_FEATURE] = _in_metres(base_from_wrist).reshape(-1, 16)
            logged = LoggedEpisode(features=features, task=episode.task)
            writer.add(logged, _pictures(renderer, episode, poses, export))
            yield done


def _base_from_cameras(names: tuple[str, ...]) -> dict[str, Floats]:
    """base_from_camera [4, 4] of the cameras that stand still, decimetres."""
    there = orbit_cameras(1)
    unknown = [name for name in names if name not in there and name != WRIST]
    if unknown or len(set(names)) != len(names) or len(names) < 2:
        raise RecipeError(
            f"cameras must be two or more different ones of view0..view15 and {WRIST}, got {', '.join(names)}"
        )
    base_from_world = np.linalg.inv(upright_base())
    return {name: base_from_world @ there[name][0] for name in names if name != WRIST}


def _calibrations(export: TabletopExport, poses: Mapping[str, Floats]) -> dict[str, CameraCalibration]:
    lens = Intrinsics.from_hfov(HFOV_DEG, export.width, export.height)
    made: dict[str, CameraCalibration] = {}
    for name in export.cameras:
        rows = None if name == WRIST else tuple(map(tuple, _in_metres(poses[name]).tolist()))
        made[_IMAGES + name] = CameraCalibration(
            width=lens.width,
            height=lens.height,
            fx=lens.fx,
            fy=lens.fy,
            cx=lens.cx,
            cy=lens.cy,
            base_from_camera=rows,
            pose_feature=_POSE_FEATURE if name == WRIST else None,
        )
    return made


def _pictures(
    renderer: Renderer, episode: Episode, poses: Mapping[str, Floats], export: TabletopExport
) -> Iterator[Mapping[str, NDArray[np.uint8]]]:
    """A picture of every camera, frame by frame."""
    cameras = {name: np.tile(episode.world_from_base @ pose, (export.frames, 1, 1)) for name, pose in poses.items()}
    if WRIST in export.cameras:
        cameras[WRIST] = episode.wrist
    views = renderer.views(freeze(episode.scene), cameras)
    while seen := list(islice(views, len(cameras))):
        yield {_IMAGES + name: rendering.rgb for _, name, rendering in seen}


def _in_metres(poses: Floats) -> Floats:
    scaled = poses.copy()
    scaled[..., :3, 3] /= UNITS_A_METRE
    return scaled
