"""Windows on their way to a model that computes elsewhere, and views on their way back: bytes apart from sockets.

Each is one message of the wire protocol's envelope: prefix, JSON header, payload. No pickle, no code: sizes follow from
the header, and are checked before anything is made of the bytes.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, TypeAlias, TypeVar

import msgspec
import numpy as np
import torch
from msgspec import Meta
from numpy.typing import NDArray

from gcd_client.images import payload_of
from gcd_client.protocol import MAX_PAYLOAD, MessageError, Part, pack, unpack
from gcd_model import SourceFeatures, Traits, Trajectory, View
from gcd_node.config import Quality, SolverName

_WINDOW, _VIEWS = (name.ljust(32, b"\0") for name in (b"remote/window", b"remote/views"))

Digest: TypeAlias = Annotated[str, Meta(pattern=r"^[0-9a-f]{12}$(?!\n)")]
Stream: TypeAlias = Annotated[str, Meta(pattern=r"^[0-9a-f]{32}$(?!\n)")]
_Size: TypeAlias = Annotated[int, Meta(ge=1, le=1 << 14)]
_Seed: TypeAlias = Annotated[int, Meta(ge=0, lt=1 << 62)]
_Header = TypeVar("_Header", bound=msgspec.Struct)


@dataclass(frozen=True, kw_only=True, slots=True)
class RemoteFeatures(SourceFeatures):
    """Frames as they will be sent. seeds: int64 [T], of the noise on each."""

    seeds: torch.Tensor


class ModelReply(msgspec.Struct, frozen=True, kw_only=True):
    """What a service renders with. card: as our weight files state it. model: names all this but the device; windows
    are sent for it."""

    card: dict[str, str]
    sha256_12: Digest
    precision: str
    device: str
    model: Digest


class Drawing(msgspec.Struct, frozen=True, kw_only=True):
    """What of RenderOptions a service is told."""

    steps: Annotated[int, Meta(ge=1, le=1000)] | None = None
    guidance: tuple[float, float] | None = None
    guidance_interval: tuple[float, float] | None = None
    solver: SolverName | None = None
    quality: Quality = "exact"
    samples: Annotated[int, Meta(ge=1, le=64)] = 1
    seed: _Seed = 0
    motion_bucket: float | None = None


class WindowHeader(msgspec.Struct, frozen=True, kw_only=True):
    """Of a window. Payload: pictures u8 [T, H, W, 3] RGB, poses f64 [V, T, 4, 4], then of the views on a sphere angles
    and radius f64 [T, 3] each, see Trajectory.

    stream, window: come back with the views. model: what the views must be made with, see ModelReply. deadline_ms: from
    arrival.
    shape: T, H, W. seeds: of the noise on each frame, of strength `augmentation`. lens: fx, fy, cx, cy in pixels.
    """

    stream: Stream
    window: Annotated[int, Meta(ge=0, lt=1 << 53)]
    model: Digest
    deadline_ms: Annotated[int, Meta(ge=1, le=30_000)]
    shape: tuple[_Size, _Size, _Size]
    on_sphere: Annotated[tuple[bool, ...], Meta(min_length=1, max_length=64)]
    fps: float
    augmentation: float
    seeds: tuple[_Seed, ...]
    lens: tuple[float, float, float, float] | None
    drawing: Drawing
    proto: Literal["gcd-remote/1"] = "gcd-remote/1"

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Bytes of pictures, poses and angles."""
        frames, height, width = self.shape
        return 3 * frames * height * width, 128 * frames * len(self.on_sphere), 24 * frames * sum(self.on_sphere)

    def views_size(self, *, classes: bool) -> int:
        """Bytes of its views. classes: with class maps."""
        frames, height, width = self.shape
        return len(self.on_sphere) * self.drawing.samples * frames * height * width * (4 if classes else 3)


class ViewsHeader(msgspec.Struct, frozen=True, kw_only=True):
    """Of a window's views. Payload: u8 [V, S, T, 3, H, W], then class ids [V, S, T, H, W] of a model that has some.
    stream, window, model: the window's, and what the views were made with."""

    stream: Stream
    window: int
    model: Digest
    proto: Literal["gcd-remote/1"] = "gcd-remote/1"


def model_digest(traits: Traits) -> str:
    """12 hex digits that name a model as it is served: its weights, what they are taken for, and their precision."""
    told = traits.to_metadata(), traits.sha256_12, traits.precision
    return hashlib.sha256(msgspec.json.encode(told, order="deterministic")).hexdigest()[:12]


