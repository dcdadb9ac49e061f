"""Recordings that this node made: which topic has the input, and what its pictures do not say of the source."""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from gcd_node.errors import SourceError
from gcd_node.sources.log_patience import LogPatience
from gcd_node.sources.mcap_container import McapContainer, check_mcap

_LOG = logging.getLogger(__name__)

_MOST_RECORDS, _LONGEST_S = 1_000_000, 10.0  # until the first messages of all parts
NODE_METADATA, SOURCE_METADATA = "gcd-node", "gcd-node/source"
"""Names of the metadata records in each of their files."""


@dataclass(frozen=True, kw_only=True, slots=True)
class OwnRecording:
    """What one file of a recording says of all of it.

    name: of the recording; part: which file of it this is. input_topic: None if no inputs were recorded.
    calibrated: whether the lens was known; if not, hfov_deg is what was. stamp_uncertainty_us: of the source's stamps.
    """

    name: str
    part: int
    input_topic: str | None
    calibrated: bool
    hfov_deg: float | None
    stamp_uncertainty_us: int | None


def own_recording(metadata: Mapping[str, Mapping[str, str]]) -> OwnRecording | None:
    """What the metadata of a file says; None if this node did not write it. Numbers that are none are left out."""
    node, source = metadata.get(NODE_METADATA), metadata.get(SOURCE_METADATA, {})
    if node is None or "recording" not in node:
        return None
    hfov_deg, uncertainty_us = _number(source.get("hfov_deg")), _number(source.get("stamp_uncertainty_us"))
    return OwnRecording(
        name=node["recording"],
        part=int(_number(node.get("part")) or 0),
        input_topic=node.get("input_topic"),
        calibrated=source.get("calibrated") == "yes",
        hfov_deg=hfov_deg if hfov_deg is not None and 0 < hfov_deg < 180 else None,
        stamp_uncertainty_us=int(uncertainty_us) if uncertainty_us is not None and uncertainty_us >= 0 else None,
    )


def log_files(path: Path) -> tuple[Path, ...]:
    """The files to play one after another: a log, or every part of the one recording of this node in a folder.

    Raises:
        SourceError: no log, or a folder with something else in it.
    """
    patience = LogPatience(records=_MOST_RECORDS, seconds=_LONGEST_S)
    if not path.is_dir():
        check_mcap(path)
        return (path,)
    parts = {file: _told_by(file, patience) for file in sorted(path.glob("*.mcap")) if _has_something(file)}
    numbered = sorted((own.part, file) for file, own in parts.items() if own is not None)
    names = {own.name for own in parts.values() if own is not None}
    if len(names) != 1 or len(numbered) != len(parts):
        check_mcap(path)  # says what to give instead
    return tuple(file for _, file in numbered)


def _told_by(path: Path, patience: LogPatience) -> OwnRecording | None:
    try:
        container = McapContainer(path, patience)
        next(container.messages(), None)  # metadata comes first
    except SourceError:
        return None
    return own_recording(container.metadata)


def _has_something(path: Path) -> bool:
    """A recorder that was killed may leave a file it had not begun to write."""
    empty = path.is_file() and path.stat().st_size == 0
    if empty:
        _LOG.warning("%s is empty and is left out", path)
    return not empty


def _number(text: str | None) -> float | None:
    try:
        found = float(text or "")
    except ValueError:
        return None
    return found if math.isfinite(found) and abs(found) < 2**53 else None
