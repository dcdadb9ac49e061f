"""From a rendered view to the messages that leave the node."""

import functools
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from gcd_client.images import VISIBILITY, encode_jpegs, payload_of
from gcd_client.protocol import (
    MAPS_PROTO,
    ClassRecord,
    EndHeader,
    EndMessage,
    FrameRole,
    ModelRecord,
    PoseDelta,
    QualityRecord,
    SourcePoseRecord,
    SourceRecord,
    ViewHeader,
    ViewKind,
    ViewMessage,
    view_topic,
)
from gcd_model import ASSUMED_SOURCE, CameraMount, Intrinsics, Traits, Trajectory, View
from gcd_node.calibration import HALF_PIXEL
from gcd_node.config import NodeConfig
from gcd_node.config_digest import config_digest
from gcd_node.frame import Image, SourceInfo
from gcd_node.image_io import to_u8
from gcd_node.preprocess import ResizePath, stated_sphere
from gcd_node.sources.depth import DepthSource
from gcd_node.window import FrameWindow

_PATHS = 32  # most views stand still: their path is the same in every window
_LARGEST_HALF = 65504  # of finite f16
_Header = TypeVar("_Header", ViewHeader, EndHeader)


@dataclass(frozen=True, kw_only=True, slots=True)
class Run:
    """What stays the same in every message of a run.

    intrinsics: of the generated picture, None if nobody knows the field of view.
    mount: of the source camera, for a model that uses it; None if nothing was stated.
    ood: what lies outside the trained domain from the start: "fps", "hfov".
    resize: how source pictures become the model's, published as `src.resize`.
    depth: what takes the place of the live model's own depth; None for that.
    """

    config: NodeConfig
    traits: Traits
    source: SourceInfo
    boot_id: str
    intrinsics: Intrinsics | None
    mount: CameraMount | None
    ood: tuple[str, ...]
    resize: ResizePath
    depth: DepthSource | None = None

    @property
    def digest(self) -> str:
        """Of the configuration; see config_digest()."""
        return config_digest(self.config, self.traits)

    @property
    def classes(self) -> tuple[ClassRecord, ...]:
        """The ontology of the class maps; empty for a model that makes none."""
        return ontology(self.traits)


@dataclass(frozen=True, kw_only=True, slots=True)
class Rendered:
    """One view of one window. started_ns, ended_ns: of the inference, monotonic clock. steps, seed: of the sampler.
    utc_offset_ns: UTC minus the monotonic clock, sampled once for the whole window."""

    window: FrameWindow
    view: View
    view_id: str
    view_rev: int
    started_ns: int
    ended_ns: int
    steps: int
    seed: int
    utc_offset_ns: int


def utc_offset_ns() -> int:
    """UTC minus the monotonic clock, now."""
    return time.time_ns() - time.monotonic_ns()


def newest_ns(run: Run, window: FrameWindow) -> int:
    """When the newest frame was captured, on the monotonic clock; of a recording, when it was played."""
    return window.stamps_ns[-1] if run.source.clock == "realtime" else window.arrival_ns


def messages(run: Run, rendered: Rendered) -> list[ViewMessage]:
    """The window, its class map, visibility and depth if the model makes them, its frames at the goal pose, and its
    deviation.
    """
    pixels = to_u8(rendered.view.video.numpy())
    header = _header(run, rendered)
    window = _message(run, header, pixels, "win")
    at_goal = _at_goal(rendered.view.trajectory) if run.traits.knows_camera else []
    goal = [_message(run, _one_frame(header, i), pixels[i : i + 1], "frm") for i in at_goal]
    view = rendered.view
    std = view.std
    return [
        window,
        *([] if view.classes is None else [_class_map(header, "cls", view.classes[0].numpy(), run.classes)]),
        *([] if view.visibility is None else [_class_map(header, "vis", view.visibility.numpy(), VISIBILITY)]),
        *([] if view.inverse_depth is None else [_depth(header, view.inverse_depth.numpy())]),
        *goal,
        *([] if std is None else [_deviation(header, std.numpy())]),
    ]


def end_messages(
    run: Run, view_id: str, view_rev: int, last_window_id: int, kinds: Iterable[ViewKind]
) -> list[EndMessage]:
    """End-of-stream of a view, for its topics of these kinds. last_window_id: -1 if none was published."""
    header = EndHeader(
        node_id=run.config.node_id,
        boot_id=run.boot_id,
        t_publish_ns=time.time_ns(),
        view_id=view_id,
        view_rev=view_rev,
        window_id=last_window_id,
        clock=run.source.clock,
    )
    return [EndMessage(topic=view_topic(view_id, kind), header=_of_kind(header, kind)) for kind in kinds]


