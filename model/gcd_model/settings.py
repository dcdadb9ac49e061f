"""Mistakes in settings files, explained: which key is unknown and which one was meant, or which values there are."""

import difflib
import re
from typing import Literal, get_args, get_origin

import msgspec

_NO_CHOICE = re.compile(r"Invalid enum value (.*) - at `\$?\.?([^`]*)`")
_UNKNOWN = re.compile(r"unknown field `([^`]+)`(?: - at `\$?\.?([^`]*)`)?")


def explain_settings_error(message: str, root: type[msgspec.Struct]) -> str:
    """msgspec's message in a reader's words; for an unknown key, the nearest known one of the same table; for a value
    that is none of several, those.

    Args:
        message: of a msgspec.ValidationError.
        root: what the whole file was to become.
    """
    no_choice = _NO_CHOICE.search(message)
    if no_choice is not None and (choices := _choices_at(no_choice.group(2), root)):
        return f"`{no_choice.group(2)}` must be {', '.join(choices[:-1])} or {choices[-1]}, got {no_choice.group(1)}"
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


def _choices_at(place: str, root: type[msgspec.Struct]) -> list[str]:
    """What a field takes whose values are listed, as `view[...].kind`; none if that is not found."""
    *parts, name = place.replace("[...]", "").split(".")
    try:
        for part in parts:
            root = _struct_of_field(root, part)
        kind = next(field.type for field in msgspec.structs.fields(root) if field.encode_name == name)
    except StopIteration:  # in one of several tables
        return []
    return [str(value) for each in _types_in(kind) if get_origin(each) is Literal for value in get_args(each)]


def _struct_of_field(struct: type[msgspec.Struct], name: str) -> type[msgspec.Struct]:
    kind = next(field.type for field in msgspec.structs.fields(struct) if field.name == name)
    return next(each for each in _types_in(kind) if isinstance(each, type) and issubclass(each, msgspec.Struct))


def _types_in(kind: object) -> list[object]:
    """A type and all that it is made of: what may be None, what a dict holds."""
    return [kind, *(inner for part in getattr(kind, "__args__", ()) for inner in _types_in(part))]
