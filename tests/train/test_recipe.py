import tomllib
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
from tiny_world import RECIPE, tiny_recipe

from gcd_train.data.open import sampling_of
from gcd_train.data.paths import DRIVING, MAX90, MAX180
from gcd_train.errors import RecipeError, RunError
from gcd_train.live.recipe import LiveRecipe, live_recipes, load_live_recipe
from gcd_train.recipe_files import load_recipe, packaged_recipes, parse_recipe
from gcd_train.training.monitor import RunFolder
from gcd_train.training.setup import family_of, model_config, require_exportable


@pytest.mark.parametrize("name", packaged_recipes())
def test_every_packaged_recipe_describes_a_model_that_can_be_built(name: str) -> None:
    recipe = load_recipe(f"package:{name}")
    assert model_config(recipe.model).frames == 14
    assert (family_of(recipe.model).camera == "none") == (model_config(recipe.model).camera == "none")


def test_the_sixteen_published_trainings_ship() -> None:
    wanted = {f"kubric-{path}-max{most}" for path in ("gradual", "direct") for most in (90, 180)}
    wanted |= {f"pardom-{path}-{kind}" for path in ("gradual", "direct") for kind in ("rgb", "semantic")}
    wanted |= {f"{name}-scratch" for name in wanted}
    assert len(wanted) == 16
    assert {name for name in packaged_recipes() if name.startswith(("kubric-", "pardom-"))} == wanted
    assert {"tabletop", "lerobot"} <= set(packaged_recipes())


@pytest.mark.parametrize("name", [name for name in packaged_recipes() if name.startswith("kubric-")])
def test_a_kubric_recipe_holds_the_published_numbers(name: str) -> None:
    recipe = load_recipe(f"package:{name}")
    data, unet, wide = recipe.data, recipe.unet, "max180" in name
    assert (unet.batch, unet.parts * unet.clip_batch, unet.budget.updates) == (56, 56, 10000)
    sampling = sampling_of(recipe, 14)
    assert sampling == replace(MAX180 if wide else MAX90, move_time=13 if "gradual" in name else 0)
    assert data.goal_frame(14) == (13 if "gradual" in name else 0)
    assert (recipe.model.family, model_config(recipe.model).camera) == (
        "kubric180" if wide else "kubric90",
        "spherical",
    )
    assert recipe.model.scratch == name.endswith("-scratch")
    assert unet.loss.class_weights == "none"


@pytest.mark.parametrize("name", [name for name in packaged_recipes() if name.startswith("pardom-")])
def test_a_driving_recipe_holds_the_published_numbers(name: str) -> None:
    recipe = load_recipe(f"package:{name}")
    unet, semantic = recipe.unet, "semantic" in name
    assert (unet.batch, unet.budget.updates, unet.motion_bucket) == (24, 13000, 127)
    assert sampling_of(recipe, 14) == replace(DRIVING, move_time=13 if "gradual" in name else 0)
    assert (unet.loss.class_weights, recipe.data.modality) == (
        ("parallel-domain", "semantic") if semantic else ("none", "rgb")
    )
    assert (recipe.model.family, model_config(recipe.model).camera) == (
        "driving-semantic" if semantic else "driving",
        "none",
    )
    assert recipe.model.scratch == name.endswith("-scratch")


@pytest.mark.parametrize("name", [name for name in packaged_recipes() if name.startswith(("kubric-", "pardom-"))])
def test_a_published_recipe_holds_what_all_of_them_share(name: str) -> None:
    recipe = load_recipe(f"package:{name}")
    unet = recipe.unet
    assert (unet.optimiser.kind, unet.optimiser.rate, unet.optimiser.weight_decay) == ("adam", 2e-5, 0.0)
    assert (unet.optimiser.clip, unet.optimiser.warm_up, unet.optimiser.final, unet.ema) == (None, 0, 1.0, None)
    assert (unet.noise.log_mean, unet.noise.log_std, unet.noise.fixed_share, unet.noise.shared) == (1.0, 1.6, 0, 0)
    assert (unet.loss.focal, unet.loss.focal_steps, unet.loss.focal_fraction) == (True, 5000, 0.1)
    assert (unet.loss.focal_blend, unet.loss.weight_limit) == ("released", None)
    assert (unet.dropout, unet.dropout_per, unet.dropout_joint, unet.augmentation) == (0.1, "frame", False, 0.02)
    config = model_config(recipe.model)
    assert (config.frames, config.height, config.width, recipe.compute.precision) == (14, 256, 384, "float32")
    assert (recipe.seed, recipe.model.base, recipe.model.train) == (1234, "svd-14", "all")


@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        (b"sed = 3", "unknown key `sed`; did you mean `seed`?"),
        (b"[unet.noise]\nfixed_shar = 1.0", "unknown key `fixed_shar` in [unet.noise]; did you mean `fixed_share`?"),
        (b"[vae.budget]\nhours = 1", "unknown key `hours` in [vae.budget]; known are updates, minutes"),
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
        (b"multipliers = [1, 2, 3]", b"multipliers = [1, 2]", "attention names"),
        (b"[model]\n", b'[model]\ntrain = "lora"\nweights = "x.safetensors"\n', r"leave \[vae\] out"),
    ],
)
def test_contradictions_are_refused(old: bytes, new: bytes, wanted: str) -> None:
    with pytest.raises(RecipeError, match=wanted):
        model_config(parse_recipe(RECIPE.replace(old, new, 1), "x.toml").model)


