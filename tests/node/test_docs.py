"""The pages tell the truth: links lead somewhere, launch files load, commands exist, every key of a launch file
is told, and the planner of the guide follows a live node."""

import ast
import itertools
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
import types
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np
import pytest
from cameras import Bench, Camera, until
from doc_pages import (
    BLOCKS,
    LINKED,
    PAGES,
    ROOT,
    WHOLE,
    Block,
    dead_links,
    name_of,
    pages_named_in_code,
    wrong_commands,
)
from fakes import FakeSynthesizer, painting_traits
from msgspec.structs import replace
from rig import Rig
from wire_messages import class_map, depth, visibility

from gcd_client.protocol import ClassRecord
from gcd_client.subscriber import ReceivedView
from gcd_node.config import NodeConfig, ViewConfig, parse_config
from gcd_node.sources import SourceConfig, SourcePose

pytestmark = pytest.mark.timeout(120)

SMALLER = {
    "--scenes 20 --compact": "--scenes 1 --compact --frames 14 --width 96 --height 64",
    "--clips 100": "--clips 3",
    "--clips 40": "--clips 2",
}
"""What a page's commands make, and what is made here instead."""


def test_every_link_leads_somewhere() -> None:
    assert [dead for page in LINKED for dead in dead_links(page, page.read_text())] == []


def test_every_page_that_the_code_names_is_there() -> None:
    named = pages_named_in_code()
    assert "docs/node.md" in named
    assert {page: path for page, path in named.items() if not (ROOT / page).exists()} == {}


def test_the_index_names_every_page() -> None:
    index = (ROOT / "docs" / "README.md").read_text()
    assert [page.name for page in (ROOT / "docs").glob("*.md") if f"({page.name})" not in index + "(README.md)"] == []


def load_block(block: Block) -> None:
    """A launch file, or a part of one (what it lacks is filled in). Raises what is wrong with it."""
    table = tomllib.loads(block.text)
    if block.mark == "other":
        return
    stated = {"source.kind": table.get("source", {}).keys() & {"kind", "path"}, "model.weights": table.get("model")}
    stated["view.topdown.kind"] = table.get("view")
    lacking = [change for change in WHOLE if not stated[change.partition("=")[0]]]
    parse_config(block.text.encode(), block.place, () if block.mark == "launch" else lacking)


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.language == "toml"], ids=lambda block: block.place)
def test_a_toml_block_loads(block: Block) -> None:
    """Mark it `toml launch` if it is whole, `toml other` if it is no launch file."""
    load_block(block)


def test_every_key_of_a_launch_file_is_in_its_table() -> None:
    kinds = get_args(SourceConfig)
    sections = [field.type for field in msgspec.structs.fields(NodeConfig) if isinstance(field.type, type)]
    structs = [NodeConfig, *kinds, SourcePose, ViewConfig, *(s for s in sections if issubclass(s, msgspec.Struct))]
    page = (ROOT / "docs" / "launch-file.md").read_text()
    keys = {field.name for struct in structs for field in msgspec.structs.fields(struct)}
    assert len(keys) > 80
    assert sorted(key for key in keys if not re.search(rf"[`.\[]{key}[`.\]]", page)) == []


