"""A status note as ROS diagnostics: one line for the node and one for each of its parts."""

from collections.abc import Iterator, Mapping
from typing import Any

from gcd_node.health.report import Level
from gcd_node.recording.messages import DiagnosticStatus

_PARTS = ("source", "window", "model", "publish", "rec", "drops", "stages", "views")
_WORSE: Mapping[str, Mapping[str, Level]] = {
    "source": {"lost": Level.ERROR, "stalled": Level.WARN},
    "model": {"failed": Level.ERROR, "degraded": Level.WARN},
    "rec": {"failed": Level.WARN},
}
"""Levels of a part by its state; the node's own level is said by the note itself."""


def to_diagnostics(node_id: str, fields: Mapping[str, Any]) -> list[DiagnosticStatus]:
    """What the fields of a status note say, values as text. The message of a part is its state, so that it can be
    drawn over time."""
    plain = {key: value for key, value in fields.items() if not isinstance(value, Mapping | list)}
    reasons = ", ".join(map(str, fields.get("reasons", ())))
    node = DiagnosticStatus(
        name=f"{node_id}: node",
        level=Level(int(fields.get("level", 0))),
        message=str(fields.get("state", "")),
        hardware_id=node_id,
        values={**_texts(plain), "reasons": reasons},
    )
    return [node, *(_part(node_id, name, fields[name]) for name in _PARTS if isinstance(fields.get(name), Mapping))]


def _part(node_id: str, name: str, told: Mapping[str, Any]) -> DiagnosticStatus:
    state = str(told.get("state", ""))
    return DiagnosticStatus(
        name=f"{node_id}: {name}",
        level=_WORSE.get(name, {}).get(state, Level.OK),
        message=state,
        hardware_id=node_id,
        values=_texts(told),
    )


def _texts(told: Mapping[str, Any]) -> dict[str, str]:
    return {key: str(value) for key, value in _flat(told, "")}


def _flat(told: Mapping[str, Any], place: str) -> Iterator[tuple[str, object]]:
    for key, value in told.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{place}{key}.")
        else:
            yield f"{place}{key}", value
