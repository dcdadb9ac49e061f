"""Episodes of a robot, as those of the tabletop world, as a LeRobot data set (format v3.0) with calibrated cameras.

Source: the LeRobotDataset v3.0 format as its documentation describes it: many episodes a file, here all of them, and
`meta/episodes` says where each begins. The calibration is ours, see `lerobot`.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Self

import msgspec
import numpy as np
from numpy.typing import NDArray
from typer import Option

from gcd_model.geometry import Intrinsics
from gcd_train.data.encodings import Bytes, Doubles
from gcd_train.data.lerobot import CAMERA_FILE, CHUNK, CameraCalibration, CameraFile, extra
from gcd_train.data.videos import FileLens
from gcd_train.errors import DataError, RecipeError, RunError
from gcd_train.files import new_folder
from gcd_train.scenes.drop.world import HFOV_DEG, orbit_cameras
from gcd_train.scenes.renderer import Renderer
from gcd_train.scenes.tabletop.scene import UNITS_A_METRE, Episode, tabletop_episode, upright_base
from gcd_train.scenes.tabletop.simulation import FPS
from gcd_train.scenes.triangles import freeze

WRIST = "wrist"
_IMAGES = "observation.images."
_POSE_FEATURE = f"observation.camera_pose.{WRIST}"
_SAMPLED = 8
"""Every so many frames' pictures go into the statistics."""
_FILE = "chunk-000/file-000"
_PERCENTS = (1, 10, 50, 90, 99)
"""Quantiles in the statistics, as LeRobot has them."""
_OWN = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def new_video(path: Path, width: int, height: int, fps: float, crf: int = 18) -> tuple[Any, Any]:
    """Container and stream of a video that LeRobot reads, for `add_picture`. crf: quality of H.264, lower is better; 0
    loses nothing."""
    container, rate = extra("av").open(str(path), "w", format="mp4"), Fraction(fps).limit_denominator(1001)
    stream = container.add_stream("libx264", rate=rate)
    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
    stream.time_base = 1 / rate
    stream.codec_context.gop_size = 2  # as LeRobot's own: any frame is near a key frame
    stream.options = {"crf": str(crf), "preset": "fast", "bf": "0"}
    return container, stream


def add_picture(container: Any, stream: Any, picture: Bytes, number: int) -> None:
    """Append a picture, u8 [H, W, 3], as frame `number`."""
    frame = extra("av").VideoFrame.from_ndarray(np.ascontiguousarray(picture), "rgb24")
    frame.pts, frame.time_base = number, 1 / stream.codec_context.framerate
    container.mux(stream.encode(frame))


