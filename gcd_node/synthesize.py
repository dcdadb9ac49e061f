"""One clip, one view, offline: what `gcd-node synthesize` does between reading its input and writing its output."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gcd_client.images import VISIBILITY, paint
from gcd_client.protocol import ClassRecord
from gcd_model import (
    Augmentation,
    CameraMount,
    RenderOptions,
    SphericalDelta,
    Trajectory,
    View,
    ViewSynthesizer,
    hatched,
    visibility_of,
)
from gcd_node.errors import OutputError, SourceError, UsageError
from gcd_node.offline_clip import OfflineClip
from gcd_node.pictures.array_file import read_npy, read_npz, write_npz
from gcd_node.pictures.comparison import legend
from gcd_node.pictures.files import (
    Image,
    heat,
    side_by_side,
    spread,
    strip,
    to_u8,
    write_frames,
    write_png,
    write_video,
)
from gcd_node.preprocess import stated_sphere
from gcd_node.source_config import SourcePose

_STRIP_FRAMES = 7


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewRequest:
    """The wanted camera path, in the words of the command line.

    delta: destination minus source; None if no angle was named. poses: a .npy file of [T, 4, 4] source-from-target.
    trajectory: "gradual" or "direct", or else move_time. source: where the source camera stands, if stated.
    """

    delta: SphericalDelta | None = None
    poses: Path | None = None
    trajectory: str | None = None
    move_time: int | None = None
    source: SourcePose | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class InjectedNoise:
    """Unit-variance noise from a file: initial [T, C, h, w], augmentation [T, 3, H, W]."""

    initial: torch.Tensor | None = None
    augmentation: torch.Tensor | None = None


def plan(synthesizer: ViewSynthesizer, request: ViewRequest, mount: CameraMount | None = None) -> Trajectory:
    """The camera path for a request. mount: of the source camera, None for the trained one.

    Raises:
        UsageError: options that contradict each other, or an unknown kind of trajectory.
        PoseError and its kind: see Traits.plan_view and Traits.plan_poses.
    """
    traits, source = synthesizer.traits, stated_sphere(request.source)
    if request.poses is not None:
        if request.delta is not None or request.trajectory is not None or request.move_time is not None:
            raise UsageError("--poses states the whole path; leave out the angles, --trajectory and --move-time")
        return traits.plan_poses(torch.from_numpy(read_poses(request.poses)), source=source)
    if request.trajectory is not None and request.move_time is not None:
        raise UsageError("--trajectory and --move-time say the same thing twice; give one of them")
    times = {None: None, "gradual": traits.config.frames - 1, "direct": 0}
    if request.trajectory not in times:
        raise UsageError(f"--trajectory is gradual or direct, got {request.trajectory!r}")
    move_time = times[request.trajectory] if request.move_time is None else request.move_time
    return traits.plan_view(request.delta, source=source, move_time=move_time, mount=mount)


def read_poses(path: Path) -> NDArray[np.float64]:
    """[T, 4, 4] from a .npy file. Raises SourceError."""
    poses = read_npy(path, "a .npy file of [T, 4, 4]")
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or poses.dtype.kind not in "fiu":
        raise SourceError(f"poses in {path} must be numbers [T, 4, 4], got {poses.dtype} {list(poses.shape)}")
    return poses.astype(np.float64)


def read_noise(path: Path) -> InjectedNoise:
    """Noise from an .npz file with `initial` and `augmentation`, either may be missing. Raises SourceError."""
    arrays = read_npz(path, "an .npz file with `initial` and `augmentation`")
    unknown = sorted(set(arrays) - {"initial", "augmentation"})
    if unknown or not arrays:
        raise SourceError(f"{path} must hold `initial` and `augmentation`, got {unknown or 'nothing'}")
    for name, array in arrays.items():
        if array.dtype.kind != "f" or array.ndim != 4 or not np.isfinite(array).all():
            raise SourceError(f"`{name}` in {path} must be finite floats with 4 axes, got {array.dtype} {array.shape}")
    tensors = {name: torch.from_numpy(array.astype(np.float32)) for name, array in arrays.items()}
    return InjectedNoise(initial=tensors.get("initial"), augmentation=tensors.get("augmentation"))


def require_input(path: Path) -> None:
    """Raises SourceError if there is nothing at `path`: cheaper to know before the weights are loaded."""
    if not path.exists():
        raise SourceError(f"{path} does not exist; give a video, a folder of pictures, a still or a .npy file")


def render(
    synthesizer: ViewSynthesizer,
    source: OfflineClip,
    trajectory: Trajectory,
    options: RenderOptions,
    augmentation: Augmentation,
) -> View:
    """Encode the clip and render the view. Where the model does not tell what was seen, the clip's depth does."""
    view = synthesizer.render(synthesizer.encode(source.clip, augmentation), [trajectory], options)[0]
    if view.visibility is not None or source.clip.depth is None:
        return view
    return replace(view, visibility=visibility_of(source.clip, trajectory))