def published_kinds(run: Run) -> Iterator[ViewKind]:
    """What is published of each view, as far as it is known before there is one; see carried_kinds()."""
    yield from ("win", "frm")
    if run.classes:
        yield "cls"
    if run.traits.live:
        yield from ("vis", "depth")
    if run.traits.live or run.config.model.samples > 1:
        yield "std"


def carried_kinds(view: View) -> frozenset[ViewKind]:
    """What is published of a view because it holds it."""
    held: dict[ViewKind, object] = {"vis": view.visibility, "depth": view.inverse_depth, "std": view.log_variance}
    return frozenset(kind for kind, values in held.items() if values is not None)


def _message(run: Run, header: ViewHeader, pixels: Image, kind: str) -> ViewMessage:
    topic = view_topic(header.view_id, "win" if kind == "win" else "frm")
    if run.config.publish.encoding == "rgb8":
        return ViewMessage(topic=topic, header=header, payload=payload_of(pixels))
    payload, offsets = encode_jpegs(pixels, run.config.publish.jpeg_quality)
    return ViewMessage(topic=topic, header=replace(header, encoding="jpeg", offsets=offsets), payload=payload)


def _deviation(header: ViewHeader, std: NDArray[np.float32]) -> ViewMessage:
    levels = std * 255.0  # in grey levels, like the pixels
    scale = max(float(levels.max()) / 255.0, 1e-6)
    pixels = np.rint(levels / scale).clip(0, 255).astype(np.uint8)[..., None]
    described = replace(header, shape=pixels.shape, encoding="mono8", scale=scale)
    return ViewMessage(topic=view_topic(header.view_id, "std"), header=described, payload=payload_of(pixels))


def _class_map(
    header: ViewHeader, kind: ViewKind, numbers: NDArray[np.uint8], classes: tuple[ClassRecord, ...]
) -> ViewMessage:
    pixels = numbers[..., None]  # [T, H, W, 1]
    described = replace(
        _of_kind(header, kind),
        shape=pixels.shape,
        encoding="class8",
        classes=classes,
        range=(0, max(each.id for each in classes)),
    )
    return ViewMessage(topic=view_topic(header.view_id, kind), header=described, payload=payload_of(pixels))


def _depth(header: ViewHeader, inverse: NDArray[np.float32]) -> ViewMessage:
    """What is no depth becomes 0, none: the door for numbers of a model or a sensor."""
    halves = np.where(np.isfinite(inverse), inverse, 0).clip(0, _LARGEST_HALF).astype("<f2")[..., None]
    described = replace(
        _of_kind(header, "depth"), shape=halves.shape, encoding="invdepth16", dtype="f16", range=(0, _LARGEST_HALF)
    )
    payload = payload_of(halves.view(np.uint8))
    return ViewMessage(topic=view_topic(header.view_id, "depth"), header=described, payload=payload)


def _of_kind(header: _Header, kind: ViewKind) -> _Header:
    """A header that states the minor version in which the kind came."""
    return replace(header, proto=MAPS_PROTO) if kind in ("vis", "depth") else header


def _header(run: Run, rendered: Rendered) -> ViewHeader:
    window, path = rendered.window, rendered.view.trajectory
    now_ns, monotonic_ns = time.time_ns(), time.monotonic_ns()
    offset_ns, is_live = rendered.utc_offset_ns, run.source.clock == "realtime"
    period_ms = 1000.0 * (run.config.window.stride or path.frames) / window.fps
    return ViewHeader(
        node_id=run.config.node_id,
        boot_id=run.boot_id,
        t_publish_ns=now_ns,
        view_id=rendered.view_id,
        view_rev=rendered.view_rev,
        window_id=window.window_id,
        t_capture_ns=tuple(stamp_ns + offset_ns for stamp_ns in window.stamps_ns) if is_live else window.stamps_ns,
        t_capture_unc_us=run.source.stamp_uncertainty_us,
        clock=run.source.clock,
        t_infer_start_ns=rendered.started_ns + offset_ns,
        t_infer_end_ns=rendered.ended_ns + offset_ns,
        age_ms=(monotonic_ns - newest_ns(run, window)) / 1e6,
        valid_for_ms=round(2 * period_ms),
        src=_source(run, window),
        frame_id=f"{rendered.view_id}_optical",
        src_frame_id=f"{run.source.kind}_optical",
        frame_role=tuple(_role(at_goal and run.traits.knows_camera) for at_goal in path.at_goal),
        shape=(path.frames, *rendered.view.video.shape[-2:], 3),
        encoding="rgb8",
        quality=QualityRecord(
            nan_frames=0,
            ood=(*run.ood, *_input_flags(window), *world_flags(run.traits, rendered.view)),
            steps=rendered.steps,
            seed=rendered.seed,
            ood_score=rendered.view.ood,
        ),
        model=_model(run.traits),
        cfg_digest=run.digest,
        pose=_deltas(path),
        source_from_view=_matrices(path) if run.traits.knows_camera else None,
        pose_units="scene" if run.traits.family is None else run.traits.family.pose_units,
        src_pose=source_pose(run),
        intrinsics=None if run.intrinsics is None else camera_matrix(run.intrinsics),
    )


