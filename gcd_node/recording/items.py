"""What the node hands to a recording: as little as possible, so that handing over costs nothing."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from gcd_node.envelope import NoteTopic, ViewMessage, kind_of
from gcd_node.frame import Frame, SourceInfo
from gcd_node.optics.calibration import LensModel
from gcd_node.security.keys import Client
from gcd_node.wire.header import OriginHeader

IMAGE_TOPIC = "/src/image"
COMMAND_TOPIC = "/gcd/command"


@dataclass(frozen=True, kw_only=True, slots=True)
class SourceFacts:
    """The source from here on. lens: the calibration in use for its pictures, wherever it was stated."""

    info: SourceInfo
    lens: LensModel | None

    @property
    def topic(self) -> str:
        """Where its loss would be counted."""
        return "/src/camera_info"

    @property
    def size(self) -> int:
        """Bytes in the queue, about."""
        return 0


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class InputItem:
    """A frame. stamp_ns: when it was captured, UTC of a live source. log_ns: the same, or of a recording when it was
    played."""

    frame: Frame
    source: SourceFacts
    stamp_ns: int
    log_ns: int

    @property
    def topic(self) -> str:
        """Where its loss is counted."""
        return IMAGE_TOPIC

    @property
    def size(self) -> int:
        """Bytes in the queue."""
        return self.frame.image.nbytes


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ViewItem:
    """A window of a view, its class map, visibility, depth or deviation."""

    message: ViewMessage

    @property
    def topic(self) -> str:
        """Where its loss is counted."""
        return view_topic(self.message)

    @property
    def size(self) -> int:
        """Bytes in the queue."""
        return len(self.message.payload)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class NoteItem:
    """A status, an event or the metadata. log_ns: when it was said, or said again at the head of a file."""

    kind: NoteTopic
    header: OriginHeader
    fields: Mapping[str, Any]
    log_ns: int

    @property
    def topic(self) -> str:
        """Where its loss is counted."""
        return f"/gcd/{self.kind}"

    @property
    def size(self) -> int:
        """Bytes in the queue: it is small, and never refused for its size."""
        return 0


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class CommandItem:
    """A request and its reply as they travelled; client: who asked. log_ns: when it was answered, UTC."""

    request: bytes
    reply: bytes
    client: Client
    log_ns: int

    @property
    def topic(self) -> str:
        """Where its loss is counted."""
        return COMMAND_TOPIC

    @property
    def size(self) -> int:
        """Bytes in the queue."""
        return len(self.request) + len(self.reply)


Item: TypeAlias = SourceFacts | InputItem | ViewItem | NoteItem | CommandItem

_VIEW_NAMES = {"win": "image", "cls": "classes", "std": "std", "vis": "visibility", "depth": "depth"}


def is_recorded(message: ViewMessage) -> bool:
    """Whether a view message has pixels that no other one of its window has."""
    return message.topic.startswith("view/") and kind_of(message.topic) in _VIEW_NAMES


def view_topic(message: ViewMessage) -> str:
    """Where its pixels go."""
    return f"/view/{message.header.view_id}/{_VIEW_NAMES[kind_of(message.topic)]}"
