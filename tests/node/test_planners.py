"""The planners of launch/clients follow a live node, and take nothing that must not be used."""

import itertools
import time
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cameras import Bench, Camera, until
from fakes import FakeSynthesizer, painting_traits
from msgspec.structs import replace
from rig import Rig
from wire_messages import class_map, depth, visibility

from gcd_client.protocol import ClassRecord
from gcd_client.subscriber import ReceivedView

pytestmark = pytest.mark.timeout(120)


def planner(name: str = "planner") -> dict[str, Any]:
    """What a program in launch/clients defines."""
    path = Path(__file__).parents[2] / "launch" / "clients" / f"{name}.py"
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


def test_the_planner_follows_a_node_to_its_end_and_into_its_next_life(tmp_path: Path) -> None:
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


def arrived(message: Any, **how: object) -> ReceivedView:
    said = {"age_ms": message.header.age_ms, "expired": False, "skipped": 0, "restarted": False, **how}
    return ReceivedView(message=message, **said)


class Scripted:
    """A subscriber that gives what a test lists, or leaves out a stale view."""

    ended, stale = False, 0

    def __init__(self, *given: ReceivedView | str | None) -> None:
        self._given = list(given)

    def receive(self, timeout_ms: float) -> ReceivedView | None:
        item = self._given.pop(0)
        self.stale += item == "stale"
        return item if isinstance(item, ReceivedView) else None


def test_the_planner_drops_what_is_stale_late_or_of_another_epoch(tmp_path: Path) -> None:
    classes = (ClassRecord(id=0, name="road", colour=(0, 0, 0)), ClassRecord(id=1, name="car", colour=(0, 0, 255)))
    message = class_map(drawn=np.ones((14, 4, 6), np.uint8))
    message = replace(message, header=replace(message.header, classes=classes))
    src = replace(message.header.src, epoch=message.header.src.epoch + 1)
    good, jumped = arrived(message), arrived(replace(message, header=replace(message.header, src=src)))
    awareness = planner()["Awareness"](f"ipc://{tmp_path}/data", "main")
    awareness.close()
    awareness._views = Scripted(good, None, "stale", good, jumped, arrived(message, expired=True))
    assert awareness.poll() is good
    assert awareness.poll() is good  # nothing new, and not run out yet
    assert awareness.poll() is None
    assert awareness.why_not == "what comes is older than max_age_ms"
    assert awareness.poll() is good
    assert awareness.poll() is jumped
    assert awareness.why_not == "the camera's clock or format jumped"
    assert awareness.poll() is None
    assert awareness.why_not == "it came too late"


def seen_by(vis: np.ndarray, inverse: np.ndarray, **header: object) -> list[ReceivedView]:
    """Both maps of one window, whose camera stands 2 m ahead of the source camera."""
    pose = np.eye(4)
    pose[2, 3] = 2.0
    messages = visibility(seen=vis), depth(inverse=inverse.astype("<f2"))
    changes = {"source_from_view": (tuple(pose.ravel().tolist()),) * 2, "pose_units": "m"}
    changes["quality"] = replace(messages[0].header.quality, ood=())
    return [arrived(replace(each, header=replace(each.header, **changes | header))) for each in messages]


def test_obstacles_are_what_was_seen_now_and_stand_where_it_was() -> None:
    defined = planner("obstacles")
    chance = np.random.default_rng(0)
    vis = chance.integers(0, 3, (2, 4, 6), np.uint8)
    inverse = np.where(chance.random((2, 4, 6)) < 0.2, 0.0, 1 / chance.uniform(1, 50, (2, 4, 6)))
    seen, far = seen_by(vis, inverse)
    points = defined["seen_points"](seen, far)
    shown = (vis[-1] == 2) & (inverse[-1] > 0)
    assert len(points) == shown.sum() > 0
    x, y, z = points.T - np.array([[0.0], [0.0], [2.0]])  # back in the view's axes
    fx, _, cx, _, fy, cy, *_ = far.header.intrinsics or ()
    assert np.allclose((fx * x / z + cx, fy * y / z + cy), np.nonzero(shown)[::-1])
    assert np.allclose(1 / z, inverse[-1][shown], rtol=5e-4)
    unusual = replace(far.header.quality, ood=("fps",))
    for change in ({"pose_units": "scene"}, {"intrinsics": None}, {"source_from_view": None}, {"quality": unusual}):
        assert len(defined["seen_points"](*seen_by(vis, inverse, **change))) == 0
    everywhere = np.full((2, 4, 6), 1 / 8.0)
    for state, metres in ((2, 10.0), (1, np.inf), (0, np.inf)):  # it brakes for nothing painted
        points = defined["seen_points"](*seen_by(np.full((2, 4, 6), state, np.uint8), everywhere))
        assert defined["nearest_ahead_m"](points) == metres


def test_obstacles_never_join_two_windows(tmp_path: Path) -> None:
    obstacles = planner("obstacles")["SeenObstacles"](f"ipc://{tmp_path}/data", "main")
    obstacles.maps.close()
    seen, far = seen_by(np.full((2, 4, 6), 2, np.uint8), np.full((2, 4, 6), 0.1))
    later = replace(far, message=replace(far.message, header=replace(far.header, window_id=1)))
    late = replace(far, expired=True)
    obstacles.maps = Scripted(far, seen, later, far, seen, None, late, seen, far)
    assert [obstacles.poll() is None for _ in range(9)] == [True] * 8 + [False]