def ontology(traits: Traits) -> tuple[ClassRecord, ...]:
    """What the numbers of a model's class maps mean; empty for a model that makes none."""
    return tuple(ClassRecord(id=i, name=each.name, colour=each.colour) for i, each in enumerate(traits.classes))


def camera_matrix(intrinsics: Intrinsics) -> tuple[float, ...]:
    """The 9 numbers of K, row by row, with pixel centres at whole numbers as in OpenCV and ROS."""
    cx, cy = intrinsics.cx - HALF_PIXEL, intrinsics.cy - HALF_PIXEL
    return (intrinsics.fx, 0.0, cx, 0.0, intrinsics.fy, cy, 0.0, 0.0, 1.0)


def _one_frame(header: ViewHeader, index: int) -> ViewHeader:
    """The header of one frame of a window; it is older than the newest by the time between them."""
    older_ms = (header.t_capture_ns[-1] - header.t_capture_ns[index]) / 1e6
    matrices = header.source_from_view
    return replace(
        header,
        age_ms=header.age_ms + older_ms,
        t_capture_ns=header.t_capture_ns[index : index + 1],
        src=replace(header.src, seq=header.src.seq[index : index + 1]),
        frame_role=header.frame_role[index : index + 1],
        shape=(1, *header.shape[1:]),
        pose=None if header.pose is None else header.pose[index : index + 1],
        source_from_view=None if matrices is None else matrices[index : index + 1],
    )


def _source(run: Run, window: FrameWindow) -> SourceRecord:
    return SourceRecord(
        kind=run.source.kind,
        id=run.source.id,
        seq=window.seqs,
        dropped=window.dropped,
        fps_in=run.source.fps_nominal,
        fps_cond=window.fps,
        resize=run.resize,
        epoch=window.epoch,
    )


def source_pose(run: Run) -> SourcePoseRecord | None:
    """Where the source camera of a steered model stands; None for a model with a fixed view, and on a vehicle."""
    if run.traits.config.camera == "none" or run.mount is not None:
        return None  # a fixed path states its rigid transforms itself
    stated = stated_sphere(run.config.source.pose)
    source = stated or ASSUMED_SOURCE
    return SourcePoseRecord(el_deg=source.elevation_deg, r=source.radius_m, assumed=stated is None)


def _model(traits: Traits) -> ModelRecord:
    return ModelRecord(
        name=traits.name,
        family="unknown" if traits.family is None else traits.family.name,
        sha256_12=traits.sha256_12,
        precision=traits.precision,
        device=traits.device,
    )


@functools.lru_cache(maxsize=_PATHS)
def _deltas(path: Trajectory) -> tuple[PoseDelta, ...] | None:
    if path.delta is None:
        return None
    return tuple(
        PoseDelta(az_deg=azimuth, el_deg=elevation, r=radius) for azimuth, elevation, radius in path.delta.tolist()
    )


@functools.lru_cache(maxsize=_PATHS)
def _matrices(path: Trajectory) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in path.source_from_target.flatten(1).tolist())


def _role(at_goal: bool) -> FrameRole:
    return "at_goal" if at_goal else "in_transit"


def _at_goal(path: Trajectory) -> Sequence[int]:
    return [index for index, at_goal in enumerate(path.at_goal) if at_goal]


def world_flags(traits: Traits, view: View) -> tuple[str, ...]:
    """Whether the source shows another world than the model's training did; never for a model that cannot tell."""
    threshold = traits.ood_threshold
    return ("world",) if threshold is not None and view.ood is not None and view.ood > threshold else ()


def _input_flags(window: FrameWindow) -> tuple[str, ...]:
    """What is wrong with the input picture itself (wire protocol, section 7, F13)."""
    exposed = 8 <= float(window.images[:, ::16, ::8].mean()) <= 247
    return (*(() if exposed else ("exposure",)), *(("static",) if window.static else ()))
