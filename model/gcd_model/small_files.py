"""Small text files as strangers may write them: read, decoded and shown within limits.

Launch files, recipes, calibrations, manifests, indexes and lists all come through here. Messages begin where a file's
name ends: whoever opens the file puts that before them, and the remedy behind.
"""

import math
import re
import tomllib
from os import PathLike
from pathlib import Path
from typing import TypeVar

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
    try:
        content = text.encode() if isinstance(text, str) else text
        if b"0" * 20 in content.translate(_DIGITS) and _LONG_NUMBER.search(content):
            raise FileError("holds an integer of 20 digits or more")
        if _NUL in content:
            raise FileError("holds a NUL character")
        return msgspec.json.decode(content, type=kind)
    except FileError:
        raise
    except RecursionError as error:
        raise FileError("is nested too deep") from error
    except UnicodeError as error:
        raise FileError("is not UTF-8 text") from error
    except ValueError as error:
        raise FileError(f"cannot be used: {printable(error)}") from error


def decode_toml(text: str | bytes) -> dict[str, object]:
    """A TOML table, as plain values.

    Raises: FileError if it is not UTF-8, no TOML, larger than any that people write, nested deeper than MOST_DEPTH, or
        holds an integer beyond 64 bits, NaN, infinity or a NUL character.
    """
    try:
        if len(text) > _MOST_TOML:
            raise FileError(f"is larger than {_MOST_TOML} bytes: it is something else")
        text = text if isinstance(text, str) else text.decode()
        if any(line.count(".") > _MOST_DOTS for line in text.split("\n")):
            raise FileError(f"has a line with more than {_MOST_DOTS} dots")
        table = tomllib.loads(text)
    except FileError:
        raise
    except RecursionError as error:
        raise FileError("is nested too deep") from error
    except UnicodeError as error:
        raise FileError("is not UTF-8 text") from error
    except ValueError as error:
        raise FileError(f"is not valid TOML: {printable(error)}") from error
    _check_plain(table)
    return table


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