def test_a_missing_recipe_says_where_names_are_listed_and_which_is_near(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"No such file.*; give a TOML file, or a name"):
        load_recipe(tmp_path / "none.toml")
    with pytest.raises(RecipeError, match="did you mean package:tabletop"):
        load_recipe("package:tablet")


def test_a_batch_is_told_in_clips() -> None:
    text = RECIPE.replace(b"clip_batch = 1\n", b"clip_batch = 2\nbatch = 6\n")
    assert parse_recipe(text, "x.toml").unet.parts == 3
    with pytest.raises(RecipeError, match="no multiple of clip_batch, 4"):
        parse_recipe(text.replace(b"clip_batch = 2", b"clip_batch = 4"), "x.toml")
    with pytest.raises(RecipeError, match="give one of them"):
        parse_recipe(text.replace(b"clip_batch = 2", b"clip_batch = 2\naccumulate = 2"), "x.toml")


def test_a_latent_cache_is_named_twice_or_not_at_all() -> None:
    with pytest.raises(RecipeError, match=r"both data\.kind"):
        parse_recipe(RECIPE + b'[data]\nkind = "cache"\n', "x.toml")


def test_a_size_that_the_networks_cannot_halve_is_refused_before_anything_is_trained() -> None:
    recipe = load_recipe("package:kubric-gradual-max90", small=True, changes=["model.width=48"])
    with pytest.raises(RecipeError, match=r"multiples of 32.* got 64 and 48"):
        model_config(recipe.model)


@pytest.mark.parametrize(
    ("small", "more", "said"),
    [(True, [], "the paper's networks only"), (True, ["model.vae.linear=false"], "multiple"), (False, [], None)],
)
def test_a_layout_that_cannot_hold_the_networks_is_refused_before_anything_is_trained(
    small: bool, more: list[str], said: str | None
) -> None:
    changes = ['export.layouts=["gcd-node", "gcd-ckpt"]', *more]
    recipe = load_recipe("package:kubric-gradual-max90", small=small, changes=changes)
    config = model_config(recipe.model)
    if said is None:
        require_exportable(recipe, config)  # the paper's own
        return
    with pytest.raises(RecipeError, match=rf"export\.layouts asks.*{said}"):
        require_exportable(recipe, config)


def test_the_small_scale_drops_the_published_layout_that_a_recipe_asks_for(tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_text('base = "package:kubric-gradual-max90"\n[export]\nlayouts = ["gcd-node", "gcd-ckpt"]\n')
    assert load_recipe(own).export.layouts == ("gcd-node", "gcd-ckpt")
    assert load_recipe(own, small=True).export.layouts == ("gcd-node",)


def test_a_run_folder_keeps_recipe_and_commands_and_says_what_another_recipe_changes(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder, first = RunFolder(tmp_path), tiny_recipe()
    other = msgspec.structs.replace(
        first, seed=first.seed + 1, model=msgspec.structs.replace(first.model, weights="start.ckpt")
    )
    for recipe, command in ((first, "gcd-train train tiny.toml"), (first, "again"), (other, "with another seed")):
        caplog.clear()
        with folder.begun(recipe, command):
            pass
    assert parse_recipe((tmp_path / "recipe.toml").read_bytes(), "kept") == other
    lines = (tmp_path / "commands.txt").read_text().splitlines()
    assert lines[1::2] == ["gcd-train train tiny.toml", "again", "with another seed"]
    said = "".join(each.getMessage() for each in caplog.records)
    assert f"seed was {first.seed}, is {other.seed}" in said
    assert "model.weights was not given, is start.ckpt" in said
    caplog.clear()
    with folder.begun(other, "once more"):
        assert not caplog.records
        with pytest.raises(RunError), folder.begun(first, "two at once"):
            pass
    assert parse_recipe((tmp_path / "recipe.toml").read_bytes(), "kept") == other


@pytest.mark.parametrize("name", ["recipe.toml", "commands.txt", "metrics.jsonl", "unet/samples"])
def test_a_run_folder_whose_files_lead_elsewhere_is_refused(tmp_path: Path, name: str) -> None:
    mine, given = tmp_path / "profile", tmp_path / "given"
    mine.write_text("mine")
    (given / name).parent.mkdir(parents=True)
    (given / name).symlink_to(mine)
    with pytest.raises(RunError), RunFolder(given).begun(tiny_recipe(), "gcd-train train"):
        pass
    assert mine.read_text() == "mine"


@pytest.mark.parametrize("name", live_recipes())
def test_a_live_recipe_is_kept_too(tmp_path: Path, name: str) -> None:
    recipe = load_live_recipe(f"package:{name}")
    with RunFolder(tmp_path).begun(recipe, "gcd-train train"):
        pass
    assert msgspec.convert(tomllib.loads((tmp_path / "recipe.toml").read_text()), LiveRecipe) == recipe
