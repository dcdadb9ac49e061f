from pathlib import Path

import pytest
from tiny_world import RECIPE

from gcd_train.errors import RecipeError
from gcd_train.model_setup import family_of, model_config
from gcd_train.recipe import PACKAGED, load_recipe, parse_recipe


@pytest.mark.parametrize("name", sorted(file.stem for file in PACKAGED.glob("*.toml")))
def test_every_packaged_recipe_describes_a_model_that_can_be_built(name: str) -> None:
    recipe = load_recipe(f"package:{name}")
    assert model_config(recipe.model).frames == 14
    assert family_of(recipe.model).name.startswith("driving")


def test_the_papers_recipe_holds_the_published_numbers() -> None:
    unet = load_recipe("package:paper-driving").unet
    assert (unet.optimiser.kind, unet.optimiser.rate, unet.optimiser.weight_decay) == ("adam", 2e-5, 0.0)
    assert (unet.optimiser.clip, unet.optimiser.warm_up, unet.optimiser.final, unet.ema) == (None, 0, 1.0, None)
    assert (unet.noise.log_mean, unet.noise.log_std, unet.noise.fixed_share, unet.noise.shared) == (1.0, 1.6, 0, 0)
    assert (unet.loss.focal, unet.loss.focal_steps, unet.loss.focal_fraction) == (True, 5000, 0.1)
    assert (unet.dropout, unet.augmentation, unet.loss.weight_limit) == (0.1, 0.02, None)
    assert (unet.budget.updates, unet.clip_batch * unet.accumulate, unet.source) == (13000, 24, "pixels")


def test_the_small_recipes_fit_the_size_of_the_package() -> None:
    for name in ("driving-small", "driving-small-gpu"):
        assert load_recipe(f"package:{name}").stages == ("vae", "latents", "unet", "decoder", "export")


@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        (b"sed = 3", "unknown key `sed`; did you mean `seed`?"),
        (b"[unet.noise]\nfixed_shar = 1.0", "unknown key `fixed_shar` in [unet.noise]; did you mean `fixed_share`?"),
        (b"[decoder.budget]\nhours = 1", "unknown key `hours` in [decoder.budget]; known are updates, minutes"),
    ],
)
def test_an_unknown_key_is_refused_with_the_nearest_known_one(line: bytes, wanted: str) -> None:
    text = b'name = "x"\n' + line
    with pytest.raises(RecipeError, match="unknown key") as caught:
        parse_recipe(text, "x.toml")
    assert wanted in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "wanted"),
    [
        (b"updates = 6 }", b"updates = 6, minutes = 1 }", "either updates or minutes"),
        (b"[latents]\n", b"", "needs a \\[latents\\] table"),
        (b"batch = 2\n", b"batch = 2\nfinetune_vae = true\n", "run above 1"),
        (b"multipliers = [1, 2, 3]", b"multipliers = [1, 2]", "attention names"),
    ],
)
def test_contradictions_are_refused(old: bytes, new: bytes, wanted: str) -> None:
    with pytest.raises(RecipeError, match=wanted):
        model_config(parse_recipe(RECIPE.replace(old, new, 1), "x.toml").model)


def test_a_missing_recipe_names_the_packaged_ones(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="package:driving-small"):
        load_recipe(tmp_path / "none.toml")


def test_a_steered_family_is_refused() -> None:
    recipe = parse_recipe(RECIPE.replace(b"[model]\n", b'[model]\nfamily = "kubric90"\n'), "x.toml")
    with pytest.raises(RecipeError, match="fixed view"):
        family_of(recipe.model)
