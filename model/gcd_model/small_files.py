"""Small text files as strangers may write them: read, decoded and shown within limits.

Launch files, recipes, calibrations, manifests, indexes and lists all come through here. Messages begin where a file's
name ends: whoever opens the file puts that before them, and the remedy behind.
"""

import difflib
import math
import re
import tomllib
from collections.abc import Generator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Literal, TypeVar, get_args, get_origin

import msgspec

from gcd_model.errors import FileError

MOST_BYTES = 1 << 20
"""Of a file that people write, unless its door says another number."""
MOST_DEPTH = 64
"""Tables and lists within each other."""

_MOST_TOML = 1 << 18
_MOST_DOTS = 200  # of a name of n parts tomllib keeps all n beginnings: 200 kB of them took 40 GB
_LONG_NUMBER = re.compile(rb"[\s:,\[]-?[0-9]{20}")  # no 64-bit integer has 20 digits
_DIGITS = bytes.maketrans(b"123456789", b"0" * 9)
_NUL = rb"\u0000"
_MOST_SHOWN = 300

Kind = TypeVar("Kind")


def read_small(path: str | PathLike[str], most: int = MOST_BYTES) -> str:
    """The text of a regular file of at most so many bytes.

    Raises: FileError if it is missing, a folder, pipe or device, larger, or not UTF-8.
    """
    try:
        path = Path(path)
        if path.exists() and not path.is_file():
            raise FileError("is no regular file")
        with path.open("rb") as file:
            content = file.read(most + 1)
        if len(content) > most:
            raise FileError(f"is larger than {most} bytes: it is something else")
        return content.decode()
    except FileError:
        raise
    except UnicodeDecodeError as error:
        raise FileError(f"is not UTF-8 text: byte {error.start} cannot be") from error
    except (OSError, ValueError) as error:  # ValueError: no file's name
        raise FileError(f"cannot be read: {getattr(error, 'strerror', None) or error}") from error


def read_json(path: str | PathLike[str], kind: type[Kind], most: int = MOST_BYTES) -> Kind:
    """What a JSON file holds. Raises FileError as `read_small` and `decode_json`."""
    return decode_json(read_small(path, most), kind)


def decode_json(text: str | bytes, kind: type[Kind]) -> Kind:
    """JSON as values of a type.

    Raises: FileError if it is not UTF-8, no JSON (NaN is none), nested deeper than Python goes, holds an integer beyond
        64 bits or a NUL character, or is not of that type.
    """
    with _faults("cannot be used"):
        content = text.encode() if isinstance(text, str) else text
        if b"0" * 20 in content.translate(_DIGITS) and _LONG_NUMBER.search(content):
            raise FileError("holds an integer of 20 digits or more")
        if _NUL in content:
            raise FileError("holds a NUL character")
        return msgspec.json.decode(content, type=kind)


def decode_toml(text: str | bytes) -> dict[str, object]:
    """A TOML table, as plain values.

    Raises: FileError if it is not UTF-8, no TOML, larger than any that people write, nested deeper than MOST_DEPTH, or
        holds an integer beyond 64 bits, NaN, infinity or a NUL character.
    """
    with _faults("is not valid TOML"):
        if len(text) > _MOST_TOML:
            raise FileError(f"is larger than {_MOST_TOML} bytes: it is something else")
        text = text if isinstance(text, str) else text.decode()
        if any(line.count(".") > _MOST_DOTS for line in text.split("\n")):
            raise FileError(f"has a line with more than {_MOST_DOTS} dots")
        table = tomllib.loads(text)
    _check_plain(table)
    return table


@contextmanager
def _faults(otherwise: str) -> Generator[None]:
    """What reading text raises, as FileError. otherwise: begins its message for what is neither text nor too deep."""
    try:
        yield
    except FileError:
        raise
    except RecursionError as error:
        raise FileError("is nested too deep") from error
    except UnicodeError as error:
        raise FileError("is not UTF-8 text") from error
    except ValueError as error:
        raise FileError(f"{otherwise}: {printable(error)}") from error


def printable(text: object, most: int = _MOST_SHOWN) -> str:
    """Text as a terminal may show it: control characters escaped, what is very long cut in its middle."""
    whole = str(text)
    needed = whole if len(whole) <= 2 * most else whole[:most] + whole[-most:]
    shown = "".join(each if each.isprintable() else ascii(each)[1:-1] for each in needed)
    return shown if len(shown) <= most else f"{shown[: most - most // 3]}…{shown[-(most // 3) :]}"


def _check_plain(table: dict[str, object]) -> None:
    """Raises FileError as `decode_toml` says."""
    left: list[tuple[object, int]] = [(table, 0)]
    while left:
        value, depth = left.pop()
        match value:
            case dict():
                left += [(inner, depth + 1) for item in value.items() for inner in item]
            case list():
                left += [(inner, depth + 1) for inner in value]
            case str() if "\0" in value:
                raise FileError("holds a NUL character")
            case int() if not -(2**63) <= value < 2**63:
                raise FileError("holds an integer beyond 64 bits")
            case float() if not math.isfinite(value):
                raise FileError(f"holds the number {value}; numbers are finite")
            case _:
                pass
        if depth > MOST_DEPTH:
            raise FileError("is nested too deep")


# --- mistakes in settings files, explained ---------------------------------------------------------------------------


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
    for part in filter(None, place.replace("[...]", "").split(".")):
        root = _struct_of_field(root, part)
    known = list(root.__struct_fields__)
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    where = f" in [{place.replace('[...]', '.*')}]" if place else ""
    hint = f"did you mean `{near[0]}`?" if near else f"known are {', '.join(known)}"
    return f"unknown key `{key}`{where}; {hint}"


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
