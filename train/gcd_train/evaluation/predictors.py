"""What is measured: a clip in, its target view out; and what reads saved frames."""

import hashlib
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Protocol, Self, TypeAlias

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from gcd_model import ViewSynthesizer, load_synthesizer
from gcd_model.clip import nearest_classes
from gcd_model.config import SemanticClass
from gcd_model.geometry import CameraMount, Intrinsics, Trajectory, center_crop_box, driving_trajectory, to_pose
from gcd_train.data.encodings import read_colour
from gcd_train.data.sample import Bytes, SceneView
from gcd_train.data.splat import tangents
from gcd_train.errors import DataError
from gcd_train.evaluation.store import FRAMES_IN, Box
from gcd_train.pictures import video_frames


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraPair:
    """Both cameras of one clip.

    ground_from_source: pose of the source camera where z is up and the ground is z = 0, float64 [4, 4], metres: in the
        vehicle's frame, or on the stage that the camera orbits. [T, 4, 4] of one that moves, in any world.
    source, target: their pinholes, in pixels of the pictures.
    zooms: a lens changes over the clip; `source` and `target` are those of the first frame.
    trajectory: where the target camera is, frame by frame.
    mount: how the source camera is declared to sit on its vehicle; None where there is no vehicle.
    """

    ground_from_source: Tensor
    source: Intrinsics
    target: Intrinsics
    trajectory: Trajectory
    mount: CameraMount | None = None
    zooms: bool = False

    @classmethod
    def driving(cls, mount: CameraMount, *, frames: int, height: int, width: int, move_time: int | None = None) -> Self:
        """The fixed path from ParallelDomain-4D's forward camera to the view from above.

        move_time: the frame in which the goal is reached, the last if left out.
        """
        last = frames - 1 if move_time is None else move_time
        return cls(
            ground_from_source=mount.vehicle_from_camera,
            source=Intrinsics.from_hfov(mount.hfov_deg, width, height),
            target=Intrinsics.from_hfov(CameraMount().hfov_deg, width, height),
            trajectory=driving_trajectory(frames=frames, move_time=last, mount=mount),
            mount=mount,
        )

    @classmethod
    def orbit(cls, trajectory: Trajectory, *, hfov_deg: float, height: int, width: int) -> Self:
        """A path over the sphere, both cameras with the same lens."""
        assert trajectory.source is not None, "a path over the sphere begins at a camera"
        lens = Intrinsics.from_hfov(hfov_deg, width, height)
        start = to_pose(trajectory.source)
        return cls(ground_from_source=start, source=lens, target=lens, trajectory=trajectory)

    @property
    def source_from_target(self) -> Tensor:
        """float64 [T, 4, 4], metres."""
        return self.trajectory.source_from_target


def pixel_rays(camera: Intrinsics) -> Tensor:
    """Rays through the pixel centres in the camera's axes, 1 along the optical axis: float64 [H, W, 3]."""
    right, down = torch.meshgrid(*map(torch.from_numpy, tangents(camera)), indexing="xy")
    return torch.stack([right, down, torch.ones_like(right)], dim=-1)


def to_pixels(points: Tensor, camera: Intrinsics) -> Tensor:
    """Where points [..., 3] in the camera's axes lie in its picture, [..., 2]: u and v from the top left corner."""
    u = camera.fx * points[..., 0] / points[..., 2] + camera.cx
    v = camera.fy * points[..., 1] / points[..., 2] + camera.cy
    return torch.stack([u, v], dim=-1)


