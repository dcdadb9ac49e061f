"""Recipe files, as they are read."""

from pathlib import Path

import msgspec

from gcd_model import explain_settings_error
from gcd_train.errors import RecipeError
from gcd_train.recipe.schema import Recipe

PACKAGED = Path(__file__).parents[1] / "recipes"
"""Where the recipes that ship with the package lie."""


def load_recipe(source: str | Path) -> Recipe:
    """Read a recipe: a path, or `package:NAME`.

    Raises:
        RecipeError: missing, not TOML, an unknown key (the nearest known one is named), a value out of range.
    """
    kind, _, name = str(source).partition(":")
    path = PACKAGED / f"{name}.toml" if kind == "package" else Path(source)
    try:
        text = path.read_bytes()
    except OSError as error:
        there = ", ".join(sorted(f"package:{file.stem}" for file in PACKAGED.glob("*.toml")))
        raise RecipeError(
            f"cannot read the recipe {path}: {error.strerror}; give a TOML file, or one of {there}"
        ) from error
    return parse_recipe(text, str(path))


def parse_recipe(text: bytes, name: str) -> Recipe:
    """Read a recipe file's content; `name` is for the message. Raises RecipeError as `load_recipe`."""
    try:
        return msgspec.toml.decode(text, type=Recipe)
    except msgspec.ValidationError as error:
        raise RecipeError(f"{name}: {explain_settings_error(str(error), Recipe)}") from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise RecipeError(f"{name} is not valid TOML: {error}") from error
