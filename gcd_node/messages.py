"""From a rendered view, or a frame of the camera, to the messages that leave the node (wire protocol, section 4)."""

import functools
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from gcd_client.images import VISIBILITY, encode_jpegs, payload_of
from gcd_client.protocol import (
    GRID_PROTO,
    MAPS_PROTO,
    PREVIEW_ID,
    PREVIEW_TOPIC,
    PROTO,
    ClassRecord,
    DataMessage,
    EndHeader,
    EndMessage,
    FrameRole,
    ModelRecord,
    OriginHeader,
    PoseDelta,
    QualityRecord,
    SourceRecord,
    StatusTopic,
    ViewHeader,
    ViewKind,
    ViewMessage,
    kind_of,
    view_topic,
)
from gcd_model import Intrinsics, Traits, Trajectory, View
from gcd_node.frame import HALF_PIXEL, Frame, Image
from gcd_node.image_io import to_u8
from gcd_node.stream_context import StreamContext, family_name, source_pose
from gcd_node.window import FrameWindow

PREVIEW_PERIOD_S = 0.2
"""From one preview of the input to the next, at least."""
PREVIEW_WIDTH = 640
"""Wider pictures are made this wide for a preview."""

_PREVIEW_QUALITY = 80
_PATHS = 32  # most views stand still: their path is the same in every window
_LARGEST_HALF = 65504  # of finite f16
_IDENTITY = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
_NO_MODEL = ModelRecord(name="none", family="unknown", sha256_12="0" * 12, precision="none", device="none")


@dataclass(frozen=True, kw_only=True, slots=True)
class Rendered:
    """One view of one window. started_ns, ended_ns: of the inference, monotonic clock. steps, seed: of the sampler.
    utc_offset_ns: UTC minus the monotonic clock, sampled once for the whole window. flags: see QualityRecord.ood."""

    window: FrameWindow
    view: View
    view_id: str
    view_rev: int
    started_ns: int
    ended_ns: int
    steps: int
    seed: int
    utc_offset_ns: int
    flags: tuple[str, ...] = ()


def utc_offset_ns() -> int:
    """UTC minus the monotonic clock, now."""
    return time.time_ns() - time.monotonic_ns()


def newest_ns(context: StreamContext, window: FrameWindow) -> int:
    """When the newest frame was captured, on the monotonic clock; of a recording, when it was played."""
    return window.stamps_ns[-1] if context.source.clock == "realtime" else window.arrival_ns


def messages(context: StreamContext, rendered: Rendered) -> list[ViewMessage]:
    """The window, its class map, visibility and depth if the model makes them, its frames at the goal pose, and its
    deviation."""
    view, pixels, header = rendered.view, to_u8(rendered.view.video.numpy()), _header(context, rendered)
    window = _pictures(context, header, pixels)
    found = [window]
    if view.classes is not None:
        found.append(_class_map(header, "cls", view.classes[0].numpy(), ontology(context.traits)))
    if view.visibility is not None:
        found.append(_class_map(header, "vis", view.visibility.numpy(), VISIBILITY))
    if view.inverse_depth is not None:
        found.append(_depth(header, view.inverse_depth.numpy()))
    if context.traits.knows_camera:
        found += [_one_frame(window, i) for i, at_goal in enumerate(view.trajectory.at_goal) if at_goal]
    if view.std is not None:
        found.append(_deviation(header, view.std.numpy()))
    return found


def end_message(context: StreamContext, topic: str, view_id: str, view_rev: int, last_window_id: int) -> EndMessage:
    """End-of-stream of one topic. last_window_id: -1 if none was published."""
    header = EndHeader(
        node_id=context.config.node_id,
        boot_id=context.boot_id,
        t_publish_ns=time.time_ns(),
        view_id=view_id,
        view_rev=view_rev,
        window_id=last_window_id,
        clock=context.source.clock,
        proto=_proto(kind_of(topic)),
    )
    return EndMessage(topic=topic, header=header)


