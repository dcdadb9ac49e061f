"""A configuration as text: TOML, without its secrets."""

import re
from collections.abc import Mapping
from pathlib import PurePath
from urllib.parse import urlsplit, urlunsplit

import msgspec

from gcd_node.config import NodeConfig
from gcd_node.config_changes import Table

_BARE = re.compile(r"[A-Za-z0-9_-]+")
_HIDDEN = "***"


def to_toml(config: NodeConfig) -> str:
    """The whole configuration, defaults included, as a launch file; passwords are hidden."""
    lines: list[str] = []
    _write_table(without_secrets(config), "", lines)
    return "\n".join(lines).strip() + "\n"


def to_change(key: str, value: object) -> str:
    """A change to a launch file as with_changes() takes it, such as `model.steps=4`. value: what TOML can say."""
    return f"{key}={_toml(str(value) if isinstance(value, PurePath) else value)}"


def without_secrets(config: NodeConfig) -> Table:
    """The configuration as plain values, with the password of a url hidden."""
    table: Table = msgspec.to_builtins(config)
    source = table["source"]
    if isinstance(source, dict) and isinstance(source.get("url"), str):
        source["url"] = _without_password(source["url"])
    return table


def _without_password(url: str) -> str:
    try:
        split = urlsplit(url)
        if split.password is None and not split.query:
            return url
        name, at, host = split.netloc.rpartition("@")
        user = name.partition(":")[0]
        shown = f"{user}:{_HIDDEN}{at}{host}" if split.password is not None else split.netloc
        return urlunsplit((split.scheme, shown, split.path, _HIDDEN if split.query else "", ""))
    except ValueError:
        return _HIDDEN


def _write_table(table: Mapping[str, object], name: str, lines: list[str]) -> None:
    """Plain values first, then the sections in it; what is None is left out, as TOML knows none."""
    plain = {key: value for key, value in table.items() if value is not None and not isinstance(value, dict)}
    if name and (plain or not any(isinstance(value, dict) for value in table.values())):
        lines += ["", f"[{name}]"]
    lines += [f"{_key(key)} = {_toml(value)}" for key, value in plain.items()]
    for key, value in table.items():
        if isinstance(value, dict):
            _write_table(value, f"{name}.{_key(key)}" if name else _key(key), lines)


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else _toml(key)


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml(each) for each in value)}]"
    if isinstance(value, str):
        return msgspec.json.encode(value).decode().replace("\x7f", "\\u007f")
    return repr(value)