def through_lens(video: Tensor, own: Intrinsics, lens: Intrinsics) -> Tensor:
    """Pictures [T, 3, h, w] of one lens as another one in the same place shows them, [T, 3, H, W]; black beyond."""
    size = torch.tensor([own.width, own.height])
    grid = to_pixels(pixel_rays(lens), own) * 2 / size - 1
    each = grid.float().expand(len(video), -1, -1, -1)
    drawn = F.grid_sample(video, each, padding_mode="border", align_corners=False)
    return torch.where((grid.abs() <= 1).all(dim=-1), drawn, 0.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class SourceClip:
    """What a predictor may look at: the source side of a clip, and where it is to be seen from.

    source: uint8 [T, H, W, 3] RGB. source_depth: float32 [T, H, W], metres along the optical axis, 0 for the sky; for
    privileged predictors only; [T, 0, 0] of sets without geometry. source_classes: uint8 [T, H, W]; None where the
    world has no ontology.
    cameras: of the clip, the source's as it is declared. fps: frames per second.
    key: names the clip in its set; frames that others have made are found by it.
    others: the T views of each of so many further cameras of the scene, for predictors that are given them (raises
    DataError if it has fewer); None where there is one camera. points: the T source views at their full size, for
    privileged predictors only, with ids as in `source_classes`; empty where `source` is all there is.
    """

    source: Bytes
    source_depth: NDArray[np.float32]
    source_classes: Bytes | None
    cameras: CameraPair
    fps: float
    key: str = ""
    others: Callable[[int], Sequence[Sequence[SceneView]]] | None = None
    points: Sequence[SceneView] = ()


def require_one_lens(clip: SourceClip, method: str) -> None:
    """Raises DataError where a lens changes over the clip, which `method` cannot follow."""
    if clip.cameras.zooms:
        raise DataError(f"{method} takes one lens for a clip, and one of {clip.key} zooms; give another --split")


FAR_M = 1e4
"""What a depth of 0, the sky, stands for: so far away both cameras see the same of it."""


def own_views(source: Bytes, depth: NDArray[np.float32], classes: Bytes | None, lens: Intrinsics) -> list[SceneView]:
    """The T views of a source camera in its own axes; the sky is far."""
    far = np.where(depth > 0, depth, np.float32(FAR_M))
    labels = [None] * len(far) if classes is None else classes
    return [
        SceneView(rgb=rgb, depth=z, classes=ids, instances=None, world_from_camera=np.eye(4), lens=lens)
        for rgb, z, ids in zip(source, far, labels, strict=True)
    ]


@dataclass(frozen=True, kw_only=True, slots=True)
class Prediction:
    """A view as it is measured.

    video: float32 [T, 3, H, W] in [0, 1], or None. classes: uint8 [T, H, W], 255 for no class, or None. more: further
    draws of the same view, of methods that draw. crop: the part of the target that it shows, in the target's own
    pixels; H and W are then the part's, and nothing else of the target is measured. None for all of it.
    """

    video: Tensor | None = None
    classes: Tensor | None = None
    more: "tuple[Prediction, ...]" = ()
    crop: Box | None = None

    @property
    def draws(self) -> "tuple[Prediction, ...]":
        """All draws, this one first."""
        return (self, *self.more)


class Predictor(Protocol):
    """Makes the target view of a clip from its source alone, or, where `privileged`, from its exact depth too.

    It is sent to other processes, so it holds no network; see `OpenedWeights`. details: what it is, for `run.json`.
    """

    @property
    def name(self) -> str: ...
    @property
    def privileged(self) -> bool: ...
    @property
    def details(self) -> dict[str, str]: ...
    def predict(self, clip: SourceClip) -> Prediction: ...


OpenedWeights: TypeAlias = Callable[[], ViewSynthesizer]
"""Gives a model, opened once in each process: `partial` of `open_weights`. Raises CheckpointError."""


@lru_cache(maxsize=2)
def open_weights(path: str, device: str, dtype: str | None, family: str | None = None) -> ViewSynthesizer:
    """Weights by name or path; see `load_synthesizer`."""
    return load_synthesizer(path, family=family, device=device, dtype=dtype)


def to_pictures(frames: Bytes) -> Tensor:
    """uint8 [T, H, W, 3] -> float32 [T, 3, H, W] in [0, 1]."""
    return torch.from_numpy(np.ascontiguousarray(frames)).permute(0, 3, 1, 2).float() / 255.0


def to_labels(classes: Bytes | None) -> Tensor | None:
    """A class map as a tensor, uint8 [T, H, W]."""
    return None if classes is None else torch.from_numpy(np.ascontiguousarray(classes))


def middle(lens: Intrinsics, aspect: float) -> Box | None:
    """The largest centred part of a camera's picture with this width / height; None where that is all of it."""
    crop = center_crop_box(lens.width, lens.height, aspect)
    return None if crop[2:] == (lens.width, lens.height) else crop


def fitted(pictures: Tensor, height: int, width: int) -> Tensor:
    """The middle of pictures [T, 3, ...] in [-1, 1] that has the shape of a network's size, resized to it."""
    left, top, across, down = center_crop_box(pictures.shape[-1], pictures.shape[-2], width / height)
    return resized(pictures[..., top : top + down, left : left + across], height, width, low=-1.0)


def resized(pictures: Tensor, height: int, width: int, *, low: float = 0.0) -> Tensor:
    """[T, 3, ...] at another size, bicubic, within low..1."""
    if pictures.shape[-2:] == (height, width):
        return pictures
    new = F.interpolate(pictures, size=(height, width), mode="bicubic", align_corners=False, antialias=True)
    return new.clamp(low, 1.0)


_PICTURES = (".png", ".jpg", ".jpeg", ".webp")
_VIDEO = ".mp4"
_SAMPLE = re.compile(r"sample_(\d+)")
_RELEASED = re.compile(r".+_(pred_s\d+|gal|io|error|uncert|visocc)")  # what the paper's script writes


def find_draws(folder: Path, key: str) -> list[Path]:
    """The draws of a clip, in order.

    A draw is a folder of pictures by number (`0000.png`, ...; also JPEG and WebP) or a video (`.mp4`), and stands at

        KEY, KEY/sample_0, ...                                   ours
        KEY/frames                                               of AnyView's script
        PREFIX_pred_s0, ... , in `extra` or in the folder itself  of the paper's test script

    where PREFIX names the scene and, from the second on, the trajectory: `..._c02_scn02900`, also with `_fs...` behind
    it, is that of the key `scn02900.sample_02`. Where pictures and a video are of one name, the pictures count.

    Raises: DataError naming the clip if there is nothing, a draw is missing, or the clip lies there several times.
    """
    if not key or Path(key).name != key:
        raise DataError(f"saved frames are found by the clip's name, which must be a file name, got {key!r}")
    at = folder / key
    samples = _numbered({int(named[1]): path for path, named in _draws_in(at, _SAMPLE)}, at)
    video, released = folder / (key + _VIDEO), _released(folder / "extra", key) or _released(folder, key)
    own = [each for each in (samples, *([path] for path in (at, at / "frames") if _is_draw(path))) if each]
    found = [*(own or [[video]] * _is_draw(video)), *([released] if released else [])]
    if len(found) > 1:
        raise DataError(f"{folder} holds clip {key} several times: {found[0][0]} and {found[1][0]}; keep one")
    if not found:
        raise DataError(
            f"{folder} holds no frames for clip {key}: wanted {key}/0000.png and so on, {key}/sample_0/0000.png, "
            f"{key}.mp4, or extra/..._pred_s0 of its scene"
        )
    return found[0]


def _released(folder: Path, key: str) -> list[Path]:
    """Outputs of the paper's script for the clip of this name; without a number they are the first trajectory's."""
    scene, _, sample = key.partition(".")
    wanted = re.search(r"\d+$", sample)
    names = re.compile(rf"(.*?(?:_c(\d+))?_{re.escape(scene)}(?:_fs.*)?)_pred_s(\d+)")
    by_prefix: dict[str, dict[int, Path]] = {}
    for path, named in _draws_in(folder, names):
        if int(named[2] or 0) == (int(wanted[0]) if wanted else 0):
            by_prefix.setdefault(named[1], {})[int(named[3])] = path
    by_prefix = {prefix: draws for prefix, draws in by_prefix.items() if any(map(_is_draw, draws.values()))}
    if len(by_prefix) > 1:
        raise DataError(f"{folder} holds clip {key} several times: {', '.join(sorted(by_prefix))}; keep one")
    return [draw for draws in by_prefix.values() for draw in _numbered(draws, folder)]


def _numbered(draws: Mapping[int, Path], place: Path) -> list[Path]:
    """In order. Raises DataError unless all are there and hold something."""
    numbers = sorted(draws)
    if numbers and (numbers[0] > 1 or numbers[-1] - numbers[0] >= len(numbers)):
        raise DataError(f"{place} holds draws {numbers}, one is missing; number them from 0")
    for path in draws.values():
        if not _is_draw(path):
            raise DataError(f"{path} holds no frames; make them anew, or take the folder away")
    return [draws[number] for number in numbers]


def _draws_in(folder: Path, names: re.Pattern[str]) -> Iterator[tuple[Path, re.Match[str]]]:
    """What a folder holds under such names, folders after videos, so that of one name they count, empty ones too."""
    each = folder.iterdir() if folder.is_dir() else ()
    found = [(path, names.fullmatch(path.stem if path.suffix == _VIDEO else path.name)) for path in each]
    named = [(path, name) for path, name in found if name and (path.is_dir() or _is_draw(path))]
    yield from sorted(named, key=lambda each: (each[0].is_dir(), each[0].name))


def _is_draw(path: Path) -> bool:
    return bool(_pictures(path)) if path.is_dir() else path.suffix == _VIDEO and path.is_file()


def _pictures(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.suffix.lower() in _PICTURES and path.stem.isdecimal()]


@dataclass(frozen=True, kw_only=True, slots=True)
class SavedFrames:
    """The frames that a folder holds for each clip; see `find_draws` for how they may lie there.

    name: of the method. folder: with all clips. painted: the classes in whose colours the frames are painted; then each
    pixel counts as the class of the nearest colour, and as nothing else. Empty for photographs. privileged: whether the
    method was given depth, or further cameras.
    """

    name: str
    folder: Path
    painted: tuple[SemanticClass, ...] = ()
    privileged: bool = False

    @property
    def details(self) -> dict[str, str]:
        """See Predictor; with a digest of all pictures and videos, as frames that are made anew are another method.

        Raises: DataError where they cannot be read.
        """
        digest = hashlib.sha256()
        try:
            named = (each for each in self.folder.rglob("*") if each.suffix.lower() in (*_PICTURES, _VIDEO))
            for path in sorted(each for each in named if each.is_file()):
                with path.open("rb") as file:
                    content = hashlib.file_digest(file, "sha256").hexdigest()
                digest.update(f"{path.relative_to(self.folder)} {content}\n".encode())
        except OSError as error:
            raise DataError(f"{self.folder} cannot be read ({error}); give NAME=FOLDER") from error
        more = {"privileged": "yes"} if self.privileged else {}
        return {FRAMES_IN: str(self.folder), "digest": digest.hexdigest()[:12], **more}

    def beside(self, keys: Collection[str]) -> list[str]:
        """Names of clips that lie in the folder and are not among these; outputs of the paper's script aside."""
        named = {path.stem if path.suffix == _VIDEO else path.name: path for path in self.folder.iterdir()}
        return sorted(
            name
            for name, path in named.items()
            if name not in keys
            and not _RELEASED.fullmatch(name)
            and (any(map(_is_draw, (path, path / "frames"))) or any(_draws_in(path, _SAMPLE)))
        )

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor; each sample that was saved is a draw.

        Raises:
            DataError: there is nothing for this clip, or something damaged, or of another length or size, as nothing is
                resized.
        """
        made, lens = list[Prediction](), clip.cameras.target
        for draw in find_draws(self.folder, clip.key):
            if draw.is_dir():
                found = sorted(_pictures(draw), key=lambda each: int(each.stem))
                numbers = [int(each.stem) for each in found]
                if numbers != list(range(numbers[0], numbers[0] + len(numbers))) or numbers[0] > 1:
                    raise DataError(f"{draw} holds frames {numbers}, one is missing or twice there; number them from 0")
                frames = [read_colour(each) for each in found]
            else:
                frames = list(video_frames(draw))
            if len(frames) != len(clip.source):
                raise DataError(f"{draw} holds {len(frames)} frames, clip {clip.key} has {len(clip.source)}; save all")
            for number, frame in enumerate(frames):
                if frame.shape != (lens.height, lens.width, 3):
                    raise DataError(
                        f"{draw}: frame {number} is {frame.shape[1]} x {frame.shape[0]}, the target {lens.width} x "
                        f"{lens.height}; save them in that size"
                    )
            video = to_pictures(np.stack(frames))
            classes = nearest_classes(video, self.painted) if self.painted else None
            made.append(Prediction(video=None if self.painted else video, classes=classes))
        return replace(made[0], more=tuple(made[1:]))