def preview_message(context: StreamContext, frame: Frame, arrival_ns: int, epoch: int) -> ViewMessage:
    """The whole picture as the camera gave it, not cut to the model's size; JPEG, at most PREVIEW_WIDTH wide.

    The camera matrix is given where a field of view is stated; not for a lens that distorts, as the picture still
    does too. arrival_ns: on the monotonic clock. epoch: as in FrameWindow.
    """
    started_ns, offset_ns, source = time.monotonic_ns(), utc_offset_ns(), context.source
    picture = _narrowed(frame.image)
    payload, offsets = encode_jpegs(picture[None], _PREVIEW_QUALITY)
    is_live = source.clock == "realtime"
    hfov_deg = source.hfov_in_use(context.config.source.hfov_deg) if context.lens is None else None
    camera = None if hfov_deg is None else Intrinsics.from_hfov(hfov_deg, picture.shape[1], picture.shape[0])
    ended_ns = time.monotonic_ns()
    header = ViewHeader(
        **_common(context),
        t_publish_ns=ended_ns + offset_ns,
        view_id=PREVIEW_ID,
        view_rev=1,
        window_id=-1,
        t_capture_ns=(frame.stamp_ns + offset_ns if is_live else frame.stamp_ns,),
        t_infer_start_ns=started_ns + offset_ns,
        t_infer_end_ns=ended_ns + offset_ns,
        age_ms=(ended_ns - (frame.stamp_ns if is_live else arrival_ns)) / 1e6,
        valid_for_ms=round(2000 * max(PREVIEW_PERIOD_S, 1 / source.fps_nominal)),
        src=SourceRecord(
            kind=source.kind,
            id=source.id,
            seq=(frame.seq,),
            dropped=0,
            fps_in=source.fps_nominal,
            fps_cond=source.fps_nominal,
            resize="none" if picture is frame.image else "area",
            epoch=epoch,
        ),
        frame_id=source.optical_frame,
        frame_role=("at_goal",),
        shape=(1, *picture.shape),
        encoding="jpeg",
        quality=QualityRecord(nan_frames=0, ood=(), steps=0, seed=0),
        model=_NO_MODEL,
        pose=(PoseDelta(az_deg=0.0, el_deg=0.0, r=0.0),),
        source_from_view=(_IDENTITY,),
        pose_units="scene" if context.traits.family is None else context.traits.family.pose_units,
        intrinsics=None if camera is None else camera_matrix(camera),
        offsets=offsets,
        synthetic=False,
    )
    return ViewMessage(topic=PREVIEW_TOPIC, header=header, payload=payload)


def ontology(traits: Traits) -> tuple[ClassRecord, ...]:
    """What the numbers of a model's class maps mean; empty for a model that makes none."""
    return tuple(ClassRecord(id=i, name=each.name, colour=each.colour) for i, each in enumerate(traits.classes))


def camera_matrix(intrinsics: Intrinsics) -> tuple[float, ...]:
    """The 9 numbers of K, row by row, with pixel centres at whole numbers as in OpenCV and ROS."""
    cx, cy = intrinsics.cx - HALF_PIXEL, intrinsics.cy - HALF_PIXEL
    return (intrinsics.fx, 0.0, cx, 0.0, intrinsics.fy, cy, 0.0, 0.0, 1.0)


def world_flags(traits: Traits, score: float | None) -> tuple[str, ...]:
    """Whether the source shows another world than the model's training did, by `View.ood`; never for a model that
    cannot tell."""
    threshold = traits.ood_threshold
    return ("world",) if threshold is not None and score is not None and score > threshold else ()


# Headers.


def _common(context: StreamContext) -> dict[str, Any]:
    """Fields of every message of a stream."""
    return {
        "node_id": context.config.node_id,
        "boot_id": context.boot_id,
        "clock": context.source.clock,
        "t_capture_unc_us": context.source.stamp_uncertainty_us,
        "src_frame_id": context.source.optical_frame,
        "cfg_digest": context.digest,
    }