def write_view(out: Path, source: OfflineClip, view: View, classes: Sequence[ClassRecord]) -> list[Path]:
    """Write frames, videos, pictures, class numbers, visibility and depth; gives the paths worth telling.

    classes: the ontology of the view's class map, empty if the model makes none.
    The first sample goes to frames/ and view.mp4, further ones to frames_s1/, view_s1.mp4, and so on.
    Raises:
        OutputError: it cannot be written.
    """
    written: list[Path] = []
    try:
        for number, sample in enumerate(view.samples):
            ending = f"_s{number}" if number else ""
            frames = to_u8(sample.numpy())
            write_frames(out / f"frames{ending}", frames)
            write_video(out / f"view{ending}.mp4", list(frames), source.clip.fps)
            written += [out / f"frames{ending}", out / f"view{ending}.mp4"]
        class_map = None
        if view.classes is not None:
            class_map = paint(view.classes[0].numpy(), classes)
            save_classes(out / "classes.npz", view.classes.numpy(), classes)
            written.append(out / "classes.npz")
        pictures, maps = to_u8(view.video.numpy()), [] if class_map is None else [class_map]
        if view.visibility is not None:
            seen = hatched(pictures, view.visibility.numpy())
            write_npz(out / "visibility.npz", {"visibility": view.visibility.numpy(), **_ontology(VISIBILITY)})
            write_video(out / "seen.mp4", list(seen), source.clip.fps)
            written += [out / "visibility.npz", out / "seen.mp4"]
            maps.insert(0, seen)
        if view.inverse_depth is not None:
            write_npz(out / "depth.npz", {"inverse_depth": view.inverse_depth.numpy()})
            written.append(out / "depth.npz")
        write_png(out / "strip.png", strip_picture(source.pictures, pictures, maps, classes))
        written.append(out / "strip.png")
        if view.std is not None:
            write_png(out / "uncertainty.png", uncertainty_picture(view.std.numpy()))
            written.append(out / "uncertainty.png")
    except OSError as error:
        raise OutputError(f"cannot write to {out}: {error.strerror}; name another folder with --out") from error
    return written


def save_arrays(path: Path, view: View) -> None:
    """Write `latents` [T, C, h, w] (final, scaled space) and `frames` [T, H, W, 3] in [0, 1], both float32.

    The file appears whole or not at all. Raises OutputError.
    """
    frames = view.video.permute(0, 2, 3, 1).contiguous()
    write_npz(path, {"latents": view.latents[0].numpy(), "frames": frames.numpy()})


def save_classes(path: Path, numbers: NDArray[np.uint8], classes: Sequence[ClassRecord]) -> None:
    """Write `classes` u8 [S, T, H, W], and what its numbers mean: `ids` [K], `names` [K] and RGB `colours` [K, 3].

    The file appears whole or not at all. Raises OutputError.
    """
    write_npz(path, {"classes": numbers, **_ontology(classes)})


def _ontology(classes: Sequence[ClassRecord]) -> dict[str, NDArray[Any]]:
    return {
        "ids": np.array([each.id for each in classes], np.uint8),
        "names": np.array([each.name for each in classes]),
        "colours": np.array([each.colour for each in classes], np.uint8),
    }


def strip_picture(inputs: Image, views: Image, maps: Sequence[Image], classes: Sequence[ClassRecord]) -> Image:
    """Input above view, what is known of the view below it, and the legend of its classes, at a few moments."""
    chosen = spread(len(views), _STRIP_FRAMES)
    picture = strip([[row[i] for i in chosen] for row in (inputs, views, *maps)])
    return np.concatenate([picture, legend(classes, picture.shape[1])]) if classes else picture


def uncertainty_picture(std: NDArray[np.float32]) -> Image:
    """Per-pixel deviation over samples at a few moments, [T, H, W]; bright is uncertain."""
    top = max(float(std.max()), 1e-6)
    return side_by_side(*(heat(std[i], top) for i in spread(len(std), _STRIP_FRAMES)))
