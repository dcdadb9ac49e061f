"""Frames become windows: resampled by their stamps to the rate the network was trained at, T at a time."""

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gcd_node.errors import ConfigError
from gcd_node.frame import MAX_FPS, Frame, Image
from gcd_node.time_grid import TimeGrid
from gcd_node.window_pixels import WindowPixels

Reason: TypeAlias = Literal["WIN_GAP", "CLOCK_STEP", "SRC_FORMAT", "SRC_LOST"]
"""Why frames did not become a window: a hole in time, a step of the source's clock, another picture size, a source
that was lost."""

RATE_TOLERANCE = 0.01
"""Rates that differ by this part are the same: 23.976 is 24."""

_LONGEST_STEP_NS = 1_000_000_000
_SURE = 0.05
_FOLLOW = 0.1


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class FrameWindow:
    """T frames at an even rate, still with their stamps.

    images: u8 [T, H, W, 3], RGB, read-only.
    clip: the same as the network takes them, float32 [T, 3, H, W] in [-1, 1]; not to be changed either.
    stamps_ns, seqs: of each frame, as the source gave them.
    window_id: counts windows, from where the builder was told to begin.
    fps: the rate the network is told.
    arrival_ns: when the newest frame arrived, on the monotonic clock.
    dropped: frames the builder has thrown away so far, for a stamp that did not rise.
    epoch: counts the restarts of the builder; stamps of different epochs cannot be compared.
    """

    images: Image
    clip: NDArray[np.float32]
    stamps_ns: tuple[int, ...]
    seqs: tuple[int, ...]
    window_id: int
    fps: float
    arrival_ns: int
    dropped: int
    epoch: int


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Filling:
    """The frames that the next window holds so far: from none to all but one. Fields as of FrameWindow, which will hold
    the same, if nothing comes between.

    clip: float32 [n, 3, H, W] in [-1, 1]; not to be changed.
    """

    clip: NDArray[np.float32]
    stamps_ns: tuple[int, ...]
    seqs: tuple[int, ...]
    fps: float
    epoch: int


@dataclass(frozen=True, kw_only=True, slots=True)
class WindowCounts:
    """What a builder has done so far.

    frames: pushed. placed: on the grid. built: windows. dropped: frames whose stamp did not rise.
    reasons: how often each reason has spoilt a window or restarted the builder.
    """

    frames: int
    placed: int
    built: int
    dropped: int
    reasons: dict[Reason, int]


@dataclass(frozen=True, kw_only=True, slots=True)
class _Arrived:
    frame: Frame
    arrival_ns: int


@dataclass(frozen=True, kw_only=True, slots=True)
class _Placed:
    """A frame on the grid; its pixels are among those of the next window."""

    stamp_ns: int
    seq: int
    arrival_ns: int


def choose_fps(source_fps: float, trained: Sequence[float]) -> tuple[float, bool]:
    """The rate to run at, and whether it lies outside what the network was trained with.

    Args:
        source_fps: frames per second the source can give.
        trained: rates the network knows; empty if any will do.
    Returns:
        The highest trained rate the source can give, False; without one, the source's own rate, True.
    Source: wire protocol, section 7, F8.
    """
    if not trained:
        return source_fps, False
    reachable = [fps for fps in trained if fps <= source_fps * (1 + RATE_TOLERANCE)]
    return (float(max(reachable)), False) if reachable else (source_fps, True)