def captured(
    context: StreamContext, window: FrameWindow, inferred_ns: tuple[int, int], offset_ns: int
) -> dict[str, Any]:
    """Fields of every message of a window that leaves now. inferred_ns: from when to when, on the monotonic clock.
    offset_ns: see utc_offset_ns()."""
    traits, source = context.traits, context.source
    now_ns, monotonic_ns = time.time_ns(), time.monotonic_ns()
    period_ms = 1000.0 * (context.config.window.stride or len(window.stamps_ns)) / window.fps
    to_utc_ns = offset_ns if source.clock == "realtime" else 0
    return _common(context) | {
        "t_publish_ns": now_ns,
        "window_id": window.window_id,
        "t_capture_ns": tuple(stamp_ns + to_utc_ns for stamp_ns in window.stamps_ns),
        "t_infer_start_ns": inferred_ns[0] + offset_ns,
        "t_infer_end_ns": inferred_ns[1] + offset_ns,
        "age_ms": (monotonic_ns - newest_ns(context, window)) / 1e6,
        "valid_for_ms": round(2 * period_ms),
        "src": SourceRecord(
            kind=source.kind,
            id=source.id,
            seq=window.seqs,
            dropped=window.dropped,
            fps_in=source.fps_nominal,
            fps_cond=window.fps,
            resize=context.fit.resize,
            epoch=window.epoch,
        ),
        "model": ModelRecord(
            name=traits.name,
            family=family_name(traits),
            sha256_12=traits.sha256_12,
            precision=traits.precision,
            device=traits.device,
        ),
    }


def _header(context: StreamContext, rendered: Rendered) -> ViewHeader:
    window, view, traits = rendered.window, rendered.view, context.traits
    path = view.trajectory
    camera = path.lens or context.intrinsics
    roles: tuple[FrameRole, ...] = tuple(
        "at_goal" if at_goal and traits.knows_camera else "in_transit" for at_goal in path.at_goal
    )
    return ViewHeader(
        **captured(context, window, (rendered.started_ns, rendered.ended_ns), rendered.utc_offset_ns),
        view_id=rendered.view_id,
        view_rev=rendered.view_rev,
        frame_id=f"{rendered.view_id}_optical",
        frame_role=roles,
        shape=(path.frames, *view.video.shape[-2:], 3),
        encoding="rgb8",
        quality=QualityRecord(
            nan_frames=0,
            ood=(*context.ood, *input_flags(window), *world_flags(traits, view.ood), *rendered.flags),
            steps=rendered.steps,
            seed=rendered.seed,
            ood_score=view.ood,
        ),
        pose=_deltas(path),
        source_from_view=_matrices(path) if traits.knows_camera else None,
        pose_units="scene" if traits.family is None else traits.family.pose_units,
        src_pose=source_pose(context),
        intrinsics=None if camera is None else camera_matrix(camera),
    )


def _proto(kind: str) -> str:
    """The minor version in which the kind came."""
    return {"vis": MAPS_PROTO, "depth": MAPS_PROTO, "grid": GRID_PROTO}.get(kind, PROTO)


@functools.lru_cache(maxsize=_PATHS)
def _deltas(path: Trajectory) -> tuple[PoseDelta, ...] | None:
    if path.delta is None:
        return None
    return tuple(PoseDelta(az_deg=az_deg, el_deg=el_deg, r=r) for az_deg, el_deg, r in path.delta.tolist())


@functools.lru_cache(maxsize=_PATHS)
def _matrices(path: Trajectory) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in path.source_from_target.flatten(1).tolist())


def input_flags(window: FrameWindow) -> tuple[str, ...]:
    """What is wrong with the input picture itself (docs/node.md, F13)."""
    is_exposed = 8 <= float(window.images[:, ::16, ::8].mean()) <= 247
    return (*(() if is_exposed else ("exposure",)), *(("static",) if window.static else ()))


# Payloads.


