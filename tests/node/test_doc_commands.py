"""Commands of the pages, run as they stand: every shell block marked `sh run`, with less data."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from doc_pages import BLOCKS, ROOT, Block

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

SMALLER = {
    "--scenes 20 --compact": "--scenes 1 --compact --frames 14 --width 96 --height 64",
    "--clips 100": "--clips 3",
    "--clips 40": "--clips 2",
}
"""What a page makes, and what is made here instead."""


@pytest.fixture
def programs(tmp_path: Path) -> dict[str, str]:
    """An environment in which `gcd-node` and `gcd-train` are those of this checkout."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in ("gcd-node", "gcd-train"):
        (folder / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" -m {name.replace("-", "_")} "$@"\n')
        (folder / name).chmod(0o755)
    path = os.pathsep.join([str(folder), *(str(ROOT / each) for each in ("model", "client", "train")), str(ROOT)])
    return {**os.environ, "PATH": f"{folder}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": path}


@pytest.mark.parametrize("block", [b for b in BLOCKS if (b.language, b.mark) == ("sh", "run")], ids=lambda b: b.place)
def test_a_shell_block_marked_run_runs(block: Block, programs: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "launch").symlink_to(ROOT / "launch")
    for name in ("drive.mp4", "my.mp4"):
        shutil.copy(ROOT / "gcd_node" / "assets" / "drive.mp4", tmp_path / name)
    text = block.text
    for much, little in SMALLER.items():
        text = text.replace(much, little)
    done = subprocess.run(["bash", "-e", "-c", text], cwd=tmp_path, env=programs, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
