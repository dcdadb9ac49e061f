"""Recipe files: read on their bases, changed for one run, checked, and written."""

import difflib
import os
from collections.abc import Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any, TypeAlias, cast

import msgspec
import tomli_w

from gcd_model import explain_settings_error
from gcd_model.errors import FileError
from gcd_model.small_files import decode_toml, read_small
from gcd_train.errors import RecipeError
from gcd_train.recipe import LiveRecipe, Recipe

PACKAGED = Path(__file__).parent / "recipes"
"""Where the recipes that ship with the package lie; those that only serve as a base, in `bases/`."""
BASE, WITHOUT, SMALL = "base", "without", "small"
_DEEPEST = 20

Table: TypeAlias = dict[str, object]


def packaged_recipes() -> list[str]:
    """Names of the recipes that ship."""
    return sorted(file.stem for file in PACKAGED.glob("*.toml"))


def parsed(text: str | bytes, name: str) -> Table:
    """A TOML file's content. Raises RecipeError naming it."""
    try:
        return decode_toml(text)
    except FileError as error:
        raise RecipeError(f"{name} {error}") from error


def merged(base: Mapping[str, object], over: Mapping[str, object]) -> Table:
    """Tables merged key by key; anything else, lists too, is replaced."""
    table = dict(base)
    for key, value in over.items():
        below = table.get(key)
        both = isinstance(below, dict) and isinstance(value, dict)
        table[key] = merged(cast(Table, below), cast(Table, value)) if both else value
    return table


def on_top(base: Mapping[str, object], over: Mapping[str, object], name: str) -> Table:
    """What `over` makes of a base: first what it does without is taken out, then the rest is merged.

    Raises: RecipeError if it does without something that the base does not have.
    """
    table, unwanted = cast(dict[str, Any], deepcopy(dict(base))), cast(Any, over.get(WITHOUT, []))
    for key in unwanted if isinstance(unwanted, list) else [unwanted]:
        below, (*path, last) = table, str(key).split(".")
        for part in path:
            below = below.get(part) if isinstance(below, dict) else None
        if not isinstance(below, dict) or last not in below:
            raise RecipeError(f'{name}: `without` lists keys of the base, such as "unet.ema"; it has no `{key}`')
        del below[last]
    return merged(table, {key: value for key, value in over.items() if key != WITHOUT})


def read_merged(path: Path, above: tuple[Path, ...] = ()) -> tuple[Table, tuple[str, ...]]:
    """What a recipe states together with its bases, and the files: the recipe's, then its base, and so on."""
    here = Path(os.path.realpath(path))
    chain = (*above, here)
    if here in above or len(chain) > _DEEPEST:
        raise RecipeError(f"recipes are based on each other in a circle: {_told(chain)}; take out one `base`")
    try:
        own = parsed(read_small(path), _told((*above, path)))
    except FileError as error:
        raise RecipeError(f"the recipe {_told((*above, path))} {error}; {_instead(path)}") from error
    base = own.pop(BASE, None)
    own.setdefault("name", path.stem)
    if base is None:
        return own, (str(path),)
    if not isinstance(base, str):
        raise RecipeError(f"{path}: `base` is a path from here, or package:NAME, got {base!r}")
    below, files = read_merged(place_of(base, path.parent), chain)
    return on_top(below, own, str(path)), (str(path), *files)


def place_of(source: str | Path, beside: Path = Path()) -> Path:
    """Where a recipe lies: a path, taken from the folder `beside` if it is not absolute, or `package:NAME`."""
    kind, _, name = str(source).partition(":")
    return PACKAGED / f"{name}.toml" if kind == "package" else beside / source


def _instead(path: Path) -> str:
    """What to give in place of a recipe file that is not there."""
    near = difflib.get_close_matches(path.stem, packaged_recipes(), n=2, cutoff=0.6)
    meant = f"did you mean {' or '.join(f'package:{name}' for name in near)}? " if near else ""
    return f"{meant}give a TOML file, or a name that `gcd-train recipes` lists"


def _told(chain: Sequence[Path]) -> str:
    """The last file, and who led there."""
    last, *before = reversed([str(path) for path in chain])
    return last if not before else f"{last} (the base of {', the base of '.join(before)})"


def load_recipe(source: str | Path, *, small: bool = False, changes: Sequence[str] = ()) -> Recipe | LiveRecipe:
    """Read a recipe: a path, or `package:NAME`, on top of the bases it names; a live model's has `kind = "live"`.

    small: with what its table [small] says: a model, size, batch and budget for a CPU. changes: `KEY=VALUE` each, on
    top of all, such as `model.weights=svd.safetensors`.

    Raises:
        RecipeError: missing, not TOML, a base that is missing or goes in a circle, an unknown key (the nearest known
            one is named), a value out of range, or no table [small] where it is asked for.
    """
    table, (first, *bases) = read_merged(place_of(source))
    place = first if not bases else f"{first} (based on {', '.join(bases)})"
    given, _ = table.pop(SMALL, None), table.pop(WITHOUT, None)
    if small and given is None:
        raise RecipeError(f"{place} has no table [small], which would say what a CPU can do; leave out --small")
    chosen, inner = table, f"[small] of {place}"
    smaller = table
    if given is not None:
        if not isinstance(given, dict):
            raise RecipeError(f"{inner} must be a table, got {given!r}")
        smaller = on_top(table, {"name": f"{table.get('name')}-small", **cast(Table, given)}, inner)
        chosen = smaller if small else table
    for change in changes:
        chosen = merged(chosen, _change(change))
    recipe = _checked(chosen, inner if small else place)
    if smaller is not table and not small:
        _checked(smaller, inner)  # what is wrong in it is told now, not to whoever asks for it
    return recipe


def _checked(table: Table, place: str) -> Recipe | LiveRecipe:
    kind = LiveRecipe if table.get("kind") == "live" else Recipe
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        raise RecipeError(f"{place}: {explain_settings_error(str(error), kind)}") from error


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


def to_toml(recipe: msgspec.Struct) -> str:
    """The whole recipe; reading it gives the same one."""
    return tomli_w.dumps(cast(dict[str, object], _said(msgspec.to_builtins(recipe))))


def _said(value: object) -> object:
    """None cannot be said in TOML and is the same as left out."""
    if isinstance(value, dict):
        return {key: _said(each) for key, each in cast(dict[str, object], value).items() if each is not None}
    return [_said(each) for each in cast(list[object], value)] if isinstance(value, list | tuple) else value
