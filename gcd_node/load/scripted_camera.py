"""A live camera that misbehaves by a script: drops, repeats, reverses, stalls, changes size, dies and comes back."""

import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from gcd_node.errors import SourceAbsentError, SourceLostError
from gcd_node.frame import Frame, Image, SourceInfo

Act: TypeAlias = Literal[
    "steady", "drop", "repeat", "reverse", "clock_step", "damage", "stall", "silence", "deaf", "resize", "die"
]
"""steady: a second of good frames. drop: three frames are missing. repeat: a frame comes twice. reverse: a stamp lies
before the last one. clock_step: stamps jump back by 3 s for a second. damage: every second frame is damaged. stall:
silence that ends. silence: silence until the camera is closed. deaf: the driver does not return, not even when it is
closed. resize: a second of larger pictures. die: the camera is gone for `outage_s`, and then there again."""

ACTS: tuple[Act, ...] = (
    "steady", "drop", "repeat", "reverse", "clock_step", "damage", "stall", "silence", "deaf", "resize", "die"
)  # fmt: skip

_SECOND_NS = 1_000_000_000
_REMEMBERED = 4096
_PICTURES = 4
_DROPPED = 3
_STALL_S, _DEAF_S, _SILENCE_S = 0.6, 3.0, 30.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Return:
    """A camera came back: when it could be opened again, and when its first frame was taken, monotonic clock."""

    plugged_ns: int
    first_ns: int
    first_seq: int


