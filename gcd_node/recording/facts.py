"""What a recording says of itself, in the metadata of each of its files: texts by name, as MCAP wants them."""

import platform
import time
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

from gcd_node.config import NodeConfig
from gcd_node.recording.items import IMAGE_TOPIC, NoteItem, SourceFacts
from gcd_node.wire.header import PROTO

WEIGHTS_METADATA = "gcd-node/weights"
"""Name of a metadata record, beside those that a replay reads."""

_PACKAGES = ("gcd-node", "torch", "numpy", "opencv-contrib-python-headless", "mcap")


@dataclass(frozen=True, kw_only=True, slots=True)
class Identity:
    """Which recording, of which life of which node. part: of the recording, counted from 0."""

    recording: str
    part: int
    node_id: str
    boot_id: str


def node_facts(identity: Identity, config: NodeConfig) -> dict[str, str]:
    """Who recorded what, with which settings and versions. input_topic: left out if inputs are not recorded."""
    record = config.record
    facts = {
        "format": "1",
        "recording": identity.recording,
        "part": str(identity.part),
        "node_id": identity.node_id,
        "boot_id": identity.boot_id,
        "proto": PROTO,
        "begun": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "what": ",".join(record.what),
        "notes": record.notes,
        "python": platform.python_version(),
    }
    if "inputs" in record.what:
        facts |= {"input_topic": IMAGE_TOPIC, "input_encoding": record.input_encoding}
    return facts | {f"version/{name}": _version(name) for name in _PACKAGES}


def weights_facts(meta: NoteItem) -> dict[str, str] | None:
    """The weights, as a metadata note names them, and the digest of what is drawn with them; None if it does not."""
    weights = meta.fields.get("weights")
    if not isinstance(weights, Mapping):
        return None
    return {key: str(value) for key, value in weights.items()} | {"cfg_digest": str(meta.fields.get("cfg_digest"))}


def source_facts(source: SourceFacts) -> dict[str, str]:
    """The source, as far as its pictures do not say it. calibrated: whether camera_info holds a lens."""
    info = source.info
    facts = {
        "kind": info.kind,
        "id": info.id,
        "width": str(info.width),
        "height": str(info.height),
        "fps_nominal": repr(info.fps_nominal),
        "clock": info.clock,
        "stamp_uncertainty_us": str(info.stamp_uncertainty_us),
        "calibrated": "no" if source.lens is None else "yes",
    }
    if info.hfov_deg is not None:
        facts["hfov_deg"] = repr(info.hfov_deg)
    return facts if info.codec is None else {**facts, "codec": info.codec}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
