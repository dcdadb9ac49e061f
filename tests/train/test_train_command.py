import tomllib
from pathlib import Path

import msgspec
from typer.testing import CliRunner

from gcd_train.cli.main import app
from gcd_train.recipe import Recipe
from gcd_train.recipe_files import packaged_recipes


def test_a_missing_recipe_ends_with_the_exit_code_of_a_bad_configuration(tmp_path: Path) -> None:
    where = [f"--{name}={tmp_path}" for name in ("data", "valid", "out")]
    result = CliRunner().invoke(app, ["train", str(tmp_path / "none.toml"), *where])
    assert result.exit_code == 78


def test_a_missing_data_folder_ends_with_the_exit_code_of_missing_data(tmp_path: Path) -> None:
    where = [f"--{name}={tmp_path / 'none'}" for name in ("data", "valid", "out")]
    result = CliRunner().invoke(app, ["train", "package:study-pretrain", *where])
    assert result.exit_code == 66


def test_an_unknown_stage_is_refused_with_the_known_ones(tmp_path: Path) -> None:
    where = [f"--{name}={tmp_path}" for name in ("data", "valid", "out")]
    result = CliRunner().invoke(app, ["train", "package:study-pretrain", *where, "--stage", "gan"])
    assert result.exit_code != 0
    assert "export" in result.output


def test_the_recipes_that_ship_are_listed_and_one_is_shown_whole() -> None:
    listed = CliRunner().invoke(app, ["recipes"], env={"COLUMNS": "160"})
    assert listed.exit_code == 0, listed.output
    for text in ("package:kubric-direct-max180-scratch", "parallel_domain4d, classes", "package:lerobot", "10000"):
        assert text in listed.output
    shown = CliRunner().invoke(app, ["recipes", "package:tabletop", "--small", "--set=unet.batch=6"])
    assert shown.exit_code == 0, shown.output
    wanted = (
        'name = "tabletop-small"',
        'camera = "relative_pose"',
        "batch = 6",
        "[unet.loss]",
        "dropout_joint = false",
    )
    for text in wanted:
        assert text in shown.output


def test_a_distillation_is_listed_and_shown_whole_and_train_takes_it(tmp_path: Path) -> None:
    assert "package:distill-kubric" in CliRunner().invoke(app, ["recipes"]).output
    shown = CliRunner().invoke(app, ["recipes", "package:distill-kubric", "--set=student.steps=7"])
    assert shown.exit_code == 0, shown.output
    assert msgspec.convert(tomllib.loads(shown.output), Recipe).student.steps == 7
    folders = [f"--{name}={tmp_path}" for name in ("data", "out")]
    refused = CliRunner().invoke(app, ["train", "package:distill-kubric", *folders])
    assert refused.exit_code == 78
    assert "kubric_gradual_max90.ckpt" in refused.output


def test_train_takes_the_small_scale_and_changes(tmp_path: Path) -> None:
    where = [f"--{name}={tmp_path / 'none'}" for name in ("data", "out")]
    wrong = CliRunner().invoke(app, ["train", "package:tabletop", *where, "--small", "--set=unet.clip_bath=2"])
    assert wrong.exit_code == 78
    gone = CliRunner().invoke(app, ["train", "package:tabletop", *where, "--small"])
    assert gone.exit_code == 66


def test_no_name_of_a_recipe_is_cut_off_in_a_narrow_terminal() -> None:
    listed = CliRunner().invoke(app, ["recipes"], env={"COLUMNS": "60"})
    assert [name for name in packaged_recipes() if f"package:{name} " not in listed.output] == []


def test_a_mistyped_recipe_is_answered_with_its_neighbour() -> None:
    result = CliRunner().invoke(app, ["recipes", "package:kubric-gradul-max90"])
    assert result.exit_code == 78
    assert "did you mean package:kubric-gradual-max90" in " ".join(result.output.split())
