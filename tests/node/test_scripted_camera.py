"""The camera and the model that stand in under load: they misbehave as they say, and only so."""

import threading
import time
from collections.abc import Iterator
from itertools import islice, pairwise

import pytest
import torch

from gcd_model import Cancelled, Clip, NonFiniteError, RenderOptions, SphericalDelta
from gcd_node.errors import SourceAbsentError, SourceLostError
from gcd_node.frame import Frame
from gcd_node.load.scripted_camera import ACTS, Act, CameraScript, ScriptedCamera
from gcd_node.load.stand_in import StandInModel

SIZE = (96, 64)
FPS = 200.0  # twenty times as fast as a camera, for the tests' sake
HALF = 20


def script(*acts: Act, outage_s: float = 0.05) -> CameraScript:
    return CameraScript(iter(acts), fps=FPS, size=SIZE, outage_s=outage_s, half_s=HALF / FPS)


def taken(*acts: Act, count: int = 3 * HALF) -> tuple[ScriptedCamera, list[Frame]]:
    """The first frames of a camera that plays these acts."""
    camera = script(*acts).open()
    return camera, list(islice(camera.frames(), count))


def steps_ms(frames: list[Frame]) -> list[float]:
    """From each stamp to the next, in frame periods of 5 ms rounded to 0.1."""
    return [round((b.stamp_ns - a.stamp_ns) / 5e6, 1) for a, b in pairwise(frames)]


def test_a_steady_camera_keeps_its_grid_and_numbers_every_frame() -> None:
    _, frames = taken("steady", "steady")
    assert set(steps_ms(frames)) == {1.0}
    assert [frame.seq for frame in frames] == list(range(3 * HALF))
    assert {frame.size for frame in frames} == {SIZE}


@pytest.mark.parametrize(
    ("act", "step", "count"), [("drop", 4.0, 1), ("repeat", 0.0, 1), ("reverse", -2.0, 1), ("damage", 2.0, HALF // 2)]
)
def test_a_fault_shows_in_the_stamps(act: Act, step: float, count: int) -> None:
    camera, frames = taken(act)
    assert steps_ms(frames).count(step) == count
    assert camera.corrupt == (count if act == "damage" else 0)


def test_a_clock_step_goes_back_three_seconds_and_then_forward_again() -> None:
    _, frames = taken("clock_step", count=4 * HALF)
    assert [step for step in steps_ms(frames) if abs(step) > 500] == [1.0 - 600.0, 1.0 + 600.0]


def test_larger_pictures_come_for_a_second() -> None:
    _, frames = taken("resize", count=4 * HALF)
    assert [frame.size for frame in frames].count((128, 96)) == 2 * HALF


def test_a_dead_camera_is_absent_until_its_outage_is_over() -> None:
    dying = script("die", outage_s=0.2)
    with pytest.raises(SourceLostError):
        list(dying.open().frames())
    with pytest.raises(SourceAbsentError):
        dying.open()
    until = time.monotonic() + 20
    camera = None
    while camera is None and time.monotonic() < until:
        try:
            camera = dying.open()
        except SourceAbsentError:
            time.sleep(0.02)
    assert camera is not None
    first = next(iter(camera.frames()))
    (back,) = dying.returns
    assert back.first_seq == first.seq == HALF
    assert back.first_ns >= back.plugged_ns
    assert dying.taken_ns(first.seq) == back.first_ns


@pytest.mark.parametrize("act", [act for act in ACTS if act not in ("die", "deaf")])
def test_closing_ends_every_act(act: Act) -> None:
    camera = script(act).open()
    closing = threading.Timer(0.3, camera.close)
    closing.start()
    last = sum(1 for _ in camera.frames())
    closing.join()
    assert last > 0


def test_the_moment_of_a_frame_is_remembered_for_a_while_only() -> None:
    steady = script()
    frames: Iterator[Frame] = steady.open().frames()
    first = next(frames)
    assert steady.taken_ns(first.seq) == first.stamp_ns
    assert steady.taken_ns(first.seq + 1) is None
    for _ in range(5000):
        steady.count(0)
    assert steady.taken_ns(first.seq) is None


# --- the model ---------------------------------------------------------------------------------------------------


def clip(model: StandInModel) -> Clip:
    config = model.traits.config
    return Clip(video=torch.zeros(config.frames, 3, config.height, config.width), fps=12.0)


def test_the_stand_in_gives_ready_pixels_for_every_path() -> None:
    model = StandInModel(width=96, height=64)
    paths = [model.traits.plan_view(SphericalDelta(azimuth_deg=each)) for each in (0.0, 30.0)]
    views = model.render(model.encode(clip(model)), paths, RenderOptions(samples=2))
    assert [view.trajectory for view in views] == paths
    assert views[0].samples.shape == (2, 14, 3, 64, 96)
    levels = views[0].video
    assert levels.dtype == torch.uint8
    assert levels.min() < 50 < 200 < levels.max()


def test_the_stand_in_notes_when_it_was_given_a_clip_and_takes_its_time() -> None:
    model = StandInModel(width=96, height=64, work_s=0.05)
    before_ns = time.monotonic_ns()
    features = model.encode(clip(model))
    assert before_ns <= model.taken_ns <= time.monotonic_ns()
    model.render(features, [model.traits.plan_view(SphericalDelta())])
    assert time.monotonic_ns() - model.taken_ns >= 50_000_000


def test_the_stand_in_hears_that_it_should_stop() -> None:
    model, cancel = StandInModel(width=96, height=64, work_s=60.0), threading.Event()
    cancel.set()
    with pytest.raises(Cancelled):
        model.render(model.encode(clip(model)), [], RenderOptions(cancel=cancel))


def test_the_stand_in_fails_as_often_as_it_was_told() -> None:
    model = StandInModel(width=96, height=64, nan_every=3)
    features, failed = model.encode(clip(model)), []
    for number in range(6):
        try:
            model.render(features, [])
        except NonFiniteError:
            failed.append(number)
    assert failed == [2, 5]
