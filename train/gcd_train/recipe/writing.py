"""A recipe as the TOML file that would say all of it, defaults included."""

from typing import cast

import msgspec
import tomli_w


def to_toml(recipe: msgspec.Struct) -> str:
    """The whole recipe; reading it gives the same one."""
    return tomli_w.dumps(cast(dict[str, object], _said(msgspec.to_builtins(recipe))))


def _said(value: object) -> object:
    """None cannot be said in TOML and is the same as left out."""
    if isinstance(value, dict):
        return {key: _said(each) for key, each in cast(dict[str, object], value).items() if each is not None}
    return [_said(each) for each in cast(list[object], value)] if isinstance(value, list | tuple) else value
