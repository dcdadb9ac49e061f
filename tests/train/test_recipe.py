"""Recipes: what ships, what is refused, what files on their bases make, and what a run folder keeps of them."""

import tomllib
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
from tiny_world import RECIPE, tiny_recipe

from gcd_train.data.open import sampling_of
from gcd_train.data.paths import DRIVING, MAX90, MAX180
from gcd_train.errors import RecipeError, RunError
from gcd_train.recipe import LiveRecipe, Recipe
from gcd_train.recipe_files import load_recipe, merged, on_top, packaged_recipes, to_toml
from gcd_train.training.monitor import RunFolder
from gcd_train.training.setup import family_of, model_config, require_exportable

TINY = RECIPE.decode()
PUBLISHED = [name for name in packaged_recipes() if name.startswith(("kubric-", "pardom-"))]


def write(folder: Path, **files: str) -> Path:
    """Recipe files by name; the path of the first."""
    for name, text in files.items():
        (folder / f"{name}.toml").write_text(text)
    return folder / f"{next(iter(files))}.toml"


@pytest.mark.parametrize("name", [name for name in packaged_recipes() if not name.startswith("live-")])
def test_every_packaged_recipe_describes_a_model_that_can_be_built_and_is_the_same_when_written_out(name: str) -> None:
    recipe = load_recipe(f"package:{name}")
    assert msgspec.toml.decode(to_toml(recipe), type=Recipe) == recipe
    assert model_config(recipe.model).frames == 14
    assert (family_of(recipe.model).camera == "none") == (model_config(recipe.model).camera == "none")


def test_the_sixteen_published_trainings_ship() -> None:
    wanted = {f"kubric-{path}-max{most}" for path in ("gradual", "direct") for most in (90, 180)}
    wanted |= {f"pardom-{path}-{kind}" for path in ("gradual", "direct") for kind in ("rgb", "semantic")}
    wanted |= {f"{name}-scratch" for name in wanted}
    assert len(wanted) == 16
    shown = {f"{name}-splat" for name in ("kubric-gradual-max90", "kubric-gradual-max180", "pardom-gradual-rgb")}
    assert set(PUBLISHED) == wanted | shown  # the same, and shown the source's points
    assert {"tabletop", "lerobot"} <= set(packaged_recipes())


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_published_recipe_holds_the_published_numbers(name: str) -> None:
    recipe = load_recipe(f"package:{name}")
    data, unet, model, config = recipe.data, recipe.unet, recipe.model, model_config(recipe.model)
    wide, semantic, goal = "max180" in name, "semantic" in name, 13 if "gradual" in name else 0
    if name.startswith("kubric-"):
        sampling, numbers = MAX180 if wide else MAX90, (56, 10000)
        steering = ("kubric180" if wide else "kubric90", "spherical")
    else:
        sampling, numbers = DRIVING, (24, 13000)
        steering = ("driving-semantic" if semantic else "driving", "none")
        assert unet.motion_bucket == 127
    assert sampling_of(recipe, 14) == replace(sampling, move_time=goal)
    assert (unet.batch, unet.budget.updates) == numbers
    assert unet.parts * unet.clip_batch == unet.batch
    assert (model.family, config.camera) == steering
    assert (unet.loss.class_weights, data.modality) == (
        ("parallel-domain", "semantic") if semantic else ("none", "rgb")
    )
    assert data.goal_frame(14) == goal
    assert model.scratch == name.endswith("-scratch")
    assert (model.splat != "none") == (config.unet.condition_channels == 9) == name.endswith("-splat")
    assert (unet.optimiser.kind, unet.optimiser.rate, unet.optimiser.weight_decay) == ("adam", 2e-5, 0.0)
    assert (unet.optimiser.clip, unet.optimiser.warm_up, unet.optimiser.final, unet.ema) == (None, 0, 1.0, None)
    assert (unet.noise.log_mean, unet.noise.log_std, unet.noise.fixed_share, unet.noise.shared) == (1.0, 1.6, 0, 0)
    assert (unet.loss.focal, unet.loss.focal_steps, unet.loss.focal_fraction) == (True, 5000, 0.1)
    assert (unet.loss.focal_blend, unet.loss.weight_limit) == ("released", None)
    assert (unet.dropout, unet.dropout_per, unet.dropout_joint, unet.augmentation) == (0.1, "frame", False, 0.02)
    assert (config.frames, config.height, config.width, recipe.compute.precision) == (14, 256, 384, "float32")
    assert (recipe.seed, model.base, model.train) == (1234, "svd-14", "all")
    assert (recipe.compute.parallel, recipe.log.save_s, recipe.log.keep) == ("ddp", 1800.0, 2)
    assert (recipe.log.measure_every, recipe.log.keep_every) == (1250, None)


