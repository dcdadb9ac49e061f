"""Mistakes in settings files, explained: which key is unknown, and which one was meant."""

import difflib
import re

import msgspec

_UNKNOWN = re.compile(r"unknown field `([^`]+)`(?: - at `\$?\.?([^`]*)`)?")


def explain_settings_error(message: str, root: type[msgspec.Struct]) -> str:
    """msgspec's message in a reader's words; for an unknown key, the nearest known one of the same table.

    Args:
        message: of a msgspec.ValidationError.
        root: what the whole file was to become.
    """
    unknown = _UNKNOWN.search(message)
    if unknown is None:
        return message.replace("`$.", "`")
    key, place = unknown.group(1), unknown.group(2) or ""
    known = _keys_at(place, root)
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    where = f" in [{place.replace('[...]', '.*')}]" if place else ""
    hint = f"did you mean `{near[0]}`?" if near else f"known are {', '.join(known)}"
    return f"unknown key `{key}`{where}; {hint}"


def _keys_at(place: str, root: type[msgspec.Struct]) -> list[str]:
    """Keys of the table at a place such as `source.pose` or `view[...]`."""
    struct = root
    for part in filter(None, place.replace("[...]", "").split(".")):
        struct = _struct_of_field(struct, part)
    return list(struct.__struct_fields__)


def _struct_of_field(struct: type[msgspec.Struct], name: str) -> type[msgspec.Struct]:
    kind = next(field.type for field in msgspec.structs.fields(struct) if field.name == name)
    return next(each for each in _types_in(kind) if isinstance(each, type) and issubclass(each, msgspec.Struct))


def _types_in(kind: object) -> list[object]:
    """A type and all that it is made of: what may be None, what a dict holds."""
    return [kind, *(inner for part in getattr(kind, "__args__", ()) for inner in _types_in(part))]
