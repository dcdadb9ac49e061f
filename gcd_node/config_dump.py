"""A configuration written down as a launch file, without its secrets. Needs no torch."""

from pathlib import PurePath
from urllib.parse import urlsplit, urlunsplit

import msgspec
import tomli_w

from gcd_node.config import NodeConfig, Table

_HIDDEN = "***"


def to_toml(config: NodeConfig, *, secrets: bool = False) -> str:
    """The whole configuration, defaults included, as a launch file. secrets: with passwords, which are hidden else."""
    return tomli_w.dumps(_stated(msgspec.to_builtins(config) if secrets else without_secrets(config)))


def to_change(key: str, value: object) -> str:
    """A change to a launch file as parse_config() takes it, such as `model.steps=4`. value: what TOML can say."""
    plain = str(value) if isinstance(value, PurePath) else value
    return f"{key}={tomli_w.dumps({'value': plain}).removeprefix('value = ').strip()}"


def without_secrets(config: NodeConfig) -> Table:
    """The configuration as plain values, with the password of a url hidden."""
    table: Table = msgspec.to_builtins(config)
    source = table["source"]
    if isinstance(source, dict) and isinstance(source.get("url"), str):
        source["url"] = _without_password(source["url"])
    return table


def _stated(table: Table) -> Table:
    """Without what is None: TOML has no word for it."""
    stated = {key: value for key, value in table.items() if value is not None}
    return {key: _stated(value) if isinstance(value, dict) else value for key, value in stated.items()}


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
