"""Frozen records as plain JSON and back, every value checked on both ways (wire protocol, section 4).

Standard library only, Python 3.10 syntax: planners import this. A record is a dataclass of str, bool, int, float,
Literal, StampNs, tuples of one type, other records, and any of these or None. A time is an int of nanoseconds in
Python and a `[sec, nanosec]` pair in JSON; a field that is None is left out there.
"""

import functools
import json
import math
import types
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from typing import Annotated, Any, Literal, TypeAlias, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from gcd_node.errors import MessageError

LARGEST_INTEGER = 2**53 - 1
"""Larger JSON integers change silently in readers that hold numbers as doubles."""

StampNs: TypeAlias = Annotated[int, "nanoseconds; a [sec, nanosec] pair on the wire"]

_SECOND_NS = 1_000_000_000
_WIRE_NAME = "wire"
_Convert: TypeAlias = Callable[[Any, str], Any]  # a value, and its place for an error message
Record = TypeVar("Record")


def wire(name: str) -> Mapping[str, str]:
    """Metadata of a field whose JSON name differs from its Python name."""
    return types.MappingProxyType({_WIRE_NAME: name})


def short(value: object) -> str:
    """A foreign value for an error message: ASCII, at most 60 characters."""
    text = ascii(value)
    return text if len(text) <= 60 else text[:57] + "..."


def to_json(record: object) -> dict[str, Any]:
    """A record as what `json.dumps` takes, by wire names; None is left out.

    Raises:
        MessageError: a value that from_json() would refuse; names the field.
    """
    values = ((item, getattr(record, item.name)) for item in _described(type(record)))
    return {item.wire: item.write(value, item.wire) for item, value in values if value is not None}


def from_json(kind: type[Record], value: Mapping[str, Any], place: str = "header") -> Record:
    """Build the record `kind` from decoded JSON; unknown keys are ignored.

    Raises:
        MessageError: a key is missing, or a value is not of its type; names the place.
    """
    arguments: dict[str, Any] = {}
    for item in _described(kind):
        if item.wire in value:
            arguments[item.name] = item.read(value[item.wire], f"{place}.{item.wire}")
        elif item.required:
            raise MessageError(f"{place} lacks {item.wire!r}")
    return kind(**arguments)


def dump(value: Mapping[str, Any]) -> bytes:
    """Compact JSON in UTF-8. Raises MessageError for what JSON cannot say: NaN, infinity, foreign types."""
    try:
        return json.dumps(value, allow_nan=False, separators=(",", ":"), ensure_ascii=False).encode()
    except (ValueError, TypeError, RecursionError) as error:
        raise MessageError(f"a header must be plain JSON with finite numbers: {error}") from error


