"""From a frame of the camera to the message that shows it: topic src/frm (wire protocol, section 4)."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from gcd_client.images import encode_jpegs
from gcd_client.protocol import (
    PREVIEW_ID,
    PREVIEW_TOPIC,
    EndHeader,
    EndMessage,
    ModelRecord,
    PoseDelta,
    QualityRecord,
    SourceRecord,
    ViewHeader,
    ViewMessage,
)
from gcd_model import Intrinsics
from gcd_node.frame import Frame, Image
from gcd_node.messages import Run, camera_matrix, utc_offset_ns
from gcd_node.publisher import MessageSink

PREVIEW_PERIOD_S = 0.2
"""From one preview to the next, at least."""

PREVIEW_WIDTH = 640
"""Wider pictures are made this wide."""

_LEAST = 0.9  # of a period between two previews, so that a camera's jitter does not make it miss every second one
_QUALITY = 80
_NO_WINDOW = -1
_HERE = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
_NO_MODEL = ModelRecord(name="none", family="unknown", sha256_12="0" * 12, precision="none", device="none")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class CapturedFrame:
    """A frame and what belongs to it. arrival_ns: on the monotonic clock. epoch: as in FrameWindow."""

    frame: Frame
    arrival_ns: int
    epoch: int


class InputPreview:
    """Shows what the camera sees to whoever subscribes, a few times a second. Belongs to the reader thread."""

    def __init__(self, sink: MessageSink, run: Callable[[], Run], clock: Callable[[], float] = time.monotonic) -> None:
        """run: what is known of the source now. clock: monotonic seconds."""
        self._sink, self._run, self._clock = sink, run, clock
        self._next_s = clock()
        self._shown = False

    def offer(self, shot: CapturedFrame) -> None:
        """A frame arrived; does not wait. With no subscriber it costs a look at a counter."""
        now_s = self._clock()
        if now_s < self._next_s or self._sink.stats.readers.previews == 0:
            return
        self._next_s = max(self._next_s + PREVIEW_PERIOD_S, now_s + _LEAST * PREVIEW_PERIOD_S)
        self._shown = True
        run = self._run()
        self._sink.preview(lambda: preview_message(run, shot))

    def announce_end(self, *, delay_ms: int | None) -> None:
        """End the topic, if anybody got something on it. delay_ms: see MessageSink."""
        if self._shown:
            self._sink.end(preview_end(self._run()), delay_ms=delay_ms)


def preview_message(run: Run, shot: CapturedFrame) -> ViewMessage:
    """The whole picture as the camera gave it, not cut to the model's size; JPEG, at most PREVIEW_WIDTH wide.

    The camera matrix is given where a field of view is stated; not for a lens that distorts, as the picture still
    does too.
    """
    started_ns, offset_ns = time.monotonic_ns(), utc_offset_ns()
    picture = _narrowed(shot.frame.image)
    payload, offsets = encode_jpegs(picture[None], _QUALITY)
    source, frame = run.source, shot.frame
    is_live = source.clock == "realtime"
    camera = _camera(run, picture)
    ended_ns = time.monotonic_ns()
    header = ViewHeader(
        node_id=run.config.node_id,
        boot_id=run.boot_id,
        t_publish_ns=ended_ns + offset_ns,
        view_id=PREVIEW_ID,
        view_rev=1,
        window_id=_NO_WINDOW,
        t_capture_ns=(frame.stamp_ns + offset_ns if is_live else frame.stamp_ns,),
        t_capture_unc_us=source.stamp_uncertainty_us,
        clock=source.clock,
        t_infer_start_ns=started_ns + offset_ns,
        t_infer_end_ns=ended_ns + offset_ns,
        age_ms=(ended_ns - (frame.stamp_ns if is_live else shot.arrival_ns)) / 1e6,
        valid_for_ms=round(2000 * max(PREVIEW_PERIOD_S, 1 / source.fps_nominal)),
        src=_source(run, shot, picture),
        frame_id=f"{source.kind}_optical",
        src_frame_id=f"{source.kind}_optical",
        frame_role=("at_goal",),
        shape=(1, *picture.shape),
        encoding="jpeg",
        quality=QualityRecord(nan_frames=0, ood=(), steps=0, seed=0),
        model=_NO_MODEL,
        cfg_digest=run.digest,
        pose=(PoseDelta(az_deg=0.0, el_deg=0.0, r=0.0),),
        source_from_view=(_HERE,),
        pose_units="scene" if run.traits.family is None else run.traits.family.pose_units,
        intrinsics=None if camera is None else camera_matrix(camera),
        offsets=offsets,
        synthetic=False,
    )
    return ViewMessage(topic=PREVIEW_TOPIC, header=header, payload=payload)


def preview_end(run: Run) -> EndMessage:
    """No more input."""
    header = EndHeader(
        node_id=run.config.node_id,
        boot_id=run.boot_id,
        t_publish_ns=time.time_ns(),
        view_id=PREVIEW_ID,
        view_rev=1,
        window_id=_NO_WINDOW,
        clock=run.source.clock,
    )
    return EndMessage(topic=PREVIEW_TOPIC, header=header)


def _narrowed(image: Image) -> Image:
    height, width = image.shape[:2]
    if width <= PREVIEW_WIDTH:
        return image
    size = (PREVIEW_WIDTH, max(1, round(height * PREVIEW_WIDTH / width)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _source(run: Run, shot: CapturedFrame, picture: Image) -> SourceRecord:
    fps = run.source.fps_nominal
    return SourceRecord(
        kind=run.source.kind,
        id=run.source.id,
        seq=(shot.frame.seq,),
        dropped=0,
        fps_in=fps,
        fps_cond=fps,
        resize="none" if picture is shot.frame.image else "area",
        epoch=shot.epoch,
    )


def _camera(run: Run, picture: Image) -> Intrinsics | None:
    """Of the preview; None if nobody states a field of view, or the lens is known to distort."""
    stated = run.config.source
    hfov_deg = run.source.hfov_in_use(stated.hfov_deg)
    if hfov_deg is None or stated.calibration is not None or (run.source.lens is not None and stated.hfov_deg is None):
        return None
    return Intrinsics.from_hfov(hfov_deg, picture.shape[1], picture.shape[0])
