"""Novel views of a LeRobot camera, as cameras of a copy of its data set, marked synthetic.

    observation.images.CAMERA_VIEW              the view, as large as the camera's own pictures
    observation.images.CAMERA_VIEW_visibility   grey, without loss: 255 is seen now, 128 was seen before, 0 is painted

Every file of the set is copied as it is, byte by byte, so actions, states, stamps and the other cameras stay; only the
lists in `meta` get longer, and the card. A view has the frames of its camera's videos, file by file, in the same order.

Source: the documented formats v3.0 and v2.1, see `lerobot`.
"""

import functools
import json
import math
import re
import shutil
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
import torch
from typer import Option

from gcd_model import FrameSynthesizer, RenderOptions, Traits, Trajectory, View, ViewSynthesizer, load_synthesizer
from gcd_model.clip import Clip
from gcd_model.errors import FileError
from gcd_model.geometry import Intrinsics, Spherical
from gcd_model.small_files import read_json
from gcd_train.data.files import MOST_TEXT, FileFault
from gcd_train.data.lerobot import (
    CAMERA_FILE,
    CameraCalibration,
    CameraFile,
    EpisodePlace,
    Info,
    extra,
    read_cameras,
    read_rows,
    read_set,
    row_poses,
    row_times,
)
from gcd_train.data.lerobot_export import add_picture, new_video, statistics_of, video_feature
from gcd_train.data.paths import delta_of
from gcd_train.data.sample import Bytes, to_network
from gcd_train.data.videos import Doubles, nearest_pictures
from gcd_train.errors import DataError, RecipeError, RunError
from gcd_train.files import new_folder, whole, write_whole

_IMAGES, _SEEN = "observation.images.", "_visibility"
_LEVELS = np.array([0, 128, 255], np.uint8)  # of painted, seen before, seen now: all three survive H.264 without loss
_NAME = re.compile(r"[a-z0-9_]{1,32}")
_AT_ONCE = 64  # pictures in memory
_SAMPLED, _MOST_SAMPLES = 8, 16  # pixels apart, and frames of an episode that go into the statistics
_SLACK_S = 1e-4


@dataclass(frozen=True, kw_only=True, slots=True)
class AugmentOptions:
    """Which views of which camera, by which model: options of `gcd-train augment lerobot`."""

    camera: Annotated[str, Option(help="The camera, with or without observation.images.")]
    view: Annotated[
        list[str] | None,
        Option(help="NAME=AZIMUTH,ELEVATION,RADIUS, degrees and metres to its right, up, away; may be repeated."),
    ] = None
    poses: Annotated[Path | None, Option(help="JSON {NAME: source_from_view}: 4 x 4, x right, y down, metres.")] = None
    source_radius: Annotated[float | None, Option(min=0.01, help="To what --view turns about, metres.")] = None
    source_elevation_deg: Annotated[float, Option(help="How steeply it looks down.")] = 30.0
    hfov_deg: Annotated[float | None, Option(min=1.0, max=179.0, help="Of its pictures; else as calibrated.")] = None
    calibration: Annotated[Path | None, Option(help="Cameras, in place of the set's meta/cameras.json.")] = None
    weights: Annotated[str, Option(help="package:NAME, random:FAMILY or a path.")] = "package:live-small"
    device: Annotated[str, Option(help="auto, cpu, cuda or cuda:N.")] = "auto"


@functools.cache
def _model(weights: str, device: str) -> ViewSynthesizer:
    """Once a process; frame by frame if it can."""
    model = load_synthesizer(weights, device=device)
    return model.streaming() if isinstance(model, FrameSynthesizer) else model


