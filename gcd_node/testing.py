"""A pytest plugin for projects that run gcd-node: replay a launch file in a test, and compare it with a golden run.

    def test_the_drive_looks_as_it_did(gcd_replay: ReplayFixture) -> None:
        run = gcd_replay("launch.toml", {"model.steps": 1})
        run.assert_same_as("tests/golden/drive", min_psnr=40.0)

Installed with the package, so plain `pytest` finds it; `pytest --gcd-update` writes the golden runs. Light to import:
the model comes with the first replay.
"""

import contextlib
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from gcd_node.replay.run import RunFolder

__all__ = ["ReplayFixture", "ReplayedRun", "gcd_replay"]

_UPDATE = "--gcd-update"


class ReplayedRun:
    """A launch file that was replayed in a test. folder: the run, as `gcd-node replay --out` writes it; in the test's
    tmp_path. manifest: what it states of itself, seeds, stamps, digests, totals."""

    def __init__(self, run: "RunFolder", config: pytest.Config) -> None:
        self.folder, self.manifest = run.path, run.manifest
        self._run, self._config = run, config

    def assert_same_as(
        self, golden: str | Path, *, min_psnr: float | None = None, max_class_share: float = 0.0
    ) -> None:
        """Fail unless this run is what a golden run says. With --gcd-update the golden becomes this run instead.

        Args:
            golden: its folder; from pytest's root folder if relative.
            min_psnr: decibels each frame of each view must reach; left out, all pixels must be identical, which only
                the same machine promises.
            max_class_share: of a view's class pixels in a window, how many may differ, 0 to 1.
        Raises:
            AssertionError: it differs, or there is no golden run yet. DamagedRunError: the golden is damaged.
            OutputError: with --gcd-update, there is something else than a run, or it cannot be copied.
        """
        __tracebackhide__ = True
        from gcd_node.errors import OutputError
        from gcd_node.replay.compare import Tolerance, compare, report_text
        from gcd_node.replay.run import MANIFEST, new_folder, open_run

        path = self._config.rootpath / golden
        if self._config.getoption(_UPDATE):
            former = path.with_name(f".{path.name}.former")  # which goes once the next is whole
            if (path / MANIFEST).is_file():
                shutil.rmtree(former, ignore_errors=True)
                path.replace(former)
            try:
                with new_folder(path) as folder:
                    shutil.copytree(self.folder, folder, dirs_exist_ok=True)
            except OSError as error:
                raise OutputError(f"cannot copy {self.folder} to {path}: {error}; replay again") from error
            shutil.rmtree(former, ignore_errors=True)
            return
        if not path.exists():
            raise AssertionError(
                f"no golden run at {path}: make one with `pytest {_UPDATE}`, look at it, and commit it"
            )
        tolerance = Tolerance(min_psnr_db=min_psnr, max_class_share=max_class_share)
        comparison = compare(open_run(path), self._run)
        if comparison.failures(tolerance):
            raise AssertionError(
                f"{report_text(comparison, tolerance)}\nA is the golden run {path}\nB is this run {self.folder}\n"
                f"If this is how it should be: pytest {_UPDATE}"
            )


class ReplayFixture:
    """What the fixture `gcd_replay` gives: call it with a launch file."""

    def __init__(self, config: pytest.Config, folder: Path) -> None:
        self._config, self._folder, self._count = config, folder, 0

    def __call__(self, launch: str | Path, settings: Mapping[str, object] | None = None) -> ReplayedRun:
        """Replay a launch file, in lockstep and without sockets, into the test's tmp_path.

        Runs in pytest's root folder: what is relative, in the launch file too, is meant from there.

        Args:
            launch: path of the launch file.
            settings: changes to it, such as {"model.steps": 1}; what `gcd-node run --set` takes.
        Raises:
            ConfigError, SourceError, CheckpointError and others: as `gcd-node replay`.
        """
        from gcd_node.config import load_config, to_change
        from gcd_node.replay.lockstep import replay

        changes = [to_change(key, value) for key, value in (settings or {}).items()]
        folder = self._folder / f"gcd-run-{self._count}"
        self._count += 1
        with contextlib.chdir(self._config.rootpath):
            return ReplayedRun(replay(load_config(Path(launch), changes), folder), self._config)


@pytest.fixture
def gcd_replay(request: pytest.FixtureRequest, tmp_path: Path) -> ReplayFixture:
    """Replays launch files and compares them with golden runs; see ReplayFixture."""
    return ReplayFixture(request.config, tmp_path)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds --gcd-update."""
    explained = "make every golden run that a test asks for what it is now"
    parser.getgroup("gcd-node").addoption(_UPDATE, action="store_true", help=explained)
