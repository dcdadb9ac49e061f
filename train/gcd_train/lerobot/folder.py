"""What a LeRobot data set says of itself: its features, and where each episode's rows and pictures lie.

Source: the documented formats v3.0 (several episodes a file, placed by `meta/episodes`) and v2.1 (one file an episode).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

import msgspec

from gcd_model.errors import FileError
from gcd_model.small_files import decode_json, read_json, read_small
from gcd_train.data.files import FileFault
from gcd_train.errors import DataError
from gcd_train.lerobot.extra import load_arrow

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
    wanted = ["episode_index", "length", "data/chunk_index", "data/file_index"]
    keys = ("chunk_index", "file_index", "from_timestamp")
    wanted += [f"videos/{name}/{key}" for name in videos for key in keys]
    for path in paths:
        for row in read_rows(path, wanted):
            data = {"chunk_index": int(row["data/chunk_index"]), "file_index": int(row["data/file_index"])}
            yield EpisodePlace(
                number=int(row["episode_index"]),
                length=int(row["length"]),
                data=_inside(folder, info.data_path, data),
                videos={name: _video_place(folder, info, name, row) for name in videos},
            )


def _video_place(folder: Path, info: Info, name: str, row: Mapping[str, Any]) -> tuple[Path, float]:
    chunk, file, since = (row[f"videos/{name}/{key}"] for key in ("chunk_index", "file_index", "from_timestamp"))
    numbers = {"video_key": name, "chunk_index": int(chunk), "file_index": int(file)}
    return _inside(folder, _video_path(folder, info), numbers), float(since)


def _episodes_v2(folder: Path, info: Info) -> Iterator[EpisodePlace]:
    videos = [name for name, feature in info.features.items() if feature.dtype == "video"]
    path = folder / "meta/episodes.jsonl"
    try:
        rows = [decode_json(line, _Row) for line in read_small(path, _MOST_BYTES).splitlines() if line.strip()]
    except FileError as error:
        raise FileFault(path, f"is no list of episodes: it {error}") from error
    for number, length in ((row.episode_index, row.length) for row in rows):
        numbers = {"episode_index": number, "episode_chunk": number // max(1, info.chunks_size)}
        yield EpisodePlace(
            number=number,
            length=length,
            data=_inside(folder, info.data_path, numbers),
            videos={
                name: (_inside(folder, _video_path(folder, info), {**numbers, "video_key": name}), 0.0)
                for name in videos
            },
        )


def _video_path(folder: Path, info: Info) -> str:
    if info.video_path is None:
        raise FileFault(folder / "meta/info.json", "has cameras but no video_path; pictures in rows are not supported")
    return info.video_path


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
