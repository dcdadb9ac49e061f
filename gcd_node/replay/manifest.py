"""What a run states of itself: where it came from, and window by window what came out (manifest.json)."""

from typing import Annotated, Any, Literal, TypeAlias

import msgspec
from msgspec import Meta

from gcd_node.config import Count, ViewId
from gcd_node.errors import DamagedRunError

FORMAT = "gcd-run/1"
"""Of the folder and its manifest; another number is another layout."""

MAX_WINDOW = 2**28
"""Bytes of the pixels of a view's window, at most; those of the largest model here are 44 million."""

Digest: TypeAlias = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}$(?!\n)")]
"""SHA-256, 64 hex digits."""

MapKind: TypeAlias = Literal["vis", "depth"]
"""Kinds of maps that a run keeps beside pictures and class maps."""

Stamp: TypeAlias = tuple[int, Annotated[int, Meta(ge=0, lt=1_000_000_000)]]
"""[sec, nanosec]: one number of nanoseconds would be changed by readers that hold numbers as doubles."""

_SECOND_NS = 1_000_000_000


class WeightsEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What drew the pixels. sha256_12: as in the header of a view; of files above 512 MiB it is taken from samples."""

    name: str
    family: str
    sha256_12: str
    precision: str
    trained: bool


class SourceEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What was replayed.

    id: a short name. sha256: of the file, or of the names and contents of a folder; None for a drawn drive, which its
    settings name. width, height, fps, codec: as the source states them. calibration_sha256: of the calibration file.
    """

    kind: str
    id: str
    width: int
    height: int
    fps: float
    codec: str | None = None
    sha256: Digest | None = None
    calibration_sha256: Digest | None = None


class MachineEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where it ran: the hashes of two runs are only bound to agree if all of this does.

    device: as torch names it. processor: the GPU's or the CPU's name. instructions: of the CPU, as torch uses them.
    threads: of the model on the CPU.
    """

    system: str
    device: str
    processor: str
    instructions: str
    threads: int


class ClassEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a number of the class maps means, and the RGB colour it is shown in."""

    id: Annotated[int, Meta(ge=0, le=255)]
    name: str
    colour: tuple[Annotated[int, Meta(ge=0, le=255)], ...]


class SizeEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Of every view: T frames of H x W pixels."""

    frames: Count
    height: Count
    width: Count

    def __post_init__(self) -> None:
        if 3 * self.frames * self.height * self.width > MAX_WINDOW:
            raise ValueError(
                f"a window of {self.frames} x {self.height} x {self.width} takes more than {MAX_WINDOW} bytes"
            )


class TroubleEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the model could not do: MODEL_NAN, the window is missing; GPU_OOM, less was asked of it from here on."""

    code: str
    window_id: int
    detail: str


class TotalsEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """frames: read. windows: rendered. rejected: what spoilt windows, and how many. nan_windows: missing for that."""

    frames: int
    windows: int
    rejected: dict[str, int]
    nan_windows: int


class ViewEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One view of one window.

    sha256: of its pixels, u8 [T, H, W, 3] RGB, before any JPEG. classes_sha256: of its class map, u8 [T, H, W]; None
    for a model that makes none. maps_sha256: of its visibility, u8 [T, H, W], and of its inverse depth, f16 [T, H, W],
    where it has them. seed, steps: of the sampler. ood: what lay outside the trained domain.
    nan_frames: frames with non-finite values; always 0 of a view that came out.
    """

    view_rev: int
    sha256: Digest
    classes_sha256: Digest | None = None
    maps_sha256: dict[MapKind, Digest] = {}
    seed: int
    steps: int
    ood: tuple[str, ...]
    nan_frames: int

    @property
    def digests(self) -> dict[str, Digest]:
        """Of every map it has, by kind."""
        classes = {} if self.classes_sha256 is None else {"cls": self.classes_sha256}
        return {**classes, **self.maps_sha256}


class WindowEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One window.

    stamps, seqs: of its T frames, as the source gave them; stamps of different epochs cannot be compared.
    input_sha256: of the pictures the model was given, u8 [T, H, W, 3]. render_ms: of all its views together.
    """

    window_id: Annotated[int, Meta(ge=0)]
    epoch: int
    stamps: tuple[Stamp, ...]
    seqs: tuple[int, ...]
    input_sha256: Digest
    render_ms: float
    views: Annotated[dict[ViewId, ViewEntry], Meta(min_length=1)]

    def __post_init__(self) -> None:
        if len(self.stamps) != len(self.seqs):
            raise ValueError(f"window {self.window_id} has {len(self.stamps)} stamps and {len(self.seqs)} seqs")


class Manifest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole run. versions: of the programs that took part. config: TOML, without secrets. cfg_digest: see
    config_digest(). fps: of a window. classes: the ontology of the class maps, empty without. windows: by rising id."""

    format: Literal["gcd-run/1"] = FORMAT
    versions: dict[str, str]
    machine: MachineEntry
    config: str
    cfg_digest: str
    weights: WeightsEntry
    source: SourceEntry
    size: SizeEntry
    fps: float
    classes: tuple[ClassEntry, ...]
    totals: TotalsEntry
    troubles: tuple[TroubleEntry, ...]
    windows: Annotated[tuple[WindowEntry, ...], Meta(min_length=1)]

    def __post_init__(self) -> None:
        ids = [window.window_id for window in self.windows]
        if ids != sorted(set(ids)):
            raise ValueError("the window_id of each window must be higher than the one before")
        wrong = [window.window_id for window in self.windows if len(window.stamps) != self.size.frames]
        if wrong:
            raise ValueError(f"window {wrong[0]} must have {self.size.frames} stamps")

    @property
    def views(self) -> tuple[str, ...]:
        """Ids of all views, in the order they first occur."""
        return tuple(dict.fromkeys(view_id for window in self.windows for view_id in window.views))


def to_stamp(stamp_ns: int) -> Stamp:
    """Nanoseconds as [sec, nanosec]."""
    return divmod(stamp_ns, _SECOND_NS)


def encode_manifest(manifest: Manifest) -> bytes:
    """JSON with one line for each window, so that two manifests can be read side by side in a code review."""
    table: dict[str, Any] = msgspec.to_builtins(manifest)
    windows = [msgspec.json.encode(window).decode() for window in table.pop("windows")]
    head = msgspec.json.format(msgspec.json.encode(table), indent=2).decode().removesuffix("\n}")
    lines = ",\n    ".join(windows)
    return f'{head},\n  "windows": [\n    {lines}\n  ]\n}}\n'.encode()


def parse_manifest(text: bytes, name: str) -> Manifest:
    """Inverse of encode_manifest(); `name` is for the message.

    Raises:
        DamagedRunError: no JSON, of another format, or not what a manifest holds; names the place.
    """
    try:
        table = msgspec.json.decode(text, type=dict[str, Any])
        if table.get("format") != FORMAT:
            raise DamagedRunError(
                f"{name} must be of format {FORMAT}, got {table.get('format')!r}; replay the recording again with this "
                "version of gcd-node"
            )
        return msgspec.convert(table, Manifest, strict=True)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise DamagedRunError(f"{name} is no manifest of a run: {error}; replay the recording again") from error
