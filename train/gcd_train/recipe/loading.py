"""Recipe files, as they are read: merged with their bases, changed for this run, checked."""

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import msgspec

from gcd_model import explain_settings_error
from gcd_train.errors import RecipeError
from gcd_train.recipe.merging import (
    BASE,
    SMALL,
    WITHOUT,
    MergedTable,
    Table,
    merged,
    on_top,
    parsed,
    read_merged,
    require_known,
)
from gcd_train.recipe.schema import Recipe

Kind = TypeVar("Kind", bound=msgspec.Struct)
_KEYS = (*Recipe.__struct_fields__, BASE, WITHOUT, SMALL)


def load_recipe(source: str | Path, *, small: bool = False, changes: Sequence[str] = ()) -> Recipe:
    """Read a recipe: a path, or `package:NAME`, on top of the bases it names.

    small: with what its table [small] says: a model, size, batch and budget for a CPU. changes: `KEY=VALUE` each, on
    top of all, such as `model.weights=svd.safetensors`.

    Raises:
        RecipeError: missing, not TOML, a base that is missing or goes in a circle, an unknown key (the nearest known
            one is named), a value out of range, or no table [small] where it is asked for.
    """
    read = read_merged(source)
    return _recipe(read, small=small, changes=changes)


def parse_recipe(text: bytes, name: str) -> Recipe:
    """Read a recipe file's content, without a base; `name` is for the message. Raises RecipeError as `load_recipe`."""
    return _recipe(MergedTable(parsed(text, name), (name,)), small=False, changes=())


def checked_recipe(table: Table, place: str, kind: type[Kind], changes: Sequence[str] = ()) -> Kind:
    """A table as a recipe of some kind, changed for this run; `place` is for the message. Raises RecipeError."""
    try:
        return msgspec.convert(_changed(table, changes), kind)
    except msgspec.ValidationError as error:
        raise RecipeError(f"{place}: {explain_settings_error(str(error), kind)}") from error


def _recipe(read: MergedTable, *, small: bool, changes: Sequence[str]) -> Recipe:
    require_known(read.table, _KEYS, read.place)
    own = {key: value for key, value in read.table.items() if key not in (SMALL, WITHOUT)}
    if not small:
        recipe = _checked(_changed(own, changes), read.place)
        _smaller(own, read)  # what is wrong in it is told now, not to whoever asks for it
        return recipe
    table = _smaller(own, read)
    if table is None:
        raise RecipeError(f"{read.place} has no table [small], which would say what a CPU can do; leave out --small")
    return _checked(_changed(table, changes), read.place)


def _smaller(own: Table, read: MergedTable) -> Table | None:
    """The recipe as its table [small] wants it; named so, too, lest the one be taken for the other."""
    smaller, place = read.table.get(SMALL), f"[small] of {read.place}"
    if smaller is None:
        return None
    if not isinstance(smaller, dict):
        raise RecipeError(f"{place} must be a table, got {smaller!r}")
    table = on_top(own, {"name": f"{own.get('name')}-small", **smaller}, place)
    _checked(table, place)
    return table


def _changed(table: Table, changes: Sequence[str]) -> Table:
    for change in changes:
        table = merged(table, _change(change))
    return table


def _checked(table: Table, place: str) -> Recipe:
    return checked_recipe(table, place, Recipe)


def _change(change: str) -> Table:
    """`unet.batch=8` as a table of tables; what is no TOML value is text."""
    key, equals, value = change.partition("=")
    if not equals or not all(key.split(".")):
        raise RecipeError(f"a change is KEY=VALUE, such as unet.batch=8, got {change!r}")
    try:
        made: object = parsed(f"value = {value}".encode(), change)["value"]
    except RecipeError:
        made = value
    for part in reversed(key.split(".")):
        made = {part: made}
    assert isinstance(made, dict), "a key has at least one part"
    return made