def parse(text: bytes) -> dict[str, Any]:
    """One JSON object. Raises MessageError for anything else."""
    try:
        value = json.loads(text.decode("utf-8"), parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise MessageError(f"the header must be one JSON object in UTF-8: {type(error).__name__}: {error}") from error
    if not isinstance(value, dict):
        raise MessageError(f"the header must be a JSON object, got {short(value)}")
    return value


@dataclass(frozen=True, kw_only=True, slots=True)
class _Item:
    """One field of a record: attribute name, wire name, how it is converted, and whether it must be there."""

    name: str
    wire: str
    write: _Convert
    read: _Convert
    required: bool


# What a type asks for is worked out once, not with every value: a header has hundreds of numbers.


@functools.cache
def _described(kind: type) -> tuple[_Item, ...]:
    hints = get_type_hints(kind, include_extras=True)
    return tuple(_item(entry, hints[entry.name]) for entry in fields(kind))


def _item(entry: "Field[Any]", hint: Any) -> _Item:
    required = entry.default is MISSING and entry.default_factory is MISSING
    wired = entry.metadata.get(_WIRE_NAME, entry.name)
    return _Item(name=entry.name, wire=wired, write=_writer(hint), read=_reader(hint), required=required)


def _writer(kind: Any) -> _Convert:
    """From a value to JSON, checked."""
    if get_origin(kind) in (Union, types.UnionType):
        return _writer(get_args(kind)[0])  # None never gets here
    if get_origin(kind) is Annotated:
        return lambda value, place: list(divmod(_read_stamp_ns(value, place), _SECOND_NS))
    read = _reader(kind)
    if is_dataclass(kind):
        return lambda value, place: to_json(value) if is_dataclass(value) else read(value, place)
    if get_origin(kind) is tuple:
        write_each = _writer(get_args(kind)[0])
        whole = _finite if get_args(kind)[0] is float else _never
        return lambda value, place: _write_tuple(value, place, whole, write_each)
    return read


def _write_tuple(value: Any, place: str, whole: Callable[[Any], bool], write_each: _Convert) -> list[Any]:
    if not isinstance(value, tuple):
        raise MessageError(f"{place} must be a tuple, got {short(value)}")
    return list(value) if whole(value) else [write_each(each, place) for each in value]


def _read_stamp_ns(value: Any, place: str) -> int:
    if isinstance(value, int) and abs(value) // _SECOND_NS <= LARGEST_INTEGER:
        return value
    raise MessageError(f"{place} must be an int of nanoseconds, got {short(value)}")


def _reader(kind: Any) -> _Convert:
    """From JSON to a value, checked."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        read_some = _reader(arguments[0])
        return lambda value, place: None if value is None else read_some(value, place)
    if origin is Annotated:
        return _read_stamp
    if origin is Literal:
        return lambda value, place: _read_choice(arguments, value, place)
    if origin is tuple:
        read_each, whole = _reader(arguments[0]), _finite if arguments[0] is float else _never
        return lambda value, place: _read_tuple(_read_list(value, place), place, whole, read_each)
    if is_dataclass(kind):
        record = cast(type[Any], kind)
        return lambda value, place: from_json(record, _read_object(value, place), place)
    return lambda value, place: _read_scalar(kind, value, place)


def _read_tuple(value: list[Any], place: str, whole: Callable[[Any], bool], read_each: _Convert) -> tuple[Any, ...]:
    return tuple(value) if whole(value) else tuple(read_each(each, f"{place}[{i}]") for i, each in enumerate(value))


def _finite(values: list[Any] | tuple[Any, ...]) -> bool:
    """Whether all are floats that JSON can say, as most lists of numbers are: then none must be looked at alone."""
    return {*map(type, values)} == {float} and all(map(math.isfinite, values))


def _never(_: Any) -> bool:
    return False


def _read_stamp(value: Any, place: str) -> int:
    pair = [_read_scalar(int, each, place) for each in _read_list(value, place)]
    if len(pair) != 2 or not 0 <= pair[1] < _SECOND_NS:
        raise MessageError(f"{place} must be [sec, nanosec], got {short(value)}")
    return pair[0] * _SECOND_NS + pair[1]


def _read_choice(choices: tuple[Any, ...], value: Any, place: str) -> Any:
    if isinstance(value, str) and value in choices:
        return value
    raise MessageError(f"{place} must be one of {', '.join(choices)}, got {short(value)}")


def _read_list(value: Any, place: str) -> list[Any]:
    if isinstance(value, list):
        return value
    raise MessageError(f"{place} must be a list, got {short(value)}")


def _read_object(value: Any, place: str) -> dict[str, Any]:
    if isinstance(value, dict):
        return value
    raise MessageError(f"{place} must be an object, got {short(value)}")


def _read_scalar(kind: type, value: Any, place: str) -> Any:
    if kind is str and isinstance(value, str) and value.isprintable():
        return value
    if kind is bool and isinstance(value, bool):
        return value
    number = isinstance(value, int) and not isinstance(value, bool) and abs(value) <= LARGEST_INTEGER
    if kind is int and number:
        return value
    if kind is float and (number or (isinstance(value, float) and math.isfinite(value))):
        return float(value)
    raise MessageError(f"{place} must be {_NAMES[kind]}, got {short(value)}")


_NAMES = {str: "printable text", bool: "true or false", int: "an integer below 2^53", float: "a finite number"}


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON")
