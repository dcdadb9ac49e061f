"""Changes to a launch file from the command line, such as `--set model.steps=4`, and keys that are no more."""

from collections.abc import Sequence
from typing import TypeAlias, cast

from gcd_node.errors import ConfigError

Table: TypeAlias = dict[str, object]
"""A TOML table: keys to plain values, lists and tables."""

_REMOVED = {
    "view.*.source_from_view": 'say kind = "pose" and pose = the same numbers',
    "record.notes": "headers, events, status and commands are always JSON in std_msgs/String, which ROS 2 can play",
}


def refuse_removed(table: Table, name: str) -> None:
    """Raise ConfigError if a launch file, `name`, states a key of former versions; it says what takes its place."""
    for removed, instead in _REMOVED.items():
        if _states(table, removed.split(".")):
            raise ConfigError(f"{name}: there is no {removed} any more: {instead}. Leave it out")


def _states(table: object, path: list[str]) -> bool:
    """Whether a table has a key at this path; * stands for any."""
    if not isinstance(table, dict) or not path:
        return not path
    inner = cast("Table", table)
    keys = list(inner) if path[0] == "*" else [key for key in path[:1] if key in inner]
    return any(_states(inner[key], path[1:]) for key in keys)


def with_changes(table: Table, changes: Sequence[str]) -> Table:
    """A launch file's content with changes such as `model.steps=4`, in their order; the original stays.

    A value is read as TOML, so numbers, true and "quoted text" are what they look like; what is no TOML is text.
    Raises:
        ConfigError: not of the form KEY=VALUE, or a key goes through something that is no section.
    """
    changed = _copied(table)
    for change in changes:
        key, equals, text = change.partition("=")
        parts = [part.strip() for part in key.split(".")]
        if not equals or not all(parts):
            raise ConfigError(f"a change is SECTION.KEY=VALUE, such as model.steps=4, got {change!r}")
        _put(changed, parts, _value(text.strip()), change)
    return changed


def _copied(table: Table) -> Table:
    return {key: _copied(value) if isinstance(value, dict) else value for key, value in table.items()}


def _put(table: Table, parts: list[str], value: object, change: str) -> None:
    *sections, key = parts
    for section in sections:
        inner = table.setdefault(section, {})
        if not isinstance(inner, dict):
            raise ConfigError(f"{change!r}: {section} is no section")
        table = inner
    table[key] = value


def _value(text: str) -> object:
    from gcd_model import FileError, decode_toml  # only now: it brings torch

    try:
        return decode_toml(f"value = {text}")["value"]
    except (FileError, KeyError):
        return text