def window_message(header: WindowHeader, features: RemoteFeatures, paths: Sequence[Trajectory]) -> bytes:
    """A window as it is sent."""
    assert features.video is not None, "encode keeps the pictures"
    pictures = ((features.video + 1) * 127.5).round().to(torch.uint8).permute(0, 2, 3, 1).contiguous()
    poses = [path.source_from_target.numpy().tobytes() for path in paths]
    angles = [path.delta.numpy().tobytes() for path in paths if path.delta is not None]
    return pack(_WINDOW, 0, header.window, msgspec.json.encode(header), payload_of(pictures.numpy()), *poses, *angles)


def read_window(content: Part, traits: Traits) -> tuple[WindowHeader, NDArray[np.uint8], list[Trajectory]]:
    """Inverse of window_message(), on the service's side: pictures [T, H, W, 3] and paths.

    Raises MessageError: damaged, not what this model takes, or more than it may send back. PoseError, ShapeError: no
    camera moves so.
    """
    header, payload = _opened(content, _WINDOW, WindowHeader)
    config = traits.config
    if header.model != model_digest(traits):
        raise MessageError(f"the window is for another model than {traits.name} as it is served now: configure anew")
    if header.shape != (config.frames, config.height, config.width) or len(header.seeds) != config.frames:
        raise MessageError(
            f"{traits.name} takes {config.frames} x {config.height} x {config.width}, got {header.shape}"
        )
    if len(payload) != sum(header.sizes) or header.views_size(classes=bool(traits.classes)) > MAX_PAYLOAD:
        raise MessageError(f"{len(payload)} bytes of {sum(header.sizes)}, or views of more than {MAX_PAYLOAD} bytes")
    ends = np.cumsum(header.sizes)
    pictures = np.frombuffer(payload[: ends[0]], np.uint8).reshape(*header.shape, 3)
    poses = np.frombuffer(payload[ends[0] : ends[1]], np.float64).reshape(-1, config.frames, 4, 4)
    angles = iter(np.frombuffer(payload[ends[1] :], np.float64).reshape(-1, config.frames, 3))
    paths = [
        Trajectory(
            source_from_target=torch.from_numpy(pose.copy()),
            delta=torch.from_numpy(next(angles).copy()) if is_on_sphere else None,
        )
        for pose, is_on_sphere in zip(poses, header.on_sphere, strict=True)
    ]
    return header, pictures, paths


def views_message(header: WindowHeader, views: Sequence[View]) -> bytes:
    """The views of a window as they are sent back, in whole levels."""
    found = ViewsHeader(stream=header.stream, window=header.window, model=header.model)
    rows = [view.samples.numpy() for view in views] + [v.classes.numpy() for v in views if v.classes is not None]
    return pack(_VIEWS, 0, header.window, msgspec.json.encode(found), *map(payload_of, rows))


def read_views(content: Part, asked: WindowHeader, paths: Sequence[Trajectory], traits: Traits) -> list[View]:
    """Inverse of views_message(), on the node's side. Raises MessageError: damaged, or not what was asked for."""
    header, payload = _opened(content, _VIEWS, ViewsHeader)
    if (header.stream, header.window, header.model) != (asked.stream, asked.window, asked.model):
        raise MessageError(f"views of window {asked.window} are due, got window {header.window} of {header.stream}")
    size = asked.views_size(classes=bool(traits.classes))
    if len(payload) != size:
        raise MessageError(f"these views have {size} bytes, got {len(payload)}")
    levels = torch.from_numpy(np.frombuffer(payload, np.uint8).copy())
    frames, height, width = asked.shape
    shape = len(paths), asked.drawing.samples, frames, -1, height, width
    pictures = levels[: asked.views_size(classes=False)].view(shape)
    classes = (
        levels[asked.views_size(classes=False) :].view(shape).squeeze(3) if traits.classes else [None] * len(paths)
    )
    if traits.classes and int(max(each.max() for each in classes if each is not None)) >= len(traits.classes):
        raise MessageError("a class map holds ids that the model does not have")
    given = asked.drawing.motion_bucket
    return [
        View(
            samples=samples,
            latents=samples.new_zeros(*samples.shape[:2], 0, 1, 1),
            trajectory=path,
            motion_bucket=traits.motion_bucket(path) if given is None else given,
            classes=ids,
            uncertainty_scale=traits.uncertainty_scale,
        )
        for samples, ids, path in zip(pictures, classes, paths, strict=True)
    ]


def _opened(content: Part, key: bytes, kind: type[_Header]) -> tuple[_Header, memoryview]:
    found, _, _, text, payload = unpack(content, MAX_PAYLOAD)
    if found != key:
        raise MessageError(f"{key.rstrip(bytes(1)).decode()} is due, got {found!a:.60}")
    try:
        return msgspec.json.decode(text, type=kind), payload
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MessageError(f"its header: {str(error)!a:.200}") from error
