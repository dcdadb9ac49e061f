"""What the headers of messages are made of: numbers with their limits, and records (docs/protocol.md, section 4)."""

from typing import Annotated, TypeAlias

import msgspec
from msgspec import Meta

LARGEST_INTEGER = 2**53 - 1  # larger JSON integers change silently in readers that hold numbers as doubles

Whole: TypeAlias = Annotated[int, Meta(ge=-LARGEST_INTEGER, le=LARGEST_INTEGER)]
Number: TypeAlias = Annotated[float, Meta(ge=-LARGEST_INTEGER, le=LARGEST_INTEGER)]
Byte: TypeAlias = Annotated[int, Meta(ge=0, le=255)]
Nanosec: TypeAlias = Annotated[int, Meta(ge=0, lt=1_000_000_000)]
Colour: TypeAlias = Annotated[tuple[Byte, ...], Meta(min_length=3, max_length=3)]


class ClientError(Exception):
    """Root of this package's errors. exit_code: for command lines, as in sysexits."""

    exit_code = 70


class MessageError(ClientError):
    """Bytes that are not a valid message of this protocol."""

    exit_code = 65


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """A header, or a part of one. Text is printable."""

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            value = getattr(self, name)
            for text in value if isinstance(value, tuple) else (value,):
                if isinstance(text, str) and not text.isprintable():
                    raise MessageError(f"{name} must be printable text, got {text!a:.60}")


class SourceRecord(Record, frozen=True, kw_only=True):
    """The source of the input frames. seq: its own frame numbers, gaps included, one for each entry of t_capture.
    dropped: frames lost so far. fps_in, fps_cond: of the source, and as the model was told. resize: how frames were
    resized. epoch: rises when the source was lost and came back, or its clock or format jumped."""

    kind: str
    id: str
    seq: tuple[Whole, ...]
    dropped: Whole
    fps_in: Number
    fps_cond: Number
    resize: str
    epoch: Whole = 0


class PoseDelta(Record, frozen=True, kw_only=True):
    """Destination minus source on the sphere; degrees, and r in `pose_units`."""

    az_deg: Number
    el_deg: Number
    r: Number


class SourcePoseRecord(Record, frozen=True, kw_only=True):
    """Pose of the source camera; assumed: not measured."""

    el_deg: Number
    r: Number
    assumed: bool


class QualityRecord(Record, frozen=True, kw_only=True, omit_defaults=True):
    """nan_frames: frames with non-finite values. ood: what is outside the trained domain: "fps", "hfov", "exposure",
    "static", "world". ood_score: unlikeness to the training, 0 to 1; None: the model does not estimate it.
    steps, seed: of the sampler."""

    nan_frames: Whole
    ood: tuple[str, ...]
    steps: Whole
    seed: Whole
    ood_score: Number | None = None


class ModelRecord(Record, frozen=True, kw_only=True):
    """The model that drew the pixels. sha256_12: first 12 hex digits of the weights' SHA-256."""

    name: str
    family: str
    sha256_12: str
    precision: str
    device: str


class ClassRecord(Record, frozen=True, kw_only=True):
    """A class of a class map: its number in the pixels, a name, an RGB colour for display."""

    id: Byte
    name: str
    colour: Colour
