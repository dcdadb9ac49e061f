"""What an export says about itself: `manifest.json` in its folder. Pure: bytes in, bytes out."""

import hashlib
from typing import Literal, get_args

import msgspec

from gcd_model.errors import CheckpointError, FileError
from gcd_model.own_format import Card
from gcd_model.small_files import decode_json

MANIFEST = "manifest.json"
"""The file that makes a folder an export."""

FORMAT = "gcd-onnx-1"

GraphName = Literal[
    "image_encoder",
    "crosses",
    "condition_encoder",
    "embeddings",
    "step",
    "decoder",
]
GRAPH_NAMES: tuple[GraphName, ...] = get_args(GraphName)

ExportPrecision = Literal["float32", "float16", "int8"]
"""How weights are stored and computed with; inputs and outputs are float32 in any case."""
EXPORT_PRECISIONS: tuple[ExportPrecision, ...] = get_args(ExportPrecision)


class TensorRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One input or output of a graph. dtype: float32 or bool."""

    name: str
    shape: tuple[int, ...]
    dtype: str


class FileRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One file of the folder. sha256: of its bytes; above 512 MiB of samples of them, see `checkpoints.digest`."""

    name: str
    size: int
    sha256: str


class GraphRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One graph. files: the graph first, then what it keeps its weights in beside it, if any."""

    files: tuple[FileRecord, ...]
    precision: ExportPrecision
    inputs: tuple[TensorRecord, ...]
    outputs: tuple[TensorRecord, ...]


class Manifest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole export.

    card: as in the metadata of our weight files; the config's height and width are the export's.
    source: 12 digits that name the weights it was made from. opset: of the ONNX operators.
    exporter: versions it was made with, for people.
    """

    format: str
    card: dict[str, str]
    source: str
    precision: ExportPrecision
    opset: int
    exporter: str
    graphs: dict[GraphName, GraphRecord]

    @property
    def sha256_12(self) -> str:
        """Twelve digits that name what is computed: of the weights, the precision and the size."""
        config = Card.from_metadata(self.card).config
        told = f"{FORMAT} {self.source} {self.precision} {config.height}x{config.width}"
        return hashlib.sha256(told.encode()).hexdigest()[:12]


def to_bytes(manifest: Manifest) -> bytes:
    """As it is written, for people too."""
    return msgspec.json.format(msgspec.json.encode(manifest), indent=1) + b"\n"


class _Stated(msgspec.Struct, frozen=True):
    format: str | None = None


def from_bytes(text: str | bytes) -> Manifest:
    """Inverse of `to_bytes`. Raises CheckpointError for another format or a damaged text."""
    try:
        found = decode_json(text, _Stated).format
        if found != FORMAT:
            raise CheckpointError(
                f"its {MANIFEST} has format {found!r}, this version reads {FORMAT!r}; export it again"
            )
        return decode_json(text, Manifest)
    except FileError as error:
        raise CheckpointError(f"its {MANIFEST} {error}; export it again") from error
