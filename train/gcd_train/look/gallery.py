"""Views of real videos, for which there is no ground truth: windows of frames, sheets, videos and a page.

A window is frames out of any video: at a trained rate, cut and resized to the network's size.
"""

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from typer import Option

from gcd_model import (
    CameraMount,
    Clip,
    RenderOptions,
    Spherical,
    SphericalDelta,
    Traits,
    Trajectory,
    ViewSynthesizer,
)
from gcd_model.errors import OptionError, ShapeError
from gcd_model.geometry import Intrinsics, center_crop_box
from gcd_train.data.encodings import read_colour
from gcd_train.data.paths import delta_of
from gcd_train.data.sample import Bytes, to_network
from gcd_train.errors import DataError, RecipeError
from gcd_train.evaluation.galleries import Strip, painted, to_bytes, write_sheet, write_video
from gcd_train.evaluation.store import folder_name
from gcd_train.files import write_whole
from gcd_train.pictures import opened_video, video_frames

VIDEO_SUFFIXES = (".mp4", ".mkv", ".webm", ".avi", ".mov", ".m4v")
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".webp")
_NUMBERED = re.compile(r"(\D*)(\d*)")
_MIN_RATE, _MAX_RATE = 0.1, 1000.0
_RATE_TOLERANCE = 1.01  # 23.976 is 24
_ANGLES = (SphericalDelta(azimuth_deg=30.0, elevation_deg=10.0), SphericalDelta(azimuth_deg=-30.0))
"""Where steered models look from unless somebody says: to the right and from above, and to the left."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GalleryOptions:
    """Which windows of videos are viewed, and how: options of `gcd-train gallery`. None: unknown, or as trained."""

    angles: Annotated[
        list[str] | None,
        Option(help="Goal as AZIMUTH,ELEVATION,RADIUS: degrees, and units of the trained scenes; may be repeated."),
    ] = None
    windows: Annotated[int, Option(min=1, help="At most so many windows of each video.")] = 2
    start: Annotated[float, Option(min=0.0, help="Where the first window begins, seconds.")] = 0.0
    rate: Annotated[float | None, Option(min=0.1, help="Frames a second of folders of pictures.")] = None
    hfov_deg: Annotated[
        float | None,
        Option(min=1.0, max=179.0, help="Field of view of the videos, degrees across; cut to the model's."),
    ] = None
    source_elevation_deg: Annotated[
        float | None, Option(help="Where a steered model's source camera stands, above its centre. Else 5.")
    ] = None
    source_radius: Annotated[float | None, Option(help="Its distance to the scene's centre. Else 15.")] = None
    mount_height: Annotated[
        float | None, Option(min=0.1, help="Driving: height of the camera above the road, metres; else as trained.")
    ] = None
    mount_tilt: Annotated[float | None, Option(help="Driving: tilt of the camera, degrees down; else as trained.")] = (
        None
    )
    samples: Annotated[int, Option(min=1, help="Draws of each view.")] = 1
    steps: Annotated[int | None, Option(min=1, help="Steps of the sampler instead of the shipped number.")] = None
    seed: Annotated[int, Option(min=0, help="Of the noise samples begin with.")] = 0

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.start, self.rate or 0.0, self.hfov_deg or 0.0))):
            raise RecipeError(f"a window wants a start, a rate and a field of view that are numbers, got {self}")

    @property
    def goals(self) -> tuple[SphericalDelta, ...]:
        """Of steered models, target minus source; radius and elevation may be left out. Raises RecipeError."""
        return tuple(delta_of(text, "--angles ") for text in self.angles or ())

    @property
    def source(self) -> Spherical | None:
        """Where the camera of steered models stands, as far as its goals depend on it; None as is usual for them."""
        given = {"elevation_deg": self.source_elevation_deg, "radius_m": self.source_radius}
        stands = {name: number for name, number in given.items() if number is not None}
        return replace(Traits.ASSUMED_SOURCE, **stands) if stands else None


@dataclass(frozen=True, kw_only=True, slots=True)
class RealVideo:
    """A video file, or the pictures of a folder in the order of their names.

    name: for the files that are made of it, unlike that of any other video it was found with.
    """

    path: Path
    name: str
    pictures: tuple[Path, ...] = ()

    def frames(self) -> Iterator[Bytes]:
        """Every frame as RGB u8 [H, W, 3]. Raises DataError for what is no video or picture."""
        if self.pictures:
            yield from map(read_colour, self.pictures)
        else:
            yield from video_frames(self.path)

    def measured(self) -> tuple[int, float | None]:
        """Frames, counted one by one as containers lie, and frames per second; None where the file does not tell."""
        if self.pictures:
            return len(self.pictures), None
        with opened_video(self.path) as capture:
            stated = float(capture.get(cv2.CAP_PROP_FPS))
            count = 0
            while capture.grab():
                count += 1
        return count, stated if _MIN_RATE <= stated <= _MAX_RATE else None


@dataclass(frozen=True, kw_only=True, slots=True)
class Windowed:
    """T frames of a video as a network takes them.

    video: name of its file. name: for the files that are made of it. number: of the window. start_s: when it begins.
    pictures: u8 [T, H, W, 3]. fps: of these frames.
    trained_rate: whether the network was trained with that rate. size: width and height of the frames in the file.
    hfov_deg: field of view of `pictures`, None where nobody knows.
    """

    video: str
    name: str
    number: int
    start_s: float
    pictures: Bytes
    fps: float
    trained_rate: bool
    size: tuple[int, int]
    hfov_deg: float | None = None


def find_videos(paths: Sequence[Path]) -> tuple[RealVideo, ...]:
    """Videos among files and folders, in order.

    A folder gives its video files; without any, its pictures are one video. Files are not opened yet.

    Raises: DataError for a path that is not there, or a folder with neither.
    """
    times = Counter[str]()
    found: list[RealVideo] = []
    for path, pictures in (place for given in paths for place in _videos_at(given)):
        stem = folder_name(path.stem)
        times[stem] += 1
        name = stem if times[stem] == 1 else f"{stem}.{times[stem]}"
        found.append(RealVideo(path=path, name=name, pictures=pictures))
    return tuple(found)


def read_windows(video: RealVideo, traits: Traits, options: GalleryOptions) -> tuple[Windowed, ...]:
    """Windows of a video, in time.

    Raises: DataError if it cannot be decoded, is too short for one window, or its frame rate is not known.
    """
    count, stated = video.measured()
    if not count:
        raise DataError(f"{video.path} has no frame that can be decoded; copy or record it again")
    own = options.rate or stated
    if own is None:
        raise DataError(f"{video.path} does not tell its frame rate; give it with --rate")
    reachable = [rate for rate in traits.rates if rate <= own * _RATE_TOLERANCE]
    fps = max(reachable, default=own)
    starts = _starts(video.path, count, own, fps, traits.config.frames, options)
    wanted = [[start + math.floor(i * own / fps + 0.5) for i in range(traits.config.frames)] for start in starts]
    chosen, size, angle_deg = _chosen(video, {number for each in wanted for number in each}, traits, options.hfov_deg)
    return tuple(
        Windowed(
            video=video.path.name,
            name=f"{video.name}-{number}",
            number=number,
            start_s=start / own,
            pictures=np.stack([chosen[frame] for frame in frames]),
            fps=fps,
            trained_rate=bool(reachable) or not traits.rates,
            size=size,
            hfov_deg=angle_deg,
        )
        for number, (start, frames) in enumerate(zip(starts, wanted, strict=True))
    )


def _videos_at(path: Path) -> list[tuple[Path, tuple[Path, ...]]]:
    """Each video's place, and its pictures if it is a folder of these."""
    if path.is_file():
        return [(path, ())]
    if not path.is_dir():
        raise DataError(f"{path} does not exist; give videos, or folders of videos or pictures")
    by_number = {
        each: [(name, int(part or -1)) for name, part in _NUMBERED.findall(each.name)] for each in path.iterdir()
    }
    inside = sorted(by_number, key=lambda each: by_number[each])  # the order people mean: im_2 before im_10
    videos = [each for each in inside if each.suffix.lower() in VIDEO_SUFFIXES]
    pictures = tuple(each for each in inside if each.suffix.lower() in PICTURE_SUFFIXES)
    if not videos and not pictures:
        raise DataError(f"{path} holds neither videos nor pictures ({', '.join(VIDEO_SUFFIXES + PICTURE_SUFFIXES)})")
    return [(each, ()) for each in videos] or [(path, pictures)]


