"""Changes to a launch file from the command line, such as `--set model.steps=4`."""

import tomllib
from collections.abc import Sequence
from typing import TypeAlias

from gcd_node.errors import ConfigError

Table: TypeAlias = dict[str, object]
"""A TOML table: keys to plain values, lists and tables."""


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
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (tomllib.TOMLDecodeError, KeyError, RecursionError):
        return text