class CameraScript:
    """One camera over all its openings. Frames are numbered through; every method may be called from any thread.

    acts: what it does, one after another; steady once they are used up.
    size: width and height; never smaller than what the model takes. outage_s: see "die". half_s: of good frames, before
    whatever an act does, and after; for tests that cannot wait a second.
    """

    def __init__(
        self,
        acts: Iterator[Act],
        *,
        fps: float = 24.0,
        size: tuple[int, int] = (480, 320),
        outage_s: float = 1.0,
        half_s: float = 0.5,
    ) -> None:
        self.fps, self.size, self.outage_s, self.half_s = fps, size, outage_s, half_s
        self.larger = (size[0] * 4 // 3, size[1] * 3 // 2)
        self.done: Counter[Act] = Counter()
        """How often each act was played."""
        self.openings = 0
        self.returns: list[Return] = []
        self._acts, self._lock = acts, threading.Lock()
        self._pictures = {each: _drawn(each) for each in (self.size, self.larger)}
        self._taken: OrderedDict[int, int] = OrderedDict()
        self._seq = 0
        self._plugged_ns: int | None = None

    def open(self) -> "ScriptedCamera":
        """Open it. Raises SourceAbsentError while it is gone."""
        plugged_ns = self._plugged_ns
        if plugged_ns is not None and time.monotonic_ns() < plugged_ns:
            raise SourceAbsentError("the scripted camera is gone; it comes back by itself")
        self.openings += 1
        return ScriptedCamera(self)

    def taken_ns(self, seq: int) -> int | None:
        """When a frame was taken, whatever its stamp says; None for one long gone."""
        with self._lock:
            return self._taken.get(seq)

    def next_act(self) -> Act:
        """What comes next."""
        with self._lock:
            act: Act = next(self._acts, None) or "steady"
            self.done[act] += 1
            return act

    def picture(self, size: tuple[int, int], seq: int) -> Image:
        """One of a few, so that no two in a row are the same."""
        pictures = self._pictures[size]
        return pictures[seq % len(pictures)]

    def count(self, taken_ns: int) -> int:
        """The number of a frame taken at that moment."""
        with self._lock:
            seq, self._seq = self._seq, self._seq + 1
            self._taken[seq] = taken_ns
            if len(self._taken) > _REMEMBERED:
                self._taken.popitem(last=False)
            if self._plugged_ns is not None:
                self.returns.append(Return(plugged_ns=self._plugged_ns, first_ns=taken_ns, first_seq=seq))
                self._plugged_ns = None
            del self.returns[:-_REMEMBERED]
            return seq

    def unplug(self) -> None:
        """It is gone for `outage_s` from now."""
        with self._lock:
            self._plugged_ns = time.monotonic_ns() + round(self.outage_s * _SECOND_NS)


class ScriptedCamera:
    """One opening of a CameraScript. Implements FrameSource."""

    def __init__(self, script: CameraScript) -> None:
        self._script = script
        self._closed = threading.Event()
        self._period_ns = round(_SECOND_NS / script.fps)
        self._size, self._clock_ns, self._due_ns = script.size, 0, 0
        self._corrupt = 0
        self._info = SourceInfo(
            kind="v4l2",
            id="scripted",
            width=script.size[0],
            height=script.size[1],
            fps_nominal=script.fps,
            clock="realtime",
        )

    @property
    def corrupt(self) -> int:
        """Frames of "damage"."""
        return self._corrupt

    @property
    def info(self) -> SourceInfo:
        """Of the usual size."""
        return self._info

    def frames(self) -> Iterator[Frame]:
        """Play the script until it is closed. See FrameSource. Raises SourceLostError for "die"."""
        self._due_ns = time.monotonic_ns()
        while not self._closed.is_set():
            yield from self._play(self._script.next_act())

    def close(self) -> None:
        """End `frames`, from any thread; "deaf" takes its time."""
        self._closed.set()

    def _play(self, act: Act) -> Iterator[Frame]:
        half = round(self._script.fps * self._script.half_s)
        yield from self._take(half)
        if act in ("stall", "silence", "deaf"):
            self._hold(act)
        elif act == "drop":
            self._due_ns += _DROPPED * self._period_ns
        elif act in ("repeat", "reverse"):
            yield from self._again(0 if act == "repeat" else 2)
        elif act == "clock_step":
            self._clock_ns -= 3 * _SECOND_NS
        elif act == "resize":
            self._size = self._script.larger
        elif act == "damage":
            yield from self._damaged(half)
        elif act == "die" and not self._closed.is_set():
            self._script.unplug()
            raise SourceLostError("the scripted camera was unplugged")
        yield from self._take(2 * half if act in ("clock_step", "resize") else half)
        self._size, self._clock_ns = self._script.size, 0

    def _take(self, count: int) -> Iterator[Frame]:
        """Frames on an even grid, each at its time."""
        for _ in range(count):
            if not self._wait():
                return
            yield self._frame(self._due_ns)
            self._due_ns += self._period_ns

    def _again(self, periods: int) -> Iterator[Frame]:
        """A frame whose stamp is that of the last one, or so many periods before it."""
        if self._wait():
            yield self._frame(self._due_ns, late_ns=(1 + periods) * self._period_ns)

    def _damaged(self, count: int) -> Iterator[Frame]:
        for _ in range(count // 2):
            self._corrupt += 1
            self._due_ns += self._period_ns
            yield from self._take(1)

    def _hold(self, act: Act) -> None:
        if act == "deaf":
            time.sleep(_DEAF_S)
        else:
            self._closed.wait(_STALL_S if act == "stall" else _SILENCE_S)
        self._due_ns = time.monotonic_ns()

    def _wait(self) -> bool:
        """Until the next frame is due; False if the camera was closed."""
        left_ns = self._due_ns - time.monotonic_ns()
        return not (self._closed.wait(left_ns / _SECOND_NS) if left_ns > 0 else self._closed.is_set())

    def _frame(self, taken_ns: int, *, late_ns: int = 0) -> Frame:
        seq = self._script.count(taken_ns)
        image = self._script.picture(self._size, seq)
        return Frame(image=image, stamp_ns=taken_ns + self._clock_ns - late_ns, seq=seq)


def _drawn(size: tuple[int, int]) -> list[Image]:
    chance = np.random.default_rng(0)
    return [chance.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8) for _ in range(_PICTURES)]
