"""Models that work frame by frame: a view of every frame, nothing remembered across a break of the source, and three
threads beside a live one."""

import os
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import pytest
from fakes import Box, FakeSource, FakeSynthesizer, fake_config, run, traits
from msgspec.structs import replace as struct_replace

from gcd_model import DeviceMemoryError, NonFiniteError, RenderOptions, SourceFeatures, Trajectory, View
from gcd_node.config import ModelSection
from gcd_node.errors import ModelFailedError
from gcd_node.frame import Frame
from gcd_node.lifecycle import Parts
from gcd_node.node import Node


class Streaming(FakeSynthesizer):
    """Notes after how many frames it was told to forget."""

    def __init__(self, act: object = None) -> None:
        super().__init__(replace(traits(), config=struct_replace(traits().config, frames=1), move_time=0), act)  # type: ignore[arg-type]
        self.resets: list[int] = []

    def streaming(self) -> "Streaming":
        return self

    def reset(self) -> None:
        self.resets.append(len(self.asked))

    def see(self, features: SourceFeatures) -> Any:
        return (features,)

    def place(self, seen: Any, trajectories: Sequence[Trajectory]) -> Any:
        return seen

    def paint(
        self, placed: Any, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        return self.render(placed[0], trajectories, options)


class Stepping(FakeSource):
    """Its clock jumps by an hour before frame 10."""

    def frames(self) -> Iterator[Frame]:
        for frame in super().frames():
            yield frame if frame.seq < 10 else replace(frame, stamp_ns=frame.stamp_ns + 3600 * 10**9)


def test_every_frame_gives_a_view_and_a_break_of_the_source_is_a_beginning() -> None:
    model = Streaming()
    box = run(fake_config(), model, Stepping(20))
    assert box.seqs() == box.ids() == list(range(20))
    assert model.resets == [0, 10]


def failing_once(after: int) -> Streaming:
    """With NaN, once it has drawn so many."""
    failing = iter([True])

    def act(_: RenderOptions) -> None:
        if len(model.asked) > after and next(failing, False):
            raise NonFiniteError("for once")

    model = Streaming(act)
    return model


def test_a_frame_that_is_rendered_again_is_the_first_one_then() -> None:
    model = failing_once(4)
    assert run(fake_config(), model, FakeSource(8)).seqs() == list(range(8))
    assert model.resets == [0, 5]


class SideBySide(Streaming):
    """Paints frame 3 only while it and those after it are so many `at_once` in work, and no more. Notes the threads."""

    def __init__(self, at_once: int) -> None:
        super().__init__()
        self.threads = {name: set[str]() for name in ("see", "place", "paint")}
        self._at_once, self._all, self._more, self.met = at_once, threading.Event(), threading.Event(), False

    def _note(self, step: str) -> None:
        self.threads[step].add(threading.current_thread().name)

    def see(self, features: SourceFeatures) -> Any:
        self._note("see")
        if len(self.clips) == 4 + self._at_once:
            self._all.set()
        if len(self.clips) > 4 + self._at_once:
            self._more.set()
        return super().see(features)

    def place(self, seen: Any, trajectories: Sequence[Trajectory]) -> Any:
        self._note("place")
        return super().place(seen, trajectories)

    def paint(
        self, placed: Any, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        self._note("paint")
        if len(self.asked) == 4:
            self.met = self._all.wait(10) and not self._more.wait(0.2)
        return super().paint(placed, trajectories, options)


def live(model: Streaming, frames: int = 12) -> Box:
    """Beside a live source, 20 frames a second."""
    return run(fake_config("source.pace=realtime"), model, FakeSource(frames, period_s=0.05))


@pytest.fixture(autouse=True)
def cores(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> int:
    count = getattr(request, "param", 4)
    monkeypatch.setattr(os, "sched_getaffinity", {0: range(count)}.__getitem__)
    return count


@pytest.mark.parametrize("cores", [2, 4], indirect=True)
def test_beside_a_live_source_three_frames_are_in_work_at_once_and_on_two_cores_two(cores: int) -> None:
    model = SideBySide(min(cores, 3))
    seqs = live(model).seqs()
    assert model.met
    assert model.threads == {"see": {"model"}, "place": {"placer"}, "paint": {"painter"}}
    assert seqs == sorted(set(seqs))
    assert seqs[-1] == 11
    assert not {"painter", "placer"} & {thread.name for thread in threading.enumerate()}


def test_what_fails_in_the_painter_is_done_again_or_ends_the_node() -> None:
    model = failing_once(5)
    assert live(model).seqs()[-1] == 11
    assert len(model.resets) == 2

    def broken(_: RenderOptions) -> None:
        if len(model.asked) > 5:
            raise ValueError("broken")

    model = Streaming(broken)
    with pytest.raises(ModelFailedError, match="broken"):
        live(model, 1000)


class Remembering(Streaming):
    """Frame 2 fails in the painter while frame 3 is placed and frame 4 seen. Notes frames that do not go on where the
    one before ended, in place and paint: every `reset` begins another world."""

    def __init__(self, error: Exception) -> None:
        super().__init__()
        self._world, self._fourth, self._failing = 0, threading.Event(), iter([error])
        self._at = {"see": 0, "place": 0, "paint": 0}
        self.strays: list[tuple[str, int]] = []

    def reset(self) -> None:
        super().reset()
        self._world += 1

    def see(self, features: SourceFeatures) -> Any:
        if len(self.clips) == 6:
            self._fourth.set()
        begins, self._at["see"] = self._world != self._at["see"], self._world
        return features, self._world, begins

    def _follow(self, step: str, world: int, begins: bool) -> None:
        if not begins and world != self._at[step]:
            self.strays.append((step, world))
        self._at[step] = world

    def place(self, seen: Any, trajectories: Sequence[Trajectory]) -> Any:
        self._follow("place", *seen[1:])
        return seen

    def paint(
        self, placed: Any, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        self._follow("paint", *placed[1:])
        if len(self.asked) == 3 and self._fourth.wait(10):
            for error in self._failing:
                raise error
        return self.render(placed[0], trajectories, options)


@pytest.mark.parametrize("error", [NonFiniteError("for once"), DeviceMemoryError("for once")])
def test_frames_that_were_in_work_when_the_memory_began_anew_are_left_out(error: Exception) -> None:
    model = Remembering(error)
    seqs = live(model).seqs()
    assert (seqs[:4], seqs[-1], model.strays) == ([0, 1, 2, 5], 11, [])


def test_a_model_that_is_loaded_in_half_precision_is_loaded_once_and_is_not_hung_meanwhile() -> None:
    loaded: list[str | None] = []

    def load(section: ModelSection) -> Streaming:
        loaded.append(section.dtype)
        time.sleep(0.6 if section.dtype else 0.0)
        model = Streaming(lambda _: None if section.dtype or len(model.asked) < 4 else full())
        model.traits = replace(model.traits, device="cuda:0", precision=section.dtype or "float32")
        return model

    def full() -> None:
        raise DeviceMemoryError("full")

    config, box, source = fake_config("source.pace=realtime", "life.hang_s=0.3"), Box(), FakeSource(30, period_s=0.05)
    Node(config, Parts(open_source=lambda _: source, load_model=load), box).run()
    assert loaded == [None, "bfloat16"]
    assert [fields["code"] for fields in box.told("event")] == ["GPU_OOM", "SRC_ENDED"]
    assert box.of("win")[-1].header.model.precision == "bfloat16"