def _pictures(context: StreamContext, header: ViewHeader, pixels: Image) -> ViewMessage:
    topic, publish = view_topic(header.view_id, "win"), context.config.publish
    if publish.encoding == "rgb8":
        return ViewMessage(topic=topic, header=header, payload=payload_of(pixels))
    payload, offsets = encode_jpegs(pixels, publish.jpeg_quality)
    return ViewMessage(topic=topic, header=replace(header, encoding="jpeg", offsets=offsets), payload=payload)


def _one_frame(window: ViewMessage, i: int) -> ViewMessage:
    """A slice of a window; it is older than the newest frame by the time between them."""
    header, part = window.header, slice(i, i + 1)
    size = len(window.payload) // header.shape[0]
    begin, end = header.offsets[i : i + 2] if header.offsets else (i * size, (i + 1) * size)
    older_ms = (header.t_capture_ns[-1] - header.t_capture_ns[i]) / 1e6
    alone = replace(
        header,
        age_ms=header.age_ms + older_ms,
        t_capture_ns=header.t_capture_ns[part],
        src=replace(header.src, seq=header.src.seq[part]),
        frame_role=header.frame_role[part],
        shape=(1, *header.shape[1:]),
        pose=None if header.pose is None else header.pose[part],
        source_from_view=None if header.source_from_view is None else header.source_from_view[part],
        offsets=None if header.offsets is None else (0, end - begin),
    )
    return ViewMessage(topic=view_topic(header.view_id, "frm"), header=alone, payload=window.payload[begin:end])


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
    fields = {"shape": pixels.shape, "classes": classes, "range": (0, max(each.id for each in classes))}
    described = replace(header, proto=_proto(kind), encoding="class8", **fields)
    return ViewMessage(topic=view_topic(header.view_id, kind), header=described, payload=payload_of(pixels))


def _depth(header: ViewHeader, inverse: NDArray[np.float32]) -> ViewMessage:
    """What is no depth becomes 0, none: the door for numbers of a model or a sensor."""
    halves = np.where(np.isfinite(inverse), inverse, 0).clip(0, _LARGEST_HALF).astype("<f2")[..., None]
    fields = {"shape": halves.shape, "dtype": "f16", "range": (0, _LARGEST_HALF)}
    described = replace(header, proto=_proto("depth"), encoding="invdepth16", **fields)
    payload = payload_of(halves.view(np.uint8))
    return ViewMessage(topic=view_topic(header.view_id, "depth"), header=described, payload=payload)


def _narrowed(image: Image) -> Image:
    height, width = image.shape[:2]
    if width <= PREVIEW_WIDTH:
        return image
    size = (PREVIEW_WIDTH, max(1, round(height * PREVIEW_WIDTH / width)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


# Where they go.


@dataclass(frozen=True, kw_only=True, slots=True)
class PublisherStats:
    """sent, bytes: handed to ZeroMQ on the data socket. dropped: refused because the queue was full. What ZeroMQ drops
    for a slow reader shows in no counter here: that reader sees a gap in the sequence.
    subscribers: subscriptions on the data socket now; watchers, previews: those that get views, previews of the input.
    """

    sent: int = 0
    dropped: int = 0
    bytes: int = 0
    subscribers: int = 0
    watchers: int = 0
    previews: int = 0


class MessageSink(Protocol):
    """Where the node's messages go: a Publisher, the files of a replay, or a list in a test."""

    def send(self, message: DataMessage) -> object:
        """Hand over a view or a grid."""
        ...

    def preview(self, made: Callable[[], ViewMessage]) -> None:
        """Hand over the newest preview of the input, to be made when it leaves."""
        ...

    def end(self, message: EndMessage, *, delay_ms: int | None = None) -> None:
        """Hand over an end-of-stream, to follow the last view."""
        ...

    def note(self, topic: StatusTopic, header: OriginHeader, fields: Mapping[str, Any]) -> None:
        """Hand over a status, event or meta note."""
        ...

    def stop_waiting(self) -> None:
        """Stop waiting for readers."""
        ...

    @property
    def stats(self) -> PublisherStats:
        """What has left."""
        ...
