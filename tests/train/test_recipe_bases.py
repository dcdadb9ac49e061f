"""Recipes on bases: what a file states is merged over what it is based on, and what is wrong names the files."""

from pathlib import Path

import pytest
from tiny_world import RECIPE

from gcd_train.errors import RecipeError
from gcd_train.recipe_files import load_recipe, merged, on_top, packaged_recipes, parse_recipe, to_toml

TINY = RECIPE.decode()


def write(folder: Path, **files: str) -> Path:
    """Recipe files by name; the path of the first."""
    for name, text in files.items():
        (folder / f"{name}.toml").write_text(text)
    return folder / f"{next(iter(files))}.toml"


def test_tables_merge_key_by_key_and_lists_are_replaced() -> None:
    base = {"a": {"b": {"c": 1, "d": [1, 2]}, "e": 5}, "f": 6}
    over = {"a": {"b": {"d": [3]}}, "g": 7}
    assert merged(base, over) == {"a": {"b": {"c": 1, "d": [3]}, "e": 5}, "f": 6, "g": 7}
    assert merged(base, {}) == base
    assert merged({}, over) == over
    assert base["f"] == 6
    assert merged(merged(base, over), over) == merged(base, over)


def test_what_a_recipe_does_without_is_gone_before_its_own_words_count() -> None:
    table = on_top({"a": {"b": 1, "c": 2}, "d": 3}, {"without": ["a.b", "d"], "a": {"e": 4}}, "x")
    assert table == {"a": {"c": 2, "e": 4}}
    with pytest.raises(RecipeError, match=r"x is to do without `a\.z`"):
        on_top({"a": {"b": 1}}, {"without": ["a.z"]}, "x")
    with pytest.raises(RecipeError, match="list of keys"):
        on_top({"a": {"b": 1}}, {"without": "a.b"}, "x")


def test_a_recipe_states_only_what_differs_from_its_base(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        quick='base = "middle.toml"\n[unet.noise]\nfixed_share = 0.25\n',
        middle='base = "tiny.toml"\nwithout = ["unet.ema", "vae.budget.updates"]\n[vae]\nbudget = { minutes = 2 }\n',
        tiny=TINY,
    )
    recipe, below = load_recipe(path), parse_recipe(RECIPE, "tiny")
    assert recipe.name == "quick"  # not the base's
    assert (recipe.unet.noise.fixed_share, recipe.unet.noise.shared) == (0.25, below.unet.noise.shared)
    assert recipe.unet.ema is None
    assert recipe.vae is not None
    assert (recipe.vae.budget.minutes, recipe.vae.budget.updates) == (2, None)
    assert (recipe.seed, recipe.model, recipe.latents) == (below.seed, below.model, below.latents)


def test_a_base_is_looked_for_beside_the_file_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "below").mkdir()
    write(tmp_path / "below", one='base = "two.toml"\n', two=TINY)
    assert load_recipe(write(tmp_path, top='base = "below/one.toml"\n')).seed == 3
    own = write(tmp_path, mine='base = "package:kubric-gradual-max90"\nseed = 7\n')
    assert (load_recipe(own).seed, load_recipe(own).unet.batch, load_recipe(own).name) == (7, 56, "mine")


@pytest.mark.parametrize(
    ("files", "wanted"),
    [
        ({"a": 'base = "b.toml"', "b": 'base = "a.toml"'}, r"circle: .*a\.toml \(the base of .*b\.toml, the base of"),
        ({"a": 'base = "a.toml"'}, "circle"),
        ({"a": 'base = "b.toml"', "b": 'base = "gone.toml"'}, r"gone\.toml \(the base of .*b\.toml, the base of .*a\."),
        ({"a": 'base = "b.toml"', "b": "= 3"}, r"b\.toml \(the base of .*a\.toml\) is not valid TOML"),
        ({"a": "base = 3"}, "`base` is a path"),
        ({"a": 'base = "b.toml"\n[unet]\nclip_bath = 2', "b": TINY}, r"a\.toml \(based on .*b\.toml\): .*`clip_batch`"),
        ({"a": 'bse = "b.toml"\n'}, "did you mean `base`"),
    ],
)
def test_what_is_wrong_in_a_chain_names_its_files(tmp_path: Path, files: dict[str, str], wanted: str) -> None:
    with pytest.raises(RecipeError, match=wanted):
        load_recipe(write(tmp_path, **files))


def test_the_small_scale_changes_what_its_table_says_and_the_name(tmp_path: Path) -> None:
    small = '\n[small]\nwithout = ["unet.ema"]\n[small.unet]\nbudget = { updates = 2 }\n'
    path = write(tmp_path, run='base = "tiny.toml"\n[small.unet]\nclip_batch = 2\n', tiny=TINY + small)
    large, little = load_recipe(path), load_recipe(path, small=True)
    assert (large.name, large.unet.budget.updates, large.unet.clip_batch) == ("run", 6, 1)
    assert large.unet.ema is not None
    assert (little.name, little.unet.budget.updates, little.unet.clip_batch) == ("run-small", 2, 2)
    assert little.unet.ema is None
    assert little.unet.loss == large.unet.loss


def test_a_wrong_key_of_the_small_table_is_told_whether_or_not_it_is_used(tmp_path: Path) -> None:
    path = write(tmp_path, run=TINY + "\n[small.unet]\nclip_bath = 2\n")
    for small in (False, True):
        with pytest.raises(RecipeError, match=r"\[small\] of .*did you mean `clip_batch`"):
            load_recipe(path, small=small)


def test_no_small_table_is_told(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"no table \[small\]"):
        load_recipe(write(tmp_path, run=TINY), small=True)


def test_changes_of_one_run_come_last(tmp_path: Path) -> None:
    path = write(tmp_path, run=TINY)
    recipe = load_recipe(path, changes=["unet.noise.log_std=0.5", "model.weights=a b.safetensors", "seed=4"])
    assert (recipe.unet.noise.log_std, recipe.model.weights, recipe.seed) == (0.5, "a b.safetensors", 4)
    with pytest.raises(RecipeError, match="KEY=VALUE"):
        load_recipe(path, changes=["seed"])
    with pytest.raises(RecipeError, match="did you mean `seed`"):
        load_recipe(path, changes=["sed=4"])


@pytest.mark.parametrize("name", packaged_recipes())
def test_a_recipe_written_out_is_the_same_recipe(name: str) -> None:
    recipe = load_recipe(f"package:{name}")
    assert parse_recipe(to_toml(recipe).encode(), "written") == recipe
