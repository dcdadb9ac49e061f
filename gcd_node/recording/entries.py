"""From what the node handed over to the messages that go into a file. Pure: no file, no clock."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gcd_node.config import NodeConfig
from gcd_node.control.verbs import VERBS
from gcd_node.envelope import ViewMessage, depth_m, images, kind_of
from gcd_node.errors import MessageError
from gcd_node.recording import messages, schemas
from gcd_node.recording.diagnostics import to_diagnostics
from gcd_node.recording.items import (
    COMMAND_TOPIC,
    IMAGE_TOPIC,
    CommandItem,
    InputItem,
    Item,
    NoteItem,
    ViewItem,
    view_topic,
)
from gcd_node.recording.json_schemas import note_schema, record_schema
from gcd_node.recording.messages import FrameTransform, Stamped
from gcd_node.recording.schemas import Schema
from gcd_node.wire.header import ViewHeader
from gcd_node.wire.jpeg import encode_frames
from gcd_node.wire.record_json import dump, to_json

_LONGEST_ARGS = 4096


@dataclass(frozen=True, kw_only=True, slots=True)
class Entry:
    """One message of a recording. log_ns: UTC, where it stands on the time line; publish_ns: when it left the node, of
    inputs when they were captured. sequence: the source's frame number, of headers the window's, else 0."""

    topic: str
    schema: Schema
    data: bytes
    log_ns: int
    publish_ns: int
    sequence: int = 0


class Translator:
    """Turns items into entries, as a launch file wants them."""

    def __init__(self, config: NodeConfig) -> None:
        self._record = config.record
        self._stride = config.window.stride
        self._paced = config.source.pace == "realtime"

    def entries(self, item: Item) -> list[Entry]:
        """Everything an item comes to; all of it goes into one file. Raises MessageError: it cannot be written."""
        match item:
            case InputItem():
                return self._input(item)
            case ViewItem():
                return list(self._view(item.message))
            case NoteItem():
                return self._note(item)
            case CommandItem():
                return self._command(item)
            case _:
                return []

    def _input(self, item: InputItem) -> list[Entry]:
        frame, info = item.frame, item.source.info
        head = Stamped(stamp_ns=item.stamp_ns, frame_id=f"{info.kind}_optical")
        if self._record.input_encoding == "raw":
            schema, data = schemas.IMAGE, messages.image(head, frame.image)
        else:
            coded, _ = encode_frames(frame.image[None], self._record.jpeg_quality)
            schema, data = schemas.COMPRESSED_IMAGE, messages.compressed_image(head, coded)
        camera = messages.source_camera(head, frame.size, item.source.lens)
        pairs = ((IMAGE_TOPIC, schema, data), ("/src/camera_info", schemas.CAMERA_INFO, camera))
        return [_entry(topic, kind, made, item.log_ns, sequence=frame.seq) for topic, kind, made in pairs]

    def _view(self, message: ViewMessage) -> Iterator[Entry]:
        header, place = message.header, f"/view/{message.header.view_id}"
        kind = kind_of(message.topic)
        if kind == "win":
            yield self._header(f"{place}/header", header)
            yield _entry(f"{place}/age_ms", schemas.FLOAT64, messages.float64(header.age_ms), header.t_publish_ns)
            if moved := _moved(header):
                yield _entry("/tf", schemas.TF_MESSAGE, messages.transforms(moved), header.t_publish_ns)
        elif kind == "std":
            yield self._header(f"{place}/std_header", header)
        size = (header.shape[2], header.shape[1])
        for index, (schema, data) in enumerate(self._pictures(message)):
            yield self._of_frame(header, index, view_topic(message), schema, data)
            if kind == "win" and header.intrinsics is not None:
                camera = messages.view_camera(_head(header, index), size, header.intrinsics)
                yield self._of_frame(header, index, f"{place}/camera_info", schemas.CAMERA_INFO, camera)

    def _pictures(self, message: ViewMessage) -> Iterator[tuple[Schema, bytes]]:
        header = message.header
        if header.encoding not in ("rgb8", "jpeg"):
            is_depth = header.encoding == "invdepth16"
            for index, pixels in enumerate(depth_m(message)[..., None] if is_depth else images(message)):
                yield schemas.IMAGE, messages.image(_head(header, index), pixels)
            return
        payload, offsets = message.payload, header.offsets
        if offsets is None:
            payload, offsets = encode_frames(images(message), self._record.jpeg_quality)
        for index in range(header.shape[0]):
            coded = memoryview(payload)[offsets[index] : offsets[index + 1]]
            yield schemas.COMPRESSED_IMAGE, messages.compressed_image(_head(header, index), coded)

    def _of_frame(self, header: ViewHeader, index: int, topic: str, schema: Schema, data: bytes) -> Entry:
        """A window leaves the node as one; on the time line its frames follow each other as they were taken, from then
        on, and end before the next window begins. In lockstep there is no rhythm to keep."""
        frames, sequences = header.shape[0], header.src.seq
        step_s = (self._stride or frames) / (frames * header.src.fps_cond) if self._paced else 0.0
        return Entry(
            topic=topic,
            schema=schema,
            data=data,
            log_ns=header.t_publish_ns + round(index * step_s * 1e9),
            publish_ns=header.t_publish_ns,
            sequence=sequences[min(index, len(sequences) - 1)],
        )

    def _header(self, topic: str, header: ViewHeader) -> Entry:
        text, schema = dump(to_json(header)), record_schema(ViewHeader)
        return self._json(topic, schema, text, header.t_publish_ns, header.t_publish_ns, header.window_id)

    def _note(self, item: NoteItem) -> list[Entry]:
        sent_ns = item.header.t_publish_ns
        text = dump({**item.fields, **to_json(item.header)})
        said = self._json(item.topic, note_schema(item.kind), text, item.log_ns, sent_ns)
        if item.kind != "status":
            return [said]
        told = messages.diagnostics(sent_ns, to_diagnostics(item.header.node_id, item.fields))
        return [said, _entry("/diagnostics", schemas.DIAGNOSTIC_ARRAY, told, sent_ns)]

    def _command(self, item: CommandItem) -> list[Entry]:
        """Questions that were answered change nothing and are left out."""
        request, reply = _object(item.request), _object(item.reply)
        verb = VERBS.get(str(request.get("verb")))
        if reply.get("ok") is True and verb is not None and verb.role == "viewer":
            return []
        told = {key: reply.get(key) for key in ("id", "code", "message", "state")}
        told |= {"client": item.client.name, "role": item.client.role, "verb": str(request.get("verb", ""))[:64]}
        told |= {key: request[key] for key in ("dry_run", "if_view_rev") if isinstance(request.get(key), bool | int)}
        args = json.dumps(request.get("args", {}))
        told |= {"args": request.get("args", {})} if len(args) <= _LONGEST_ARGS else {"args_cut": args[:_LONGEST_ARGS]}
        return [self._json(COMMAND_TOPIC, note_schema("command"), _plain(told), item.log_ns, item.log_ns)]

    def _json(self, topic: str, schema: Schema, text: bytes, log_ns: int, publish_ns: int, sequence: int = 0) -> Entry:
        if self._record.notes == "ros2":
            schema, text = schemas.STRING, messages.string(text.decode())
        return Entry(
            topic=topic, schema=schema, data=text, log_ns=log_ns, publish_ns=publish_ns, sequence=max(0, sequence)
        )


def _entry(topic: str, schema: Schema, data: bytes, at_ns: int, *, sequence: int = 0) -> Entry:
    return Entry(topic=topic, schema=schema, data=data, log_ns=at_ns, publish_ns=at_ns, sequence=sequence)


def _head(header: ViewHeader, index: int) -> Stamped:
    stamps = header.t_capture_ns
    return Stamped(stamp_ns=stamps[min(index, len(stamps) - 1)], frame_id=header.frame_id)


def _moved(header: ViewHeader) -> Sequence[FrameTransform]:
    """The virtual camera at each frame; nothing where nobody knows, or the scene's unit is no metre."""
    if header.source_from_view is None or header.pose_units != "m":
        return ()
    return [
        FrameTransform(
            stamp_ns=_head(header, index).stamp_ns,
            parent=header.src_frame_id,
            child=header.frame_id,
            parent_from_child=_matrix(numbers),
        )
        for index, numbers in enumerate(header.source_from_view)
    ]


def _matrix(numbers: Sequence[float]) -> NDArray[np.float64]:
    return np.asarray(numbers, np.float64).reshape(4, 4)


def _object(text: bytes) -> Mapping[str, Any]:
    """What a client sent, if it is a JSON object."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _plain(told: Mapping[str, Any]) -> bytes:
    try:
        return dump(told)
    except MessageError:  # what a client sends may be JSON that nobody else reads, such as NaN
        return dump({key: ascii(value) for key, value in told.items()})