def video_feature(width: int, height: int, fps: float) -> dict[str, Any]:
    """What meta/info.json says of such a video."""
    video: dict[str, Any] = {"height": height, "width": width, "codec": "h264"}
    video |= {"pix_fmt": "yuv420p", "is_depth_map": False, "fps": fps, "channels": 3}
    info = {f"video.{key}": value for key, value in video.items()} | {"has_audio": False}
    return {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"], "info": info}


def statistics_of(rows: NDArray[Any], *, colours: bool) -> dict[str, list[Any]]:
    """Of rows [N, C] as LeRobot writes it, C numbers each; or of colours [frames, pixels, 3], 0 to 255, as [3, 1, 1] in
    [0, 1]. It counts rows or frames: the weight that a set has when LeRobot joins several."""
    axes = tuple(range(rows.ndim - 1))
    found = {"min": rows.min(axes), "max": rows.max(axes), "mean": rows.mean(axes), "std": rows.std(axes)}
    found |= {f"q{percent:02d}": np.percentile(rows, percent, axis=axes) for percent in _PERCENTS}
    unit, shape = (255, (3, 1, 1)) if colours else (1, (-1,))
    return {key: (row / unit).reshape(shape).tolist() for key, row in found.items()} | {"count": [len(rows)]}


class LeRobotWriter:
    """Writes a data set episode by episode into an empty folder; complete when it is closed.

    robot: its name. fps: of rows and videos. names: what the numbers of a feature are called. Raises DataError without
    the extra `lerobot`, or if an episode does not fit the others.
    """

    def __init__(
        self,
        folder: Path,
        cameras: dict[str, CameraCalibration],
        *,
        robot: str,
        fps: int,
        names: Mapping[str, Sequence[str]],
    ) -> None:
        self._folder, self._cameras, self._robot, self._fps, self._names = folder, cameras, robot, fps, names
        self._arrow, self._parquet = extra("pyarrow"), extra("pyarrow.parquet")
        self._frames, self._tasks = 0, dict[str, int]()
        # Rows [N, C] of every feature, and colours [1, pixels, 3] of some pictures.
        self._seen = dict[str, list[NDArray[Any]]]()
        self._tables, self._episodes = list[Any](), list[dict[str, Any]]()
        self._videos: dict[str, tuple[Any, Any]] = {}
        (folder / "meta").mkdir(parents=True, exist_ok=True)
        for name, camera in cameras.items():
            path = self._place(f"videos/{name}", "mp4")
            self._videos[name] = new_video(path, camera.width, camera.height, fps)

    def add(
        self,
        features: Mapping[str, NDArray[np.floating[Any]]],
        task: str,
        pictures: Iterator[Mapping[str, Bytes]],
    ) -> None:
        """Append an episode.

        features: name -> [T, N] numbers, joint positions and what else there is a name for. task: in words. pictures:
        gives one [H, W, 3] of every camera for each of its rows.
        """
        lengths = {len(rows) for rows in features.values()}
        frames = self._encode(pictures)
        if lengths != {frames}:
            raise DataError(f"an episode has {frames} pictures and {sorted(lengths)} rows; give one for each")
        columns = self._columns(features, task, frames)
        for name, values in columns.items():
            self._seen.setdefault(name, []).append(values.astype(np.float64))
        pa = self._arrow
        flat = {name: pa.array(values.reshape(-1)) for name, values in columns.items()}
        lists = {  # LeRobot's own are plain numbers
            name: pa.FixedSizeListArray.from_arrays(flat[name], values.shape[1])
            for name, values in columns.items()
            if name not in _OWN
        }
        self._tables.append(pa.table(flat | lists))
        self._episodes.append(self._episode(task, frames))
        self._frames += frames

    def close(self) -> None:
        """Write all but the pictures."""
        for container, stream in self._videos.values():
            container.mux(stream.encode())
            container.close()
        pa, tasks = self._arrow, self._tasks
        self._parquet.write_table(pa.concat_tables(self._tables), self._place("data", "parquet"))
        self._parquet.write_table(pa.Table.from_pylist(self._episodes), self._place("meta/episodes", "parquet"))
        columns = [  # of a table whose index is the task's words, as pandas writes it
            {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": stored, "metadata": None}
            for name, kind, stored in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
        ]
        index = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.2.0"}
        table = pa.table({"task_index": pa.array(list(tasks.values()), pa.int64()), "task": list(tasks)})
        table = table.replace_schema_metadata({"pandas": json.dumps(index)})
        self._parquet.write_table(table, self._folder / "meta/tasks.parquet")
        statistics = {
            name: statistics_of(np.concatenate(rows), colours=name in self._cameras)
            for name, rows in self._seen.items()
        }
        for name, told in (("stats", statistics), ("info", self._info())):
            (self._folder / f"meta/{name}.json").write_text(json.dumps(told, indent=4) + "\n", encoding="utf-8")
        calibration = msgspec.json.format(msgspec.json.encode(CameraFile(cameras=self._cameras)), indent=1)
        (self._folder / CAMERA_FILE).write_bytes(calibration)

    def _place(self, room: str, suffix: str) -> Path:
        path = self._folder / room / f"{_FILE}.{suffix}"
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _encode(self, pictures: Iterator[Mapping[str, Bytes]]) -> int:
        """Append the pictures to the videos: how many."""
        frames = 0
        for frames, seen in enumerate(pictures, start=1):
            for name, camera in self._cameras.items():
                picture = seen[name]
                if picture.shape != (camera.height, camera.width, 3):
                    raise DataError(f"{name} must be {camera.width} x {camera.height}, got a picture {picture.shape}")
                add_picture(*self._videos[name], picture, self._frames + frames - 1)
                if frames % _SAMPLED == 1:
                    self._seen.setdefault(name, []).append(picture[::4, ::4].reshape(1, -1, 3))
        return frames

    def _columns(
        self, features: Mapping[str, NDArray[np.floating[Any]]], task: str, frames: int
    ) -> dict[str, NDArray[Any]]:
        """Rows [T, N] of an episode by name: its features and LeRobot's own numbers."""
        columns = {name: np.ascontiguousarray(rows, np.float32) for name, rows in features.items()}
        for name, rows in columns.items():
            width = self._seen[name][0].shape[1] if name in self._seen else rows.shape[1]
            if width != rows.shape[1]:
                raise DataError(f"{name} had {width} numbers in the first episode and has {rows.shape[1]} in this one")
        number, steps = self._tasks.setdefault(task, len(self._tasks)), np.arange(frames)
        numbers = (steps, np.full(frames, len(self._episodes)), self._frames + steps, np.full(frames, number))
        own = [(steps / self._fps).astype(np.float32), *(row.astype(np.int64) for row in numbers)]
        return columns | {name: row[:, None] for name, row in zip(_OWN, own, strict=True)}

    def _episode(self, task: str, frames: int) -> dict[str, Any]:
        """The episode's row in meta/episodes."""
        row: dict[str, Any] = {
            "episode_index": len(self._episodes),
            "tasks": [task],
            "length": frames,
            "dataset_from_index": self._frames,
            "dataset_to_index": self._frames + frames,
        }
        rooms = ["data", "meta/episodes", *(f"videos/{name}" for name in self._cameras)]
        row |= {f"{room}/{part}_index": 0 for room in rooms for part in ("chunk", "file")}
        for name in self._cameras:
            row[f"videos/{name}/from_timestamp"] = self._frames / self._fps
            row[f"videos/{name}/to_timestamp"] = (self._frames + frames) / self._fps
        return row

    def _info(self) -> dict[str, Any]:
        return {
            "codebase_version": "v3.0",
            "robot_type": self._robot,
            "total_episodes": len(self._episodes),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self._fps,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
            "features": self._features(),
        }

    def _features(self) -> dict[str, Any]:
        told: dict[str, Any] = {}
        for name, camera in self._cameras.items():
            told[name] = video_feature(camera.width, camera.height, self._fps)
        for name, rows in self._seen.items():
            if name not in self._cameras and name not in _OWN:
                names = list(self._names.get(name, [])) or None
                told[name] = {"dtype": "float32", "shape": [rows[0].shape[1]], "names": names}
        for name in _OWN:
            told[name] = {"dtype": "float32" if name == "timestamp" else "int64", "shape": [1], "names": None}
        return told

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            for container, _ in self._videos.values():
                container.close()


@dataclass(frozen=True, kw_only=True, slots=True)
class TabletopExport:
    """How episodes are made: options of `gcd-train export lerobot`.

    The wrist's camera moves with the hand; the others stand where Kubric-4D has them, turned so that they look at every
    episode's robot alike.
    """

    episodes: Annotated[int, Option(min=1, help="How many episodes, one seed each.")] = 10
    first_seed: Annotated[int, Option(min=0, help="Seed of the first episode.")] = 0
    frames: Annotated[int, Option(min=2, help="Time steps of an episode, at 24 Hz.")] = 120
    width: Annotated[int, Option(min=32, help="Of the pictures, pixels, even.")] = 320
    height: Annotated[int, Option(min=32, help="Of the pictures, pixels, even.")] = 240
    cameras: Annotated[str, Option(help="Two or more of view0 to view15 and wrist, with commas.")] = (
        "view0,view4,view9,wrist"
    )
    oversample: Annotated[int, Option(min=1, max=4, help="Anti-aliasing: pixels drawn per pixel and side.")] = 2

    @property
    def names(self) -> tuple[str, ...]:
        """Of the cameras."""
        return tuple(name.strip() for name in self.cameras.split(","))


def export_tabletop(out: Path, export: TabletopExport) -> Iterator[int]:
    """Write the data set `out`; yields how many episodes are done. The folder appears when all are.

    Raises:
        RecipeError: no such camera, or an odd size. RunError: `out` is there already, or cannot be written.
        RenderError, DataError: an extra is not installed.
    """
    if export.width % 2 or export.height % 2:
        raise RecipeError(f"H.264 wants an even width and height, got {export.width} x {export.height}")
    poses = _base_from_cameras(export.names)
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
        for done in range(1, export.episodes + 1):
            episode = tabletop_episode(export.first_seed + done - 1, frames=export.frames, skipped_s=0.0)
            features = {"observation.state": episode.motion.state, "action": episode.motion.action}
            if WRIST in export.names:
                base_from_wrist = np.linalg.inv(episode.world_from_base) @ episode.wrist
                features[_POSE_FEATURE] = _in_metres(base_from_wrist).reshape(-1, 16)
            writer.add(features, episode.task, _pictures(renderer, episode, poses, export))
            yield done


def _base_from_cameras(names: tuple[str, ...]) -> dict[str, Doubles]:
    """base_from_camera [4, 4] of the cameras that stand still, decimetres."""
    there = orbit_cameras(1)
    unknown = [name for name in names if name not in there and name != WRIST]
    if unknown or len(set(names)) != len(names) or len(names) < 2:
        raise RecipeError(
            f"cameras must be two or more different ones of view0..view15 and {WRIST}, got {', '.join(names)}"
        )
    base_from_world = np.linalg.inv(upright_base())
    return {name: base_from_world @ there[name][0] for name in names if name != WRIST}


def _calibrations(export: TabletopExport, poses: Mapping[str, Doubles]) -> dict[str, CameraCalibration]:
    lens = Intrinsics.from_hfov(HFOV_DEG, export.width, export.height)
    made: dict[str, CameraCalibration] = {}
    for name in export.names:
        rows = None if name == WRIST else tuple(map(tuple, _in_metres(poses[name]).tolist()))
        made[_IMAGES + name] = CameraCalibration(
            **{field: getattr(lens, field) for field in FileLens.__struct_fields__},
            base_from_camera=rows,
            pose_feature=_POSE_FEATURE if name == WRIST else None,
        )
    return made


def _pictures(
    renderer: Renderer, episode: Episode, poses: Mapping[str, Doubles], export: TabletopExport
) -> Iterator[Mapping[str, Bytes]]:
    """A picture of every camera, frame by frame."""
    cameras = {name: np.tile(episode.world_from_base @ pose, (export.frames, 1, 1)) for name, pose in poses.items()}
    if WRIST in export.names:
        cameras[WRIST] = episode.wrist
    views = renderer.views(freeze(episode.scene), cameras)
    while seen := list(islice(views, len(cameras))):
        yield {_IMAGES + name: rendering.rgb for _, name, rendering in seen}


def _in_metres(poses: Doubles) -> Doubles:
    scaled = poses.copy()
    scaled[..., :3, 3] /= UNITS_A_METRE
    return scaled