def test_every_command_and_option_exists() -> None:
    assert [wrong for page in PAGES for wrong in wrong_commands(name_of(page), page.read_text())] == []


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.language == "python"], ids=lambda block: block.place)
def test_a_python_block_is_python(block: Block) -> None:
    assert compile(block.text, block.place, "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT) is not None


@pytest.mark.parametrize(
    "block", [b for b in BLOCKS if (b.language, b.mark) == ("python", "run")], ids=lambda b: b.place
)
def test_a_python_block_marked_run_runs(block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # no node of this machine hears of it
    exec(compile(block.text, block.place, "exec"), {})


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


@pytest.mark.slow
@pytest.mark.timeout(900)
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


def planner(name: str = "planner") -> dict[str, Any]:
    """What a program in launch/clients defines."""
    path = ROOT / "launch" / "clients" / f"{name}.py"
    defined: dict[str, Any] = {"__name__": name}
    exec(compile(path.read_text(), path, "exec"), defined)
    return defined


def held(awareness: Any, camera: Camera) -> Any:
    """The next view that the planner holds, while the camera goes on. Its stamps lie on an even grid in the past: a
    window of them takes as long as this machine needs, and none is spoilt by a slow one."""
    found: list[Any] = []
    stamps = itertools.count(time.monotonic_ns() - 1_000_000_000_000, round(1e9 / camera.info.fps_nominal))

    def look() -> bool:
        camera.shoot(stamp_ns=next(stamps))
        found.append(awareness.poll(wait_ms=10.0))
        return found[-1] is not None

    until(look)
    return found[-1]


def live(folder: Path, camera: Camera) -> Rig:
    """A node whose model draws class maps; it has just begun."""
    return Rig(folder, Bench(camera), FakeSynthesizer(painting_traits()), views="[view.main]", watched=False)


def test_the_planner_of_the_guide_follows_a_node_to_its_end_and_into_its_next_life(tmp_path: Path) -> None:
    defined = planner()
    awareness = defined["Awareness"](f"ipc://{tmp_path}/data", "main", max_age_ms=1e9)
    assert awareness.poll() is None
    assert awareness.why_not == "nothing has come yet"
    with live(tmp_path, camera := Camera(fps=10.0)):
        first = held(awareness, camera)
        assert 0.0 < defined["caution"](first) <= 1.0
    until(lambda: awareness.poll(wait_ms=10) is None and awareness.ended)
    assert awareness.why_not == "the stream has ended"
    with live(tmp_path, camera := Camera(fps=10.0)):
        second = held(awareness, camera)
        assert second.header.boot_id != first.header.boot_id
        assert awareness.why_not == "the node was started anew"
        assert not awareness.ended
        defined["time"] = types.SimpleNamespace(monotonic=lambda: awareness._until_s + 0.001)
        until(lambda: awareness.poll() is None)
        assert awareness.why_not == "the last one has expired"
    awareness.close()


def received(**changes: object) -> ReceivedView:
    """A class map as it arrives; changes: of `ReceivedView`, and of its header."""
    header = {key: changes.pop(key) for key in ("src", "quality") if key in changes}
    classes = (ClassRecord(id=0, name="road", colour=(0, 0, 0)), ClassRecord(id=1, name="car", colour=(0, 0, 255)))
    message = class_map(drawn=np.ones((14, 4, 6), np.uint8))
    message = replace(message, header=replace(message.header, classes=classes, **header))
    how = {"age_ms": message.header.age_ms, "expired": False, "skipped": 0, "restarted": False}
    return ReceivedView(message=message, **{**how, **changes})


class Scripted:
    """A subscriber that gives what a test lists, or leaves out a stale view."""

    ended, stale = False, 0

    def __init__(self, *given: ReceivedView | str | None) -> None:
        self._given = list(given)

    def receive(self, timeout_ms: float) -> ReceivedView | None:
        item = self._given.pop(0)
        self.stale += item == "stale"
        return item if isinstance(item, ReceivedView) else None


def scripted(folder: Path, *given: ReceivedView | str | None) -> Any:
    awareness = planner()["Awareness"](f"ipc://{folder}/data", "main")
    awareness.close()
    awareness._views = Scripted(*given)
    return awareness


def test_the_planner_of_the_guide_drops_what_is_stale_late_or_of_another_epoch(tmp_path: Path) -> None:
    good, old_src = received(), received().header.src
    jumped = received(src=replace(old_src, epoch=old_src.epoch + 1))
    awareness = scripted(tmp_path, good, None, "stale", good, jumped, received(expired=True))
    assert awareness.poll() is good
    assert awareness.poll() is good  # nothing new, and not run out yet
    assert awareness.poll() is None
    assert awareness.why_not == "what comes is older than max_age_ms"
    assert awareness.poll() is good
    assert awareness.poll() is jumped
    assert awareness.why_not == "the camera's clock or format jumped"
    assert awareness.poll() is None
    assert awareness.why_not == "it came too late"


def seen_by(vis: np.ndarray, inverse: np.ndarray, **header: object) -> tuple[ReceivedView, ReceivedView]:
    """Both maps of one window, whose camera stands 2 m ahead of the source camera."""
    pose = np.eye(4)
    pose[2, 3] = 2.0
    messages = visibility(seen=vis), depth(inverse=inverse.astype("<f2"))
    changes = {"source_from_view": (tuple(pose.ravel().tolist()),) * 2, "pose_units": "m", **header}
    quality = replace(messages[0].header.quality, ood=())
    how = {"age_ms": 0.0, "expired": False, "skipped": 0, "restarted": False}
    made = [replace(each, header=replace(each.header, **{"quality": quality, **changes})) for each in messages]
    return ReceivedView(message=made[0], **how), ReceivedView(message=made[1], **how)


def test_the_obstacles_of_the_guide_are_what_was_seen_now_and_stand_where_it_was() -> None:
    defined = planner("obstacles")
    chance = np.random.default_rng(0)
    vis = chance.integers(0, 3, (2, 4, 6), np.uint8)
    inverse = np.where(chance.random((2, 4, 6)) < 0.2, 0.0, 1 / chance.uniform(1, 50, (2, 4, 6)))
    seen, far = seen_by(vis, inverse)
    points = defined["seen_points"](seen, far)
    shown = (vis[-1] == 2) & (inverse[-1] > 0)
    assert len(points) == shown.sum() > 0
    x, y, z = points.T - np.array([[0.0], [0.0], [2.0]])  # back in the view's axes
    fx, _, cx, _, fy, cy, *_ = far.header.intrinsics
    assert np.allclose((fx * x / z + cx, fy * y / z + cy), np.nonzero(shown)[::-1])
    assert np.allclose(1 / z, inverse[-1][shown], rtol=5e-4)
    for change in ({"pose_units": "scene"}, {"intrinsics": None}, {"source_from_view": None}):
        assert len(defined["seen_points"](*seen_by(vis, inverse, **change))) == 0
    unusual = replace(far.header.quality, ood=("fps",))
    assert len(defined["seen_points"](*seen_by(vis, inverse, quality=unusual))) == 0
    everywhere = np.full((2, 4, 6), 1 / 8.0)
    for state, metres in ((2, 10.0), (1, np.inf), (0, np.inf)):  # it brakes for nothing painted
        points = defined["seen_points"](*seen_by(np.full((2, 4, 6), state, np.uint8), everywhere))
        assert defined["nearest_ahead_m"](points) == metres


def test_the_obstacles_of_the_guide_never_join_two_windows(tmp_path: Path) -> None:
    obstacles = planner("obstacles")["SeenObstacles"](f"ipc://{tmp_path}/data", "main")
    obstacles.maps.close()
    seen, far = seen_by(np.full((2, 4, 6), 2, np.uint8), np.full((2, 4, 6), 0.1))
    later = replace(far, message=replace(far.message, header=replace(far.header, window_id=1)))
    late = replace(far, expired=True)
    obstacles.maps = Scripted(far, seen, later, far, seen, None, late, seen, far)
    assert [obstacles.poll() is None for _ in range(9)] == [True] * 8 + [False]
