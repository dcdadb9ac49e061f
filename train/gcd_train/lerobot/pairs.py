"""Pairs of calibrated cameras of LeRobot data sets: training with real robots, without the package lerobot.

Both cameras filmed the same moments, so one is the source, the other the target, and the calibration says how they
stand to each other. See `folder` for what the calibration file holds.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model.errors import ModelError
from gcd_model.geometry import Intrinsics, relative_pose, require_rigid
from gcd_train.data.files import FileFault
from gcd_train.data.pictures import narrower, seen_through
from gcd_train.data.sample import DrawnSamples, Sample
from gcd_train.errors import DataError
from gcd_train.lerobot.folder import (
    CameraCalibration,
    EpisodePlace,
    LeRobotFolder,
    load_arrow,
    load_av,
    read_cameras,
    read_rows,
)

_EARLY_S, _SLACK_S = 0.5, 1e-4
Bytes = NDArray[np.uint8]
Floats = NDArray[np.float64]


def read_pictures(path: Path, times_s: Sequence[float], tolerance_s: float) -> Bytes:
    """The picture nearest to each time.

    Args:
        times_s: rising, seconds in the file.
        tolerance_s: a picture farther away in time is none.
    Returns:
        u8 [T, H, W, 3], RGB.
    Raises: FileFault: the video is missing, damaged, too short, or has no picture near enough. DataError: no PyAV.
    """
    av = load_av()
    if not path.is_file():
        raise FileFault(path, "is missing: download or export the data set again")
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise FileFault(path, "holds no video")
            stream = container.streams.video[0]
            stream.thread_type = "NONE"  # loader workers share the cores
            begin = max(0.0, times_s[0] - _EARLY_S)
            container.seek(int(begin / stream.time_base), stream=stream, backward=True)
            frames = (frame for frame in container.decode(stream) if frame.pts is not None)
            return np.stack(list(_nearest(path, frames, times_s, tolerance_s)))
    except (av.FFmpegError, ValueError, IndexError) as error:
        raise FileFault(path, f"is damaged ({error})") from error


def _nearest(path: Path, frames: Iterator[Any], times_s: Sequence[float], tolerance_s: float) -> Iterator[Bytes]:
    """One picture a wanted time; a picture may serve two."""
    before, after = None, next(frames, None)
    for wanted in times_s:
        while after is not None and after.time < wanted:
            before, after = after, next(frames, None)
        there = [frame for frame in (before, after) if frame is not None]
        if not there:
            raise FileFault(path, "holds no picture that can be decoded")
        frame = min(there, key=lambda each: abs(each.time - wanted))
        if abs(frame.time - wanted) > tolerance_s:
            end = f"it ends at {frame.time:.3f} s" if after is None else f"the nearest is at {frame.time:.3f} s"
            raise FileFault(path, f"has no picture within {1000 * tolerance_s:.1f} ms of {wanted:.3f} s: {end}")
        yield frame.to_ndarray(format="rgb24")


@dataclass(frozen=True, kw_only=True, slots=True)
class LeRobotOptions:
    """How pairs are taken.

    frames: T. fps: of the clips, at most the set's own, which is the default; rows and pictures are taken that are
    nearest in time. size: width and height of the samples; pictures are cropped about their middle to its shape and
    resized; of two lenses both sides have the narrower one. tolerance_s: how far a row or picture may be from the
    wanted time; by default half a frame of the set.
    cameras: features to choose from, by default all that are calibrated; source and target are drawn from them.
    calibration: a file in place of the set's meta/cameras.json. repeats: the set counts as so many times its episodes.
    episodes: which of the set's, from the first number up to the second, as in a slice: (-10, None) are the last ten.
    """

    frames: int = 14
    fps: float | None = None
    size: tuple[int, int] = (384, 256)
    tolerance_s: float | None = None
    cameras: tuple[str, ...] | None = None
    calibration: Path | None = None
    repeats: int = 400
    episodes: tuple[int, int | None] = (0, None)


@dataclass(frozen=True, slots=True)
class _Window:
    """Rows of an episode. times_s: of each, in the episode. poses: camera -> base_from_camera [T, 4, 4]."""

    rows: tuple[int, ...]
    times_s: tuple[float, ...]
    poses: Mapping[str, Floats]


class LeRobotPairs(DrawnSamples):
    """Samples of a LeRobot data set.

    Raises: DataError, FileFault: no data set, no calibration, or an option does not fit.
    """

    def __init__(self, folder: Path, seed: int = 0, options: LeRobotOptions | None = None) -> None:
        load_arrow()  # what is not installed is said now, not sample by sample
        load_av()
        self.options = options or LeRobotOptions()
        self.folder = LeRobotFolder.open(folder)
        self.episodes = tuple(self.folder.episodes)[slice(*self.options.episodes)]
        if not self.episodes:
            raise DataError(
                f"{folder} has {len(self.folder.episodes)} episodes, none of them in {self.options.episodes}"
            )
        super().__init__(seed, self.options.repeats * len(self.episodes))
        self._calibrations = read_cameras(folder, self.options.calibration)
        self.cameras = self._chosen_cameras()
        info = self.folder.info
        self.fps = self.options.fps or info.fps
        if self.fps > info.fps * 1.001:
            raise DataError(f"clips of {self.fps:g} frames per second were wanted, {folder} has {info.fps:g}")
        self._tolerance_s = self.options.tolerance_s or 0.5 / info.fps + _SLACK_S

    def _place(self, number: int) -> tuple[str, Path]:
        episode = self.episodes[number % len(self.episodes)]
        return episode.name, episode.data

    def _chosen_cameras(self) -> tuple[str, ...]:
        """Calibrated cameras that the set has."""
        wanted = self.options.cameras or tuple(self._calibrations)
        uncalibrated = [name for name in wanted if name not in self._calibrations]
        missing = [name for name in wanted if name not in self.folder.cameras]
        if uncalibrated or missing:
            raise DataError(
                f"{', '.join(uncalibrated or missing)}: {'not calibrated' if uncalibrated else 'no video of the set'}; "
                f"calibrated are {', '.join(self._calibrations)}, videos are {', '.join(self.folder.cameras)}"
            )
        if len(set(wanted)) < 2:
            raise DataError(f"pairs need two cameras or more, got {', '.join(wanted)}")
        return tuple(sorted(set(wanted)))

    def _made(self, number: int, random: np.random.Generator) -> Sample:
        episode = self.episodes[number % len(self.episodes)]
        source, target = (self.cameras[int(k)] for k in random.choice(len(self.cameras), 2, replace=False))
        window = self._window(episode, (source, target), random)
        lens = narrower(self._calibrations[source].lens, self._calibrations[target].lens)
        poses = (torch.from_numpy(window.poses[name]) for name in (source, target))
        return Sample(
            source=self._pictures(episode, source, window, lens),
            target=self._pictures(episode, target, window, lens),
            source_from_target=relative_pose(*poses).numpy(),
            fps=self.fps,
            scene=episode.name,
            frame_numbers=window.rows,
        )

    def _window(self, episode: EpisodePlace, cameras: Sequence[str], random: np.random.Generator) -> _Window:
        moving = {name: feature for name in cameras if (feature := self._calibrations[name].pose_feature)}
        rows = read_rows(episode.data, ["timestamp", *sorted(set(moving.values()))], episode.number)
        times = _checked_times(episode, np.array([_number(row["timestamp"]) for row in rows]))
        span = (self.options.frames - 1) / self.fps
        latest = int(np.searchsorted(times, times[-1] - span + self._tolerance_s, side="right"))
        if latest < 1:
            raise FileFault(
                episode.data,
                f"has only {times[-1] - times[0]:.2f} s of {episode.name}; {self.options.frames} frames at "
                f"{self.fps:g} a second take {span:.2f} s",
            )
        wanted = times[int(random.integers(latest))] + np.arange(self.options.frames) / self.fps
        chosen = np.abs(times[:, None] - wanted).argmin(0)
        late = np.abs(times[chosen] - wanted)
        if late.max() > self._tolerance_s:
            gap = wanted[int(late.argmax())]
            raise FileFault(episode.data, f"has no row of {episode.name} near {gap:.3f} s: a gap in its timestamps")
        poses = {
            name: _poses(episode, self._calibrations[name], [rows[int(row)] for row in chosen]) for name in cameras
        }
        return _Window(tuple(chosen.tolist()), tuple(times[chosen].tolist()), poses)

    def _pictures(self, episode: EpisodePlace, camera: str, window: _Window, lens: Intrinsics) -> Bytes:
        """[T, H, W, 3] through this lens at the wanted size."""
        path, begin = episode.videos[camera]
        pictures = read_pictures(path, [begin + time for time in window.times_s], self._tolerance_s)
        height, width = pictures.shape[1:3]
        calibration = self._calibrations[camera]
        if (width, height) != (calibration.width, calibration.height):
            said = f"{calibration.width} x {calibration.height}"
            raise FileFault(path, f"is {width} x {height}, its calibration says {said}")
        return np.stack([seen_through(each, calibration.lens, lens, self.options.size) for each in pictures])


def _number(value: float | list[float]) -> float:
    """A number that some sets keep as a list of one."""
    return float(value[0] if isinstance(value, list) else value)


def _checked_times(episode: EpisodePlace, times: Floats) -> Floats:
    """Timestamps that rise, as many as the set says. Raises FileFault."""
    if len(times) != episode.length or not len(times):
        raise FileFault(episode.data, f"has {len(times)} rows of {episode.name}, meta says {episode.length}")
    wrong = np.flatnonzero(~(np.diff(times) > 0))
    if not np.isfinite(times).all() or len(wrong):
        row = int(wrong[0]) + 1 if len(wrong) else int(np.flatnonzero(~np.isfinite(times))[0])
        raise FileFault(episode.data, f"has timestamps out of order at row {row} of {episode.name}")
    return times


def _poses(episode: EpisodePlace, camera: CameraCalibration, rows: list[dict[str, list[float]]]) -> Floats:
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