def _starts(path: Path, count: int, own: float, fps: float, frames: int, options: GalleryOptions) -> list[int]:
    """First frame of each window, evenly from the first to the last that fits; windows do not overlap."""
    span = math.floor((frames - 1) * own / fps + 0.5) + 1
    first, last = round(options.start * own), count - span
    if last < first:
        raise DataError(
            f"{path} has {count} frames at {own:g} a second; {frames} at {fps:g} a second from {options.start:g} s on "
            f"want {first + span}; give a longer video, or start earlier"
        )
    windows = max(1, min(options.windows, (last - first) // span + 1))
    return [first + (last - first) * number // max(windows - 1, 1) for number in range(windows)]


def _chosen(
    video: RealVideo, wanted: set[int], traits: Traits, hfov_deg: float | None
) -> tuple[Mapping[int, Bytes], tuple[int, int], float | None]:
    """Frames by number in the network's size, the size that the last one had, and their field of view.

    Of each as much of the middle as has the network's shape and shows no more than it was trained with.
    """
    wanted_size, shape = (traits.config.width, traits.config.height), traits.config.width / traits.config.height
    trained_deg = None if traits.family is None else traits.family.hfov_deg
    half = None if hfov_deg is None else math.tan(math.radians(hfov_deg / 2))
    share = 1.0 if half is None or trained_deg is None else min(1.0, math.tan(math.radians(trained_deg / 2)) / half)
    chosen: dict[int, Bytes] = {}
    size, angle_deg, number = (0, 0), hfov_deg, -1
    for number, picture in enumerate(video.frames()):
        if number in wanted:
            size = (picture.shape[1], picture.shape[0])
            beside = round(size[0] * (1 - share) / 2)
            try:
                left, top, wide, high = center_crop_box(max(1, size[0] - 2 * beside), size[1], shape)
            except ShapeError as error:
                raise DataError(f"{video.path}: {error}") from error
            angle_deg = None if half is None else math.degrees(2 * math.atan(half * wide / size[0]))
            part = picture[top : top + high, beside + left : beside + left + wide]
            how = cv2.INTER_AREA if wide > wanted_size[0] else cv2.INTER_LINEAR
            chosen[number] = cv2.resize(part, wanted_size, interpolation=how).astype(np.uint8, copy=False)
        if len(chosen) == len(wanted):
            return chosen, size, angle_deg
    raise DataError(f"{video.path} ended after {number + 1} frames while it was read; is it still being written?")


def paths(traits: Traits, options: GalleryOptions, hfov_deg: float | None = None) -> tuple[tuple[str, Trajectory], ...]:
    """Name and camera path of each goal, or of a model's one view.

    hfov_deg: of the pictures, if known. Raises: ViewFixedError, ViewRangeError as `Traits.plan_view`, OptionError also
    for a source that the model has no use for, or that its mount tells already.
    """
    mount = mounted(traits, options, hfov_deg)
    if options.source is not None and (mount is not None or traits.config.camera == "none"):
        raise OptionError(f"{traits.name} has no use for --source-elevation-deg and --source-radius; leave them out")
    if traits.config.camera == "none" and not options.goals:
        return (("view", traits.plan_view(mount=mount)),)
    return tuple(
        (
            f"az {each.azimuth_deg:+g} el {each.elevation_deg:+g} r {each.radius_m:+g}",
            traits.plan_view(each, source=options.source, mount=mount),
        )
        for each in options.goals or _ANGLES
    )


def mounted(traits: Traits, options: GalleryOptions, hfov_deg: float | None) -> CameraMount | None:
    """How the camera sits on its vehicle, for the live model where somebody says it; else None."""
    if not traits.live or (options.mount_height is None and options.mount_tilt is None):
        return None
    given = {"height_m": options.mount_height, "tilt_deg": options.mount_tilt, "hfov_deg": hfov_deg}
    return replace(CameraMount(), **{name: number for name, number in given.items() if number is not None})


def view_window(synthesizer: ViewSynthesizer, window: Windowed, options: GalleryOptions) -> list[Strip]:
    """Encode a window once and render every goal: the rows of its sheet. Raises: ModelError and its kind."""
    traits = synthesizer.traits
    mount = mounted(traits, options, window.hfov_deg)
    lens, (high, wide) = None, window.pictures.shape[1:3]
    if traits.live and window.hfov_deg is not None:
        lens = Intrinsics.from_hfov(window.hfov_deg, wide, high)
    features = synthesizer.encode(Clip(video=to_network(window.pictures), fps=window.fps, mount=mount, lens=lens))
    sampling = RenderOptions(samples=options.samples, steps=options.steps, seed=options.seed)
    strips = [Strip.of("input", window.pictures)]
    for name, path in paths(traits, options, window.hfov_deg):
        (view,) = synthesizer.render(features, [path], sampling)
        for number, sample in enumerate(view.samples):
            strips.append(Strip.of(name if number == 0 else f"{name} sample {number + 1}", to_bytes(sample)))
        deviation, word = (view.uncertainty, "uncertainty") if view.uncertainty is not None else (view.std, "deviation")
        if deviation is not None:  # black is 0, the brightest its largest
            grey = np.rint(deviation.numpy() / max(float(deviation.max()), 1e-6) * 255).clip(0, 255).astype(np.uint8)
            heat = [cv2.applyColorMap(each, cv2.COLORMAP_INFERNO)[..., ::-1].astype(np.uint8) for each in grey]
            strips.append(Strip.of(f"{word}, white {float(deviation.max()):.2g}", np.stack(heat)))
        if view.classes is not None:
            strips.append(Strip.of("classes", painted(view.classes[0], traits.classes)))
    return strips


def write_views(window: Windowed, strips: Sequence[Strip], folder: Path) -> None:
    """`NAME.png`, the sheet, and `NAME.mp4`, all rows side by side. Raises RunError if they cannot be written."""
    write_sheet([(f"{window.video} from {window.start_s:.1f} s", strips)], folder / f"{window.name}.png")
    write_video(strips, window.fps, folder / f"{window.name}.mp4")


_STYLE = (
    "body{font:15px/1.45 sans-serif;margin:2em auto;max-width:1080px;padding:0 1em;color:#222}"
    "img{max-width:100%;border:1px solid #ddd}h2{margin-top:2em}.note{color:#666}.fault{color:#a02020}"
)


def write_page(windows: Sequence[Windowed], faults: Sequence[str], facts: Sequence[tuple[str, str]], out: Path) -> None:
    """Write the page.

    Args:
        windows: in order, whose files lie beside the page. faults: what could not be shown, a line each. facts: name
            and value of what holds for all: the command, the weights, the options.
    Raises:
        RunError: it cannot be written.
    """
    sections: list[str] = []
    for window in windows:
        name, (width, height), (high, wide) = escape(window.name, quote=True), window.size, window.pictures.shape[1:3]
        rate = "" if window.trained_rate else ", a rate the model was not trained with"
        cut = f"cut from {width} x {height} to {wide} x {high}"
        sections.append(
            f"<h2>{escape(window.video)}, window {window.number + 1}</h2><p class=note>from {window.start_s:.1f} s, "
            f"{len(window.pictures)} frames at {window.fps:g} a second{rate}; {cut}; "
            f'<a href="{name}.mp4">video</a></p><a href="{name}.png"><img src="{name}.png" alt="{name}"></a>'
        )
    rows = "".join(f"<tr><th align=left>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in facts)
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><title>Views of real videos</title>",
        f"<style>{_STYLE}</style><h1>Views of real videos</h1>",
        "<p>Every pixel of a view is generated. Nobody knows what was really there: a view that looks right is no "
        f"evidence that it is.</p><table>{rows}</table>",
        *(f"<p class=fault>{escape(fault)}</p>" for fault in faults),
        *sections,
    ]
    write_whole(out, ("\n".join(parts) + "</html>\n").encode())
