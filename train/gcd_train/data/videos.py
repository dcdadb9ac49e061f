"""Own videos with poses: two or more videos of one scene in a folder, and `cameras.json` with how they were filmed.

    {"fps": 30.0, "cameras": {"left.mp4": {
        "width": 640, "height": 480, "fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 240.0,
        "world_from_camera": [[[1, 0, 0, 0.4], [0, -1, 0, 0], [0, 0, -1, 1.2], [0, 0, 0, 1]], ...]}}}

All cameras film the same moments: frames of one number belong together. A pose for each frame, or one alone for a
camera that stands still. Pixels count from the top left corner of the picture (an OpenCV calibration: add 0.5 to cx and
cy); no distortion. Metres; camera axes are x right, y down, z ahead; any world. A data set is such a folder, or a
folder of them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import cv2
import msgspec
import numpy as np
import torch
from msgspec import Meta

from gcd_model.errors import FileError, ModelError
from gcd_model.geometry import Intrinsics, center_crop_box, relative_pose, require_rigid
from gcd_model.small_files import read_json
from gcd_train.data.encodings import Bytes, Doubles
from gcd_train.data.files import MOST_PICTURE, FileFault
from gcd_train.data.pictures import trained_lens
from gcd_train.data.sample import DrawnSamples, Sample
from gcd_train.errors import DataError, RecipeError

CAMERA_FILE = "cameras.json"
_RATE_TOLERANCE = 0.01
_EARLY_S = 0.5


class FileLens(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A pinhole in pixels, as a file of cameras has it."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def lens(self) -> Intrinsics:
        """Raises OptionError or ShapeError if it is none."""
        return Intrinsics(**{field: getattr(self, field) for field in FileLens.__struct_fields__})


class _Camera(FileLens, frozen=True, kw_only=True):
    world_from_camera: Annotated[tuple[tuple[tuple[float, ...], ...], ...], Meta(min_length=1)]


class _File(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    fps: Annotated[float, Meta(gt=0)]
    cameras: dict[str, _Camera]


@dataclass(frozen=True, slots=True)
class FilmedCamera:
    """One video. poses: world_from_camera, f64 [frames, 4, 4]."""

    video: Path
    lens: Intrinsics
    poses: Doubles


@dataclass(frozen=True, slots=True)
class FilmedScene:
    """One folder. frames: that all its videos have."""

    file: Path
    fps: float
    frames: int
    cameras: tuple[FilmedCamera, ...]

    @property
    def name(self) -> str:
        """Of the folder."""
        return self.file.parent.name


def filmed_scenes(folder: Path) -> tuple[FilmedScene, ...]:
    """The scene in a folder, or the scenes in its folders, by name.

    Raises: DataError if there is none; FileFault naming the file of one that is wrong.
    """
    found = [folder / CAMERA_FILE] if (folder / CAMERA_FILE).exists() else sorted(folder.glob(f"*/{CAMERA_FILE}"))
    if not found:
        raise DataError(f"{folder} holds no {CAMERA_FILE}, nor does a folder in it; see `Own videos` in docs/data.md")
    return tuple(map(read_scene, found))


def read_scene(path: Path) -> FilmedScene:
    """A scene by its `cameras.json`. Raises FileFault for whatever is wrong with it or its videos."""
    try:
        file = read_json(path, _File, MOST_PICTURE)
    except FileError as error:
        raise FileFault(path, f"is no camera file: it {error}") from error
    if len(file.cameras) < 2:
        raise FileFault(path, f"has {len(file.cameras)} camera(s); a source and a target make two")
    lengths = {name: _frames_of(path.parent / name, path, file.fps, camera) for name, camera in file.cameras.items()}
    if len(set(lengths.values())) > 1:
        said = ", ".join(f"{name} {frames}" for name, frames in lengths.items())
        raise FileFault(path, f"has videos that cannot be of the same moments, by frames: {said}")
    frames = next(iter(lengths.values()))
    cameras = tuple(_camera(path, name, camera, frames) for name, camera in file.cameras.items())
    return FilmedScene(path, file.fps, frames, cameras)


def _frames_of(video: Path, file: Path, fps: float, camera: _Camera) -> int:
    """Frames of a video, whose size and rate have to be as the file says."""
    if video.parent != file.parent:
        raise FileFault(file, f"names {video.name} outside of its folder")
    if not video.is_file():
        raise FileFault(video, "is missing, and cameras.json names it")
    opened = cv2.VideoCapture(str(video))
    try:
        keys = cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_COUNT
        width, height, frames = (int(opened.get(key)) for key in keys)
        rate, readable_at_all = opened.get(cv2.CAP_PROP_FPS), opened.isOpened() and opened.grab()
    finally:
        opened.release()
    if not readable_at_all or frames < 1:
        raise FileFault(video, "is no video that can be decoded")
    if (width, height) != (camera.width, camera.height):
        raise FileFault(video, f"is {width} x {height}, cameras.json says {camera.width} x {camera.height}")
    if abs(rate - fps) > _RATE_TOLERANCE * fps:
        raise FileFault(video, f"has {rate:g} frames a second, cameras.json says {fps:g}")
    return frames


def _camera(path: Path, name: str, camera: _Camera, frames: int) -> FilmedCamera:
    try:
        lens = camera.lens
        poses = require_rigid(torch.tensor(camera.world_from_camera, dtype=torch.float64), "world_from_camera").numpy()
    except (ModelError, ValueError) as error:
        raise FileFault(path, f"is wrong about {name}: {error}") from error
    if len(poses) not in (1, frames):
        raise FileFault(path, f"has {len(poses)} poses of {name}, whose video has {frames} frames; one alone is fine")
    return FilmedCamera(path.parent / name, lens, np.broadcast_to(poses, (frames, 4, 4)))


class FilmedPairs(DrawnSamples):
    """Samples of filmed scenes: two of a scene's cameras, over the same frames.

    size: width and height of the samples. frames: T. fps: of the clips. repeats: see `ViewPairs`. Pictures are cropped
    about their middle and resized; of cameras with different lenses the wider one's picture is first re-projected to
    the narrower lens, so that both sides have one.
    Raises: RecipeError for a rate that no stride makes of a scene's; DataError for a scene that is too short.
    """

    def __init__(
        self,
        scenes: tuple[FilmedScene, ...],
        *,
        size: tuple[int, int],
        frames: int,
        fps: float,
        seed: int = 0,
        repeats: int = 1,
    ) -> None:
        super().__init__(seed, repeats * len(scenes))
        self.scenes, self.fps, self._size, self._frames = scenes, fps, size, frames
        for scene in scenes:
            stride = self._stride(scene)
            if abs(scene.fps / stride - fps) > _RATE_TOLERANCE * fps:
                raise RecipeError(f"unet.fps is {fps:g}, and no stride makes that of {scene.name}'s {scene.fps:g}")
            if (frames - 1) * stride >= scene.frames:
                needed = (frames - 1) * stride + 1
                raise DataError(f"{scene.file.parent} has {scene.frames} frames, a clip of {frames} takes {needed}")

    def _place(self, number: int) -> tuple[str, Path]:
        scene = self.scenes[number % len(self.scenes)]
        return scene.name, scene.file

    def _stride(self, scene: FilmedScene) -> int:
        return max(round(scene.fps / self.fps), 1)

    def _made(self, number: int, random: np.random.Generator) -> Sample:
        scene = self.scenes[number % len(self.scenes)]
        cameras = [scene.cameras[int(k)] for k in random.choice(len(scene.cameras), 2, replace=False)]
        stride = self._stride(scene)
        start = int(random.integers(scene.frames - (self._frames - 1) * stride))
        numbers = range(start, start + self._frames * stride, stride)
        sides = [Side(_decoded(each.video, numbers), each.lens, each.poses[list(numbers)]) for each in cameras]
        return sample_of(sides, self._size, fps=self.fps, scene=scene.name, frame_numbers=tuple(numbers))


def _decoded(video: Path, numbers: range) -> list[Bytes]:
    """Frames of these numbers, RGB. Raises FileFault if the video ends before."""
    opened, found = cv2.VideoCapture(str(video)), list[Bytes]()
    try:
        first = numbers[0]
        if not opened.set(cv2.CAP_PROP_POS_FRAMES, first) or opened.get(cv2.CAP_PROP_POS_FRAMES) != first:
            opened.release()  # a video in which numbers cannot be sought is decoded from its beginning
            opened, first = cv2.VideoCapture(str(video)), 0
        for number in range(first, numbers[-1] + 1):
            if not opened.grab():
                raise FileFault(video, f"ends at frame {number}, wanted frame {numbers[-1]}")
            if number in numbers:
                found.append(cv2.cvtColor(opened.retrieve()[1], cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False))
    finally:
        opened.release()
    return found


def nearest_pictures(path: Path, times_s: Sequence[float], tolerance_s: float, av: Any) -> list[Bytes]:
    """The picture nearest to each time.

    Args:
        times_s: rising, seconds in the file.
        tolerance_s: a picture farther away in time is none.
        av: PyAV.
    Returns:
        T of u8 [H, W, 3], RGB.
    Raises: FileFault: the video is missing, damaged, too short, or has no picture near enough.
    """
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
            return list(_nearest(path, frames, times_s, tolerance_s))
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


class Side(NamedTuple):
    """One camera of a pair. pictures: T of u8 [H, W, 3]. poses: world_from_camera, f64 [T, 4, 4], metres."""

    pictures: Sequence[Bytes]
    lens: Intrinsics
    poses: Doubles


def sample_of(
    sides: Sequence[Side], size: tuple[int, int], *, fps: float, scene: str, frame_numbers: tuple[int, ...]
) -> Sample:
    """What two calibrated cameras filmed at the same moments: the first is the source, the second the target.

    size: width and height. Both sides get the lens that shows less, which is within what the other one shows.
    """
    lens = max((side.lens for side in sides), key=lambda lens: lens.fx / lens.width)
    source, target = (
        np.stack([seen_through(picture, side.lens, lens, size) for picture in side.pictures]) for side in sides
    )
    return Sample(
        source=source,
        target=target,
        source_from_target=relative_pose(*(torch.from_numpy(side.poses) for side in sides)).numpy(),
        fps=fps,
        scene=scene,
        frame_numbers=frame_numbers,
        lens=trained_lens(lens, *size),
    )


def seen_through(picture: Bytes, own: Intrinsics, lens: Intrinsics, size: tuple[int, int]) -> Bytes:
    """A camera's picture as if taken through another lens, cropped about its middle and resized: u8 [H, W, 3].

    own: of the picture. lens: the other one; what it shows beyond the picture is black. size: width and height.
    """
    wide, high = size
    if lens != own:
        middle = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])  # OpenCV counts from a pixel's middle
        to_lens = (lens.matrix @ own.matrix.inverse()).numpy()
        warp = np.linalg.inv(middle) @ to_lens @ middle
        picture = cv2.warpPerspective(picture, warp, (lens.width, lens.height)).astype(np.uint8, copy=False)
    left, top, across, along = center_crop_box(lens.width, lens.height, wide / high)
    kept = picture[top : top + along, left : left + across]
    how = cv2.INTER_AREA if across >= wide else cv2.INTER_LINEAR
    return cv2.resize(kept, size, interpolation=how).astype(np.uint8, copy=False)