@dataclass(frozen=True, slots=True)
class Augmentation:
    """Views of one episode at a time, in any process; `finish` makes the data set of all.

    source: the data set. camera: feature. lens: of its pictures, where somebody states it. cameras: of the set's
    calibration, empty without. paths: by the name of the view.
    """

    source: Path
    out: Path
    info: Info
    episodes: tuple[EpisodePlace, ...]
    camera: str
    lens: Intrinsics | None
    cameras: Mapping[str, CameraCalibration]
    paths: Mapping[str, Trajectory]
    options: AugmentOptions

    @classmethod
    def of(cls, source: Path, out: Path, options: AugmentOptions) -> "Augmentation":
        """Look at the set, the camera and the views before anything is made.

        Raises: DataError, FileFault: no such set or camera, or nobody knows its lens. RecipeError: no view, or none
        that can be. RunError: `out` is there, or in the set. ModelError: the weights, or a view that they cannot give.
        """
        for module in ("pyarrow.parquet", "av"):
            extra(module)
        if out.exists():
            raise RunError(f"{out} is there already; choose another folder, or remove it")
        info, episodes = read_set(source)
        if out.resolve().is_relative_to(source.resolve()):
            raise RunError(f"{out} lies in {source}, of which it is to be a copy; choose a folder beside it")
        camera = options.camera if options.camera in info.videos else _IMAGES + options.camera
        if camera not in info.videos:
            raise DataError(f"{source} has no video {options.camera}; it has {', '.join(info.videos) or 'none'}")
        if (info.features[camera].info or {}).get("synthetic"):
            raise DataError(f"{camera} of {source} was made by a model; take the camera it was made of")
        width, height = _size_of(info, camera)
        if width % 2 or height % 2:
            raise DataError(f"H.264 wants an even width and height, {camera} is {width} x {height}")
        is_calibrated = options.calibration is not None or (source / CAMERA_FILE).exists()
        cameras = read_cameras(source, options.calibration) if is_calibrated else {}
        traits = _model(options.weights, options.device).traits
        lens = cameras[camera].lens if camera in cameras else None
        if options.hfov_deg is not None:
            lens = Intrinsics.from_hfov(options.hfov_deg, width, height)
        if lens is None and (traits.live or traits.splat != "none"):
            raise DataError(f"nobody knows the lens of {camera}; state it with --hfov-deg, or in {CAMERA_FILE}")
        if lens is not None and (lens.width, lens.height) != (width, height):
            raise DataError(f"{camera} is {width} x {height}, its calibration says {lens.width} x {lens.height}")
        paths = _paths(traits, options)
        if taken := [name for name in paths if f"{camera}_{name}" in info.features]:
            raise RecipeError(f"{source} has {camera}_{taken[0]} already; choose another name for the view")
        if (shortest := min(episodes, key=lambda each: each.length)).length < traits.config.frames:
            few = f"{shortest.name} has {shortest.length} frames"
            raise DataError(f"{few}, {traits.name} works on {traits.config.frames}; take package:live-small")
        return cls(source, out, info, episodes, camera, lens, cameras, paths, options)

    @property
    def model(self) -> ViewSynthesizer:
        """Of this process."""
        return _model(self.options.weights, self.options.device)

    @property
    def parts(self) -> Path:
        """Folder of the episodes that are done, until all are."""
        return self.out.with_name(f".{self.out.name}.parts")

    @property
    def features(self) -> tuple[str, ...]:
        """Of the views and what of them was seen."""
        return tuple(f"{self.camera}_{name}{kind}" for name in self.paths for kind in ("", _SEEN))

    def claim(self) -> None:
        """Say what the parts are made of. Raises RunError if those that are there are made of something else."""
        told = {"set": str(self.source.resolve()), "episodes": [each.length for each in self.episodes]}
        told |= {"model": self.model.traits.sha256_12, "camera": self.camera, "lens": self.lens}
        told |= {"calibration": self.cameras.get(self.camera)}
        told |= {"views": {name: path.source_from_target[-1].tolist() for name, path in self.paths.items()}}
        text, path = msgspec.json.encode(told), self.parts / "made_from.json"
        if path.exists() and path.read_bytes() != text:
            raise RunError(f"{self.parts} holds episodes made otherwise; remove it, or choose another --out")
        write_whole(path, text)

    def __call__(self, episode: EpisodePlace) -> int:
        """Make the views of an episode unless they are there: how many frames were made.

        Raises: DataError: its rows or pictures are damaged. ModelError.
        """
        if (done := self.parts / f"{episode.name}.npz").exists():
            return 0
        samples, sampled_every = defaultdict[str, list[Bytes]](list), max(1, episode.length // _MOST_SAMPLES)
        with ExitStack() as stack:
            videos: dict[str, tuple[Any, Any]] = {}
            for feature in self.features:
                path = stack.enter_context(whole(self._part(episode, feature)))
                crf = 0 if feature.endswith(_SEEN) else 18
                videos[feature] = new_video(path, *_size_of(self.info, self.camera), self.info.fps, crf)
                stack.callback(videos[feature][0].close)
            for number, seen in enumerate(self._seen(episode)):
                for feature, picture in seen.items():
                    add_picture(*videos[feature], picture, number)
                    if number % sampled_every == 0:
                        samples[feature].append(picture[::_SAMPLED, ::_SAMPLED].reshape(1, -1, 3))
            for container, stream in videos.values():
                container.mux(stream.encode())
        with whole(done) as partial, partial.open("wb") as file:
            np.savez(file, **{name: np.concatenate(rows) for name, rows in samples.items()})  # pyright: ignore
        return episode.length

    def _part(self, episode: EpisodePlace, feature: str) -> Path:
        return self.parts / f"{episode.name}.{feature}.mp4"

    def _seen(self, episode: EpisodePlace) -> Iterator[dict[str, Bytes]]:
        """Pictures of all features, frame by frame."""
        model = self.model
        if isinstance(model, FrameSynthesizer):
            model.reset()
        size, frames = _network_size(model.traits, *_size_of(self.info, self.camera)), model.traits.config.frames
        start = 0
        for pictures, poses in self._source(episode, frames):
            small = np.stack([cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in pictures])
            clip = Clip(
                video=to_network(small.astype(np.uint8, copy=False)),
                fps=self.info.fps,
                lens=None if self.lens is None else self.lens.resized(*size),
                odometry=torch.from_numpy(poses) if model.traits.live and poses is not None else None,
            )
            views = model.render(model.encode(clip), list(self.paths.values()), RenderOptions())
            new = min(frames, episode.length - start)  # the last clip may overlap the one before
            for t in range(frames - new, frames):
                yield {
                    feature: picture
                    for name, view in zip(self.paths, views, strict=True)
                    for feature, picture in self._of_view(name, view, t)
                }
            start += new

    def _of_view(self, name: str, view: View, t: int) -> Iterator[tuple[str, Bytes]]:
        pixels = (view.video[t].clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
        size = _size_of(self.info, self.camera)
        yield f"{self.camera}_{name}", cv2.resize(pixels, size, interpolation=cv2.INTER_LINEAR).astype(np.uint8)
        unknown = torch.zeros(pixels.shape[:2], dtype=torch.uint8)
        seen = (unknown if view.visibility is None else view.visibility[t]).numpy()
        grey = cv2.resize(_LEVELS[seen], size, interpolation=cv2.INTER_NEAREST)
        yield f"{self.camera}_{name}{_SEEN}", np.repeat(grey[..., None], 3, axis=-1).astype(np.uint8)

    def _source(self, episode: EpisodePlace, frames: int) -> Iterator[tuple[list[Bytes], Doubles | None]]:
        """Clips of so many pictures of the camera, and base_from_camera [T, 4, 4] where somebody wrote it down."""
        camera = self.cameras.get(self.camera)
        moving = [] if camera is None or camera.pose_feature is None else [camera.pose_feature]
        rows = read_rows(episode.data, ["timestamp", *moving], episode.number)
        times, poses = row_times(episode, rows), None if camera is None else row_poses(episode, camera, rows)
        path, begin = episode.videos[self.camera]
        starts = [min(start, len(times) - frames) for start in range(0, len(times), frames)]
        several = max(1, _AT_ONCE // frames)
        for few in (starts[i : i + several] for i in range(0, len(starts), several)):
            wanted = sorted({number for start in few for number in range(start, start + frames)})
            times_s = [begin + float(times[number]) for number in wanted]
            found = nearest_pictures(path, times_s, 0.5 / self.info.fps + _SLACK_S, extra("av"))
            by_number = dict(zip(wanted, found, strict=True))
            for start in few:
                clip = range(start, start + frames)
                yield [by_number[number] for number in clip], None if poses is None else poses[list(clip)]

    # The data set of all episodes.

    def finish(self) -> None:
        """Write the data set; it appears when it is whole, and the parts go. Raises RunError, FileFault."""
        with new_folder(self.out.absolute().parent, self.out.name) as folder:
            shutil.copytree(self.source, folder, copy_function=shutil.copyfile, dirs_exist_ok=True)
            for feature in self.features:
                self._join_videos(folder, feature)
            samples = [np.load(self.parts / f"{each.name}.npz") for each in self.episodes]
            self._list_videos(folder, samples)
            self._describe(folder, samples)
        shutil.rmtree(self.parts)

    def _join_videos(self, folder: Path, feature: str) -> None:
        """One file for each of the camera's, with the same episodes at the same times."""
        by_file = defaultdict[Path, list[EpisodePlace]](list)
        for episode in self.episodes:
            by_file[episode.videos[self.camera][0]].append(episode)
        av = extra("av")
        for path, episodes in by_file.items():
            place = [feature if part == self.camera else part for part in path.relative_to(self.source).parts]
            if feature not in place:
                raise FileFault(path, f"has no folder named {self.camera}, so a view of it has no place")
            out = folder.joinpath(*place)
            out.parent.mkdir(parents=True, exist_ok=True)
            with av.open(str(out), "w") as container:
                joined = None
                for episode in sorted(episodes, key=lambda each: each.videos[self.camera][1]):
                    with av.open(str(self._part(episode, feature))) as part:
                        (stream,) = part.streams.video
                        joined = joined or container.add_stream_from_template(stream)
                        begin = round(episode.videos[self.camera][1] / stream.time_base)
                        for packet in part.demux(stream):
                            if packet.dts is not None:
                                packet.pts, packet.dts = packet.pts + begin, packet.dts + begin
                                packet.stream = joined
                                container.mux(packet)

    def _list_videos(self, folder: Path, samples: Sequence[Mapping[str, Bytes]]) -> None:
        """Where the videos of each episode are, and their statistics: as of the camera, in both formats."""
        statistics = {
            each.number: {name: statistics_of(sample[name], colours=True) for name in self.features}
            for each, sample in zip(self.episodes, samples, strict=True)
        }
        by_lines = folder / "meta/episodes_stats.jsonl"
        if by_lines.exists():
            lines = [json.loads(line) for line in by_lines.read_text().splitlines() if line.strip()]
            for line in lines:
                line["stats"] |= _like(line["stats"].get(self.camera, {}), statistics[line["episode_index"]])
            by_lines.write_text("".join(json.dumps(line) + "\n" for line in lines))
        arrow, parquet = extra("pyarrow"), extra("pyarrow.parquet")
        for path in sorted((folder / "meta/episodes").glob("chunk-*/file-*.parquet")):
            table = parquet.read_table(path)
            numbers = table["episode_index"].to_pylist()
            for name in [each for each in table.column_names if f"/{self.camera}/" in each]:
                kind, _, key = name.partition(f"/{self.camera}/")
                for feature in self.features:
                    column = table[name]
                    if kind == "stats":
                        values = [statistics[number][feature].get(key) for number in numbers]
                        column = arrow.array(values, table.schema.field(name).type)
                    table = table.append_column(f"{kind}/{feature}/{key}", column)
            parquet.write_table(table, path)

    def _describe(self, folder: Path, samples: Sequence[Mapping[str, Bytes]]) -> None:
        """What the set says of its features, its cameras, and on its card."""
        traits = self.model.traits
        path = folder / "meta/info.json"
        info, cameras = json.loads(path.read_text()), dict(self.cameras)
        made_by = f"Made of `{self.camera}` by {traits.name} ({traits.sha256_12}); nobody filmed them."
        card = ["", "## Synthetic cameras", "", made_by, ""]
        for name, view in self.paths.items():
            pose, feature = view.source_from_target[-1].numpy(), f"{self.camera}_{name}"
            made = {"synthetic": True, "made_from": self.camera, "model": f"{traits.name} {traits.sha256_12}"}
            made |= {"source_from_view": pose.tolist()}
            for each in (feature, feature + _SEEN):
                told = video_feature(*_size_of(self.info, self.camera), self.info.fps)
                info["features"][each] = told | {"info": told["info"] | made}
            if (source := self.cameras.get(self.camera)) is not None and source.pose is not None:
                rows = tuple(map(tuple, (source.pose @ pose).tolist()))
                cameras[feature] = msgspec.structs.replace(source, base_from_camera=rows, synthetic=True)
            card.append(f"- `{feature}`; `{feature}{_SEEN}`: 255 seen now, 128 seen before, 0 painted")
        if "total_videos" in info:
            info["total_videos"] += len(self.features) * len(self.episodes)
        path.write_text(json.dumps(info, indent=4) + "\n", encoding="utf-8")
        if (stats := folder / "meta/stats.json").exists():
            total = json.loads(stats.read_text())
            joined = {name: np.concatenate([sample[name] for sample in samples]) for name in self.features}
            every = {name: statistics_of(rows, colours=True) for name, rows in joined.items()}
            stats.write_text(json.dumps(total | _like(total.get(self.camera, {}), every), indent=4) + "\n")
        if cameras:
            text = msgspec.json.format(msgspec.json.encode(CameraFile(cameras=cameras)), indent=1)
            (folder / CAMERA_FILE).write_bytes(text)
        readme = folder / "README.md"
        before = readme.read_text() if readme.exists() else "---\ntags:\n- LeRobot\n- synthetic\n---\n"
        readme.write_text(before + "\n".join([*card, ""]), encoding="utf-8")


def _like(known: Mapping[str, Any], statistics: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Statistics by feature: those that the camera has, too."""
    return {name: {key: row for key, row in each.items() if key in known} for name, each in statistics.items()}


def _paths(traits: Traits, options: AugmentOptions) -> dict[str, Trajectory]:
    """By the name of the view; at the goal in every frame. Raises RecipeError, FileFault; ModelError as `plan_view`."""
    found: list[tuple[str, Trajectory]] = []
    radius = options.source_radius
    if options.view and traits.live and radius is None:
        raise RecipeError("--view turns about what the camera looks at: say how far that is with --source-radius")
    stands = None
    if radius is not None:
        stands = Spherical(azimuth_deg=0.0, elevation_deg=options.source_elevation_deg, radius_m=radius)
    for text in options.view or ():
        name, _, numbers = text.partition("=")
        found.append((name, traits.plan_view(delta_of(numbers, "--view NAME="), source=stands, move_time=0)))
    if options.poses is not None:
        try:
            poses = read_json(options.poses, dict[str, list[list[float]]], MOST_TEXT)
            matrices = {name: torch.tensor(rows, dtype=torch.float64) for name, rows in poses.items()}
        except (FileError, ValueError) as error:
            raise FileFault(options.poses, f"is no JSON of named 4 x 4 poses: {error}") from error
        for name, pose in matrices.items():
            found.append((name, traits.plan_poses(pose.expand(traits.config.frames, *pose.shape))))
    names, paths = [name for name, _ in found], dict(found)
    if len(paths) != len(names) or not names or any(not _NAME.fullmatch(x) or x.endswith(_SEEN) for x in names):
        raise RecipeError(
            "name one view or more with --view or --poses, each by another name in a-z, 0-9 and _, got "
            f"{', '.join(names) or 'none'}"
        )
    return paths


def _size_of(info: Info, camera: str) -> tuple[int, int]:
    """Width and height; some sets have the channels first."""
    shape = info.features[camera].shape
    height, width = shape[:2] if shape[-1:] == (3,) else shape[1:3]
    return width, height


def _network_size(traits: Traits, width: int, height: int) -> tuple[int, int]:
    """Width and height that the network works at: about its trained area, whole multiples, near the camera's shape."""
    config = traits.config
    shrunk = min(1.0, math.sqrt(config.width * config.height / (width * height)))
    factor = config.size_factor
    across, along = (max(factor, round(side * shrunk / factor) * factor) for side in (width, height))
    return across, along
