"""What the JSON messages of a recording hold, as JSON schemas: for recordings with `notes = "json"`."""

import functools
import json
import types
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, Literal, TypeAlias, Union, get_args, get_origin, get_type_hints

from gcd_node.recording.schemas import Schema

NoteKind: TypeAlias = Literal["status", "event", "meta", "command"]

_TEXT, _INTEGER, _NUMBER = {"type": "string"}, {"type": "integer"}, {"type": "number"}
_SCALARS: dict[Any, dict[str, Any]] = {str: _TEXT, int: _INTEGER, float: _NUMBER, bool: {"type": "boolean"}}
_PAIR = {"type": "array", "items": _INTEGER}
_ORIGIN: dict[str, Any] = {"proto": _TEXT, "node_id": _TEXT, "boot_id": _TEXT, "t_publish": _PAIR}
_NOTES: dict[NoteKind, dict[str, Any]] = {
    "status": {**_ORIGIN, "state": _TEXT, "level": _INTEGER, "ready": {"type": "boolean"}, "heartbeat_seq": _INTEGER},
    "event": {**_ORIGIN, "code": _TEXT, "level": _INTEGER, "message": _TEXT},
    "meta": {**_ORIGIN, "fps": _NUMBER, "cfg_digest": _TEXT},
    "command": {"verb": _TEXT, "client": _TEXT, "role": _TEXT, "code": _TEXT, "message": _TEXT, "state": _TEXT},
}


@functools.cache
def note_schema(kind: NoteKind) -> Schema:
    """Of a note or a command: what every one of the kind has. They may hold more."""
    return _schema(f"gcd.{kind.capitalize()}", {"type": "object", "properties": _NOTES[kind]})


@functools.cache
def record_schema(kind: type) -> Schema:
    """Of a record as wire.record_json writes it."""
    return _schema(f"gcd.{kind.__name__}", _object(kind))


def _schema(name: str, description: dict[str, Any]) -> Schema:
    text = json.dumps({"$schema": "https://json-schema.org/draft/2020-12/schema", "title": name, **description})
    return Schema(name=name, encoding="jsonschema", text=text)


def _object(kind: type) -> dict[str, Any]:
    hints = get_type_hints(kind, include_extras=True)
    named = {entry.metadata.get("wire", entry.name): _value(hints[entry.name]) for entry in fields(kind)}
    return {"type": "object", "properties": {name: value for name, value in named.items() if value is not None}}


def _value(kind: Any) -> dict[str, Any] | None:
    """None for lists of lists: viewers that read a schema as a message definition know none, and may refuse it all."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return _value(arguments[0])
    if origin is Annotated:
        return _PAIR  # a time
    if origin is Literal:
        return _TEXT
    if origin is tuple:
        item = _value(arguments[0])
        return None if item is None or item["type"] == "array" else {"type": "array", "items": item}
    return _object(kind) if is_dataclass(kind) else _SCALARS[kind]  # pyright: ignore[reportArgumentType]  a class