@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        ("sed = 3", "unknown key `sed`; did you mean `seed`?"),
        ('kind = "live"\nspeed = 1', "unknown key `speed`"),
        ("[unet.noise]\nfixed_shar = 1.0", "unknown key `fixed_shar` in [unet.noise]; did you mean `fixed_share`?"),
        ("[vae.budget]\nhours = 1", "unknown key `hours` in [vae.budget]; known are updates, minutes"),
    ],
)
def test_an_unknown_key_is_refused_with_the_nearest_known_one(tmp_path: Path, line: str, wanted: str) -> None:
    with pytest.raises(RecipeError, match="unknown key") as caught:
        load_recipe(write(tmp_path, x=f'name = "x"\n{line}'))
    assert wanted in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "wanted"),
    [
        ("updates = 6 }", "updates = 6, minutes = 1 }", "either updates or minutes"),
        ("[latents]\n", "", r"needs a \[latents\] table"),
        ("multipliers = [1, 2, 3]", "multipliers = [1, 2]", "attention names"),
        ("[model]\n", '[model]\ntrain = "lora"\nweights = "x.safetensors"\n', r"leave \[vae\] out"),
        ("width = 64", "width = 48", r"multiples of 32.* got 32 and 48"),
        ("clip_batch = 1", "clip_batch = 4\nbatch = 6", "no multiple of clip_batch, 4"),
        ("clip_batch = 1", "clip_batch = 2\nbatch = 6\naccumulate = 2", "give one of them"),
        ("[model]\n", '[data]\nkind = "cache"\n[model]\n', r"both data\.kind"),
    ],
)
def test_contradictions_are_refused(tmp_path: Path, old: str, new: str, wanted: str) -> None:
    with pytest.raises(RecipeError, match=wanted):
        model_config(load_recipe(write(tmp_path, x=TINY.replace(old, new, 1))).model)


def test_a_missing_recipe_says_where_names_are_listed_and_which_is_near(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"No such file.*; give a TOML file, or a name"):
        load_recipe(tmp_path / "none.toml")
    with pytest.raises(RecipeError, match="did you mean package:tabletop"):
        load_recipe("package:tablet")


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
    assert load_recipe(tmp_path / "recipe.toml") == other
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
    assert load_recipe(tmp_path / "recipe.toml") == other


@pytest.mark.parametrize("name", ["recipe.toml", "commands.txt", "metrics.jsonl", "unet/samples"])
def test_a_run_folder_whose_files_lead_elsewhere_is_refused(tmp_path: Path, name: str) -> None:
    mine, given = tmp_path / "profile", tmp_path / "given"
    mine.write_text("mine")
    (given / name).parent.mkdir(parents=True)
    (given / name).symlink_to(mine)
    with pytest.raises(RunError), RunFolder(given).begun(tiny_recipe(), "gcd-train train"):
        pass
    assert mine.read_text() == "mine"


@pytest.mark.parametrize("name", ["live-small", "live-small-gpu"])
def test_a_live_recipe_is_kept_too(tmp_path: Path, name: str) -> None:
    recipe = load_recipe(f"package:{name}")
    with RunFolder(tmp_path).begun(recipe, "gcd-train train"):
        pass
    assert msgspec.convert(tomllib.loads((tmp_path / "recipe.toml").read_text()), LiveRecipe) == recipe


# on bases


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
    for without in (["a.z"], ["z.a"], "a.z", [3], ["a.b.c"], ["a.b.c.d"]):
        with pytest.raises(RecipeError, match="`without` lists keys"):
            on_top({"a": {"b": 1}}, {"without": without}, "x")


def test_a_recipe_states_only_what_differs_from_its_base(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        quick='base = "middle.toml"\n[unet.noise]\nfixed_share = 0.25\n',
        middle='base = "tiny.toml"\nwithout = ["unet.ema", "vae.budget.updates"]\n[vae]\nbudget = { minutes = 2 }\n',
        tiny=TINY,
    )
    recipe, below = load_recipe(path), tiny_recipe()
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


def test_no_small_table_and_a_wrong_key_of_it_are_told_and_this_whether_or_not_it_is_used(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"no table \[small\]"):
        load_recipe(write(tmp_path, run=TINY), small=True)
    path = write(tmp_path, run=TINY + "\n[small.unet]\nclip_bath = 2\n")
    for small in (False, True):
        with pytest.raises(RecipeError, match=r"\[small\] of .*did you mean `clip_batch`"):
            load_recipe(path, small=small)


def test_changes_of_one_run_come_last(tmp_path: Path) -> None:
    path = write(tmp_path, run=TINY)
    recipe = load_recipe(path, changes=["unet.noise.log_std=0.5", "model.weights=a b.safetensors", "seed=4"])
    assert (recipe.unet.noise.log_std, recipe.model.weights, recipe.seed) == (0.5, "a b.safetensors", 4)
    with pytest.raises(RecipeError, match="KEY=VALUE"):
        load_recipe(path, changes=["seed"])
    with pytest.raises(RecipeError, match="did you mean `seed`"):
        load_recipe(path, changes=["sed=4"])
