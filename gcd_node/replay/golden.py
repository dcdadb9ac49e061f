"""Golden runs: what a launch file is expected to give, kept beside a project's tests."""

import shutil
from pathlib import Path

from gcd_node.errors import DamagedRunError, OutputError
from gcd_node.pictures.files import make_folder
from gcd_node.replay.run_diff import compare
from gcd_node.replay.run_folder import MANIFEST, RunFolder, new_folder, open_run


def renew_golden(run: RunFolder, golden: Path) -> bool:
    """Make `golden` a copy of the run; whether anything changed. A golden that already says the same stays untouched.

    Raises:
        OutputError: `golden` is something else than a run, or cannot be written. DamagedRunError: see compare().
    """
    if golden.is_dir() and any(golden.iterdir()):
        if not (golden / MANIFEST).is_file():
            raise OutputError(f"{golden} is there and is no golden run (it has no {MANIFEST}); name another folder")
        if _says_the_same(run, golden):
            return False
        _remove(golden)
    make_folder(golden.parent)
    with new_folder(golden) as folder:
        shutil.copytree(run.path, folder, dirs_exist_ok=True)
    return True


def _says_the_same(run: RunFolder, golden: Path) -> bool:
    """A damaged golden, or one of an earlier version, never does."""
    try:
        comparison = compare(open_run(golden), run)
    except DamagedRunError:
        return False
    return comparison.first_divergence is None and not comparison.facts


def _remove(folder: Path) -> None:
    try:
        shutil.rmtree(folder)
    except OSError as error:
        raise OutputError(f"cannot replace {folder}: {error.strerror}; check its permissions") from error
