"""A recipe as the TOML file that would say all of it, defaults included."""

import json
from collections.abc import Mapping
from typing import cast

import msgspec

from gcd_train.recipe.schema import Recipe


def to_toml(recipe: Recipe) -> str:
    """The whole recipe; reading it gives the same one."""
    return "\n".join(_lines(msgspec.to_builtins(recipe), ())) + "\n"


def _lines(table: Mapping[str, object], place: tuple[str, ...]) -> list[str]:
    """Plain values first, then the tables below; None cannot be said in TOML and is the same as left out."""
    given = {key: value for key, value in table.items() if value is not None}
    plain = [f"{key} = {_value(value)}" for key, value in given.items() if not isinstance(value, dict)]
    tables = {key: cast(Mapping[str, object], value) for key, value in given.items() if isinstance(value, dict)}
    head = ["", f"[{'.'.join(place)}]"] if place else []
    below = [line for key, value in tables.items() for line in _lines(value, (*place, key))]
    return [*head, *plain, *below]


def _value(value: object) -> str:
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(_value(each) for each in cast(list[object], list(value)))}]"  # pyright: ignore[reportUnknownArgumentType]
    return json.dumps(value, ensure_ascii=False)