class WindowBuilder:
    """Places frames on an even grid in time and cuts it into windows. No threads, no clock of its own.

    A grid point takes the frame nearest to it, no frame twice. A point without a frame within `max_skew` periods is a
    hole: the window it falls in is rejected (WIN_GAP) and the next begins behind it. A frame is never repeated.

    The grid starts at the first frame. If the source runs at the grid's own rate, it follows the source's clock
    slowly, so that every frame is used once however long the stream; else it is even.
    """

    def __init__(
        self,
        *,
        frames: int,
        fps: float,
        stride: int | None = None,
        max_skew: float = 0.5,
        source_fps: float | None = None,
        fit: Callable[[Image], Image] | None = None,
        first_id: int = 0,
        first_epoch: int = 0,
    ) -> None:
        """Make an empty builder.

        Args:
            frames: T, frames in a window.
            fps: of the grid; what the network is told.
            stride: grid points from one window to the next; T if left out.
            max_skew: how far a frame may lie from its grid point, in periods, up to 0.5.
            source_fps: nominal rate of the source, if known.
            fit: brings a picture to the network's size; called once for every frame on the grid, on arrival.
            first_id, first_epoch: of the first window, for a builder that goes on where another one ended.
        Raises:
            ConfigError: a number out of range.
        """
        self.frames = frames
        self._stride = frames if stride is None else stride
        self._max_skew = max_skew
        self._fit = fit
        self.run_at(fps, source_fps)
        self._placed: deque[_Placed] = deque()
        self._pixels = WindowPixels(frames)
        self._waiting: _Arrived | None = None
        self._newest: Frame | None = None
        self._skip = 0
        self._first_id, self._epoch = first_id, first_epoch
        self._totals: Counter[str] = Counter()
        self._reasons: Counter[Reason] = Counter()

    @property
    def counts(self) -> WindowCounts:
        """What was done so far."""
        totals = self._totals
        return WindowCounts(
            frames=totals["frames"],
            placed=totals["placed"],
            built=totals["built"],
            dropped=totals["dropped"],
            reasons=dict(self._reasons),
        )

    @property
    def next_id(self) -> int:
        """What the next window will be called."""
        return self._first_id + self._totals["built"]

    @property
    def filling(self) -> Filling:
        """What the next window holds so far."""
        placed = list(self._placed)
        return Filling(
            clip=self._pixels.filled(len(placed)),
            stamps_ns=tuple(each.stamp_ns for each in placed),
            seqs=tuple(each.seq for each in placed),
            fps=self.fps,
            epoch=self._epoch,
        )

    @property
    def epoch(self) -> int:
        """Of the window being built."""
        return self._epoch

    def push(self, frame: Frame, arrival_ns: int) -> list[FrameWindow]:
        """Take the next frame, and give the windows it completes; mostly none, hardly ever two.

        Args:
            frame: from the source, any size; sizes may change, stamps should rise.
            arrival_ns: when it arrived, on the monotonic clock.
        Raises:
            ConfigError: `fit` refuses the picture.
        """
        self._totals["frames"] += 1
        if self._newest is not None:
            if frame.size != self._newest.size:
                self.restart("SRC_FORMAT")
            elif self._is_clock_step(frame.stamp_ns - self._newest.stamp_ns):
                self.restart("CLOCK_STEP")
            elif frame.stamp_ns <= self._newest.stamp_ns:
                self._totals["dropped"] += 1
                return []
        if self._newest is None:
            self._grid.start(frame.stamp_ns)
        self._newest = frame
        return self._place(_Arrived(frame=frame, arrival_ns=arrival_ns))

    def flush(self) -> list[FrameWindow]:
        """At the end of the stream: place the last frame if it was only waiting for a nearer one."""
        waiting, self._waiting = self._waiting, None
        if waiting is None or abs(waiting.frame.stamp_ns - self._grid.next_ns) > self._skew_ns:
            return []
        return self._take(waiting)

    def restart(self, reason: Reason) -> None:
        """Forget all frames and begin a new epoch; counted under `reason`."""
        self._reasons[reason] += 1
        self._epoch += 1
        self._placed.clear()
        self._waiting = None
        self._newest = None
        self._skip = 0

    def run_at(self, fps: float, source_fps: float | None) -> None:
        """Another rate of the grid from here on; only before the first frame, or the first after `restart`.

        Args:
            fps, source_fps: as of a new builder.
        Raises:
            ConfigError: a number out of range.
        """
        if self.frames < 1 or self._stride < 1 or not 0 < fps <= MAX_FPS or not 0 < self._max_skew <= 0.5:
            raise ConfigError(
                f"a window needs frames >= 1, 0 < fps <= {MAX_FPS:g}, stride >= 1 and 0 < max_skew <= 0.5, "
                f"got {self.frames}, {fps:g}, {self._stride} and {self._max_skew:g}"
            )
        self.fps = fps
        self._skew_ns = self._max_skew * 1e9 / fps
        follows = source_fps is not None and abs(source_fps / fps - 1) <= RATE_TOLERANCE
        self._grid = TimeGrid(fps=fps, follow=_FOLLOW if follows else 0.0)

    def _is_clock_step(self, step_ns: int) -> bool:
        """Backwards by over a second, or forwards by over a second and a whole window."""
        return step_ns < -_LONGEST_STEP_NS or step_ns > max(_LONGEST_STEP_NS, self.frames * 1e9 / self.fps)

    def _place(self, arrived: _Arrived) -> list[FrameWindow]:
        """Settle all grid points up to the new frame, and those so near behind it that nothing can be nearer."""
        windows: list[FrameWindow] = []
        candidate: _Arrived | None = arrived
        while self._grid.next_ns <= arrived.frame.stamp_ns + _SURE * self._grid.period_ns:
            nearest = self._nearest(self._waiting, candidate)
            if nearest is None:
                self._hole()
                continue
            windows += self._take(nearest)
            self._waiting = None
            if nearest is candidate:
                candidate = None
        self._waiting = candidate
        return windows

    def _nearest(self, *candidates: _Arrived | None) -> _Arrived | None:
        """The candidate nearest to the next grid point; None if all are too far."""
        distances = [
            (abs(candidate.frame.stamp_ns - self._grid.next_ns), index)
            for index, candidate in enumerate(candidates)
            if candidate is not None
        ]
        distance_ns, index = min(distances, default=(self._skew_ns + 1, 0))
        return candidates[index] if distance_ns <= self._skew_ns else None

    def _hole(self) -> None:
        if self._placed:
            self._reasons["WIN_GAP"] += 1
            self._placed.clear()
        self._skip = 0
        self._grid.advance(None)

    def _take(self, arrived: _Arrived) -> list[FrameWindow]:
        self._totals["placed"] += 1
        self._grid.advance(arrived.frame.stamp_ns)
        if self._skip > 0:
            self._skip -= 1
            return []
        frame = arrived.frame
        self._pixels.put(len(self._placed), frame.image if self._fit is None else self._fit(frame.image))
        self._placed.append(_Placed(stamp_ns=frame.stamp_ns, seq=frame.seq, arrival_ns=arrived.arrival_ns))
        return [self._window()] if len(self._placed) == self.frames else []

    def _window(self) -> FrameWindow:
        placed = list(self._placed)
        images, clip = self._pixels.hand_over()
        window = FrameWindow(
            images=images,
            clip=clip,
            stamps_ns=tuple(each.stamp_ns for each in placed),
            seqs=tuple(each.seq for each in placed),
            window_id=self.next_id,
            fps=self.fps,
            arrival_ns=placed[-1].arrival_ns,
            dropped=self._totals["dropped"],
            epoch=self._epoch,
        )
        self._totals["built"] += 1
        self._skip = max(0, self._stride - self.frames)
        for _ in range(min(self._stride, self.frames)):
            self._placed.popleft()
        return window
