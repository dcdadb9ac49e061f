from pathlib import Path

from typer.testing import CliRunner

from gcd_train.cli.main import app


def test_train_explains_itself() -> None:
    result = CliRunner().invoke(app, ["train", "--help"], env={"COLUMNS": "120"})
    assert result.exit_code == 0
    for text in ("RECIPE", "--data", "--valid", "--out", "--stage", "--threads"):
        assert text in result.output


def test_a_missing_recipe_ends_with_the_exit_code_of_a_bad_configuration(tmp_path: Path) -> None:
    where = [f"--{name}={tmp_path}" for name in ("data", "valid", "out")]
    result = CliRunner().invoke(app, ["train", str(tmp_path / "none.toml"), *where])
    assert result.exit_code == 78


def test_a_missing_data_folder_ends_with_the_exit_code_of_missing_data(tmp_path: Path) -> None:
    where = [f"--{name}={tmp_path / 'none'}" for name in ("data", "valid", "out")]
    result = CliRunner().invoke(app, ["train", "package:driving-small", *where])
    assert result.exit_code == 66


def test_an_unknown_stage_is_refused_with_the_known_ones(tmp_path: Path) -> None:
    where = [f"--{name}={tmp_path}" for name in ("data", "valid", "out")]
    result = CliRunner().invoke(app, ["train", "package:driving-small", *where, "--stage", "gan"])
    assert result.exit_code != 0
    assert "decoder" in result.output
