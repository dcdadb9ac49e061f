"""Frames become windows: resampled by their stamps to the rate the network was trained at, T at a time; and the slot
through which the model thread gets them from the reader thread."""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gcd_node.errors import NodeError, ReaderError, TooShortError
from gcd_node.frame import Frame, FrameSource, Image

Reason: TypeAlias = Literal["WIN_GAP", "CLOCK_STEP", "SRC_FORMAT", "SRC_LOST"]
"""Why frames did not become a window: a hole in time, a step of the source's clock, another picture size, a source
that was lost."""

RATE_TOLERANCE = 0.01
"""Rates that differ by this part are the same: 23.976 is 24."""

_LONGEST_STEP_NS = 1_000_000_000
_SURE, _FOLLOW = 0.05, 0.1  # periods that nothing nearer can come within; how far the grid is drawn to each frame
_EARLY = 0.5  # periods of the source: of the frames around a grid point, the nearest comes at most so early


@dataclass(frozen=True, slots=True, eq=False)
class PlacedFrame:
    """A frame on the grid: picture, u8 [H, W, 3], read-only, and depth in the network's size; when it arrived, on the
    monotonic clock; the rest as the source gave it."""

    image: Image
    stamp_ns: int
    seq: int
    arrival_ns: int
    depth: NDArray[np.float32] | None
    odometry: NDArray[np.float64] | None


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PartialWindow:
    """The frames that the next window holds so far, from none to all but one; or all of them, see FrameWindow.

    fps: the rate the network is told.
    epoch: counts the restarts of the builder; stamps of different epochs cannot be compared.
    """

    frames: tuple[PlacedFrame, ...]
    fps: float
    epoch: int

    @property
    def stamps_ns(self) -> tuple[int, ...]:
        """Of each frame."""
        return tuple(frame.stamp_ns for frame in self.frames)

    @property
    def seqs(self) -> tuple[int, ...]:
        """The source's own numbers of the frames."""
        return tuple(frame.seq for frame in self.frames)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class FrameWindow(PartialWindow):
    """T frames at an even rate, still with their stamps.

    window_id: counts windows, from where the builder was told to begin.
    dropped: frames the builder has thrown away so far, for a stamp that did not rise.
    static: all pictures are alike; of a single one, it is like the one before.
    """

    window_id: int
    dropped: int
    static: bool

    @property
    def images(self) -> Image:
        """u8 [T, H, W, 3], RGB."""
        return np.stack([frame.image for frame in self.frames])

    @property
    def arrival_ns(self) -> int:
        """When the newest frame arrived."""
        return self.frames[-1].arrival_ns


class WindowBuilder:
    """Places frames on an even grid in time and cuts it into windows. No threads, no clock of its own.

    A grid point takes the frame nearest to it, no frame twice. A point without a frame within `max_skew` periods is a
    hole: the window it falls in is rejected (WIN_GAP) and the next begins behind it. A frame is never repeated.

    With windows of one frame every frame is one at once, without waiting for a nearer one; at a rate below the
    source's, the first that is due. The grid starts at the first frame. If the source runs at the grid's own rate, it
    follows the source's clock slowly, so that every frame is used once; else it is even.
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
        fit_depth: Callable[[NDArray[np.float32]], NDArray[np.float32]] | None = None,
        first_id: int = 0,
        first_epoch: int = 0,
    ) -> None:
        """Make an empty builder.

        Args:
            frames: T, frames in a window. fps: of the grid; what the network is told. source_fps: nominal, if known.
            stride: grid points from one window to the next; T if left out.
            max_skew: how far a frame may lie from its grid point, in periods, up to 0.5.
            fit: brings a picture to the network's size; called once for every frame on the grid, on arrival.
            fit_depth: the same for depth; None: nobody wants depth and odometry.
            first_id, first_epoch: of the first window.
        """
        self.frames = frames
        self._stride = frames if stride is None else stride
        self._max_skew = max_skew
        self._fit, self._fit_depth = fit, fit_depth
        self.run_at(fps, source_fps)
        self._placed: deque[PlacedFrame] = deque()
        self._waiting: tuple[Frame, int] | None = None  # and when it arrived
        self._newest: Frame | None = None
        self._arrival_ns = 0
        self._thin: NDArray[np.uint8] | None = None  # of the last window, to see whether anything changes
        self._skip = 0
        self.next_id, self.epoch = first_id, first_epoch
        """Of the window being built."""
        self.pushed = self.placed = self.built = self.dropped = 0
        """Frames so far, those on the grid, windows, and frames whose stamp did not rise."""
        self._reasons: Counter[Reason] = Counter()

    @property
    def reasons(self) -> dict[Reason, int]:
        """How often each reason has spoilt a window or restarted the builder."""
        return dict(self._reasons)

    @property
    def filling(self) -> PartialWindow:
        """What the next window holds so far."""
        return PartialWindow(frames=tuple(self._placed), fps=self.fps, epoch=self.epoch)

    def push(self, frame: Frame, arrival_ns: int) -> list[FrameWindow]:
        """Take the next frame, and give the windows it completes. arrival_ns: when it came, on the monotonic clock.
        Raises ConfigError: `fit` refuses the picture."""
        self.pushed += 1
        if self._newest is not None:
            if frame.size != self._newest.size:
                self.restart("SRC_FORMAT")
            elif self._is_clock_step(frame.stamp_ns - self._newest.stamp_ns, arrival_ns - self._arrival_ns):
                self.restart("CLOCK_STEP")
            elif frame.stamp_ns <= self._newest.stamp_ns:
                self.dropped += 1
                return []
        if self._newest is None:
            self._grid.start(frame.stamp_ns)
        self._newest, self._arrival_ns = frame, arrival_ns
        return self._alone(frame, arrival_ns) if self.frames == 1 else self._place(frame, arrival_ns)

    def flush(self) -> list[FrameWindow]:
        """At the end of the stream: place the last frame if it was only waiting for a nearer one."""
        nearest, self._waiting = self._nearest(self._waiting), None
        return [] if nearest is None else self._take(*nearest)

    def restart(self, reason: Reason) -> None:
        """Forget all frames and begin a new epoch; counted under `reason`."""
        self._reasons[reason] += 1
        self.epoch += 1
        self._placed.clear()
        self._waiting = None
        self._newest = self._thin = None
        self._skip = 0

    def run_at(self, fps: float, source_fps: float | None) -> None:
        """Another rate of the grid from here on; only before the first frame, or the first after `restart`."""
        self.fps = fps
        self._skew_ns = self._max_skew * 1e9 / fps
        self._early_ns = _EARLY * 1e9 / (fps if source_fps is None else source_fps)
        follows = self._follows = source_fps is not None and abs(source_fps / fps - 1) <= RATE_TOLERANCE
        self._grid = _TimeGrid(fps=fps, follow=_FOLLOW if follows else 0.0)

    def _is_clock_step(self, step_ns: int, waited_ns: int) -> bool:
        """Backwards by over a second, or forwards by over a second and a whole window more than it took to arrive: a
        camera that was silent is no clock that was set."""
        ahead_ns = step_ns - max(waited_ns, 0)
        return step_ns < -_LONGEST_STEP_NS or ahead_ns > max(_LONGEST_STEP_NS, self.frames * 1e9 / self.fps)

    def _alone(self, frame: Frame, arrival_ns: int) -> list[FrameWindow]:
        """A window of one frame, unless the grid is slower than the source and the frame is not due."""
        if not self._follows and frame.stamp_ns < self._grid.next_ns - self._early_ns:
            return []
        windows = self._take(frame, arrival_ns)
        while self._grid.next_ns <= frame.stamp_ns:
            self._grid.advance(None)
        return windows

    def _place(self, frame: Frame, arrival_ns: int) -> list[FrameWindow]:
        """Settle all grid points up to the new frame, and those so near behind it that nothing can be nearer."""
        windows: list[FrameWindow] = []
        candidate: tuple[Frame, int] | None = (frame, arrival_ns)
        while self._grid.next_ns <= frame.stamp_ns + _SURE * self._grid.period_ns:
            nearest = self._nearest(self._waiting, candidate)
            if nearest is None:
                self._reasons["WIN_GAP"] += bool(self._placed)
                self._placed.clear()
                self._skip = 0
                self._grid.advance(None)
                continue
            windows += self._take(*nearest)
            self._waiting, candidate = None, None if nearest is candidate else candidate
        self._waiting = candidate
        return windows

    def _nearest(self, *candidates: tuple[Frame, int] | None) -> tuple[Frame, int] | None:
        """The candidate nearest to the next grid point; None if all are too far."""

        def distance_ns(candidate: tuple[Frame, int]) -> int:
            return abs(candidate[0].stamp_ns - self._grid.next_ns)

        near = [each for each in candidates if each is not None and distance_ns(each) <= self._skew_ns]
        return min(near, key=distance_ns, default=None)

    def _take(self, frame: Frame, arrival_ns: int) -> list[FrameWindow]:
        self.placed += 1
        self._grid.advance(frame.stamp_ns)
        if self._skip > 0:
            self._skip -= 1
            return []
        image = frame.image if self._fit is None else self._fit(frame.image)
        image.setflags(write=False)
        depth = odometry = None
        if self._fit_depth is not None:
            depth, odometry = None if frame.depth is None else self._fit_depth(frame.depth), frame.odometry
        self._placed.append(PlacedFrame(image, frame.stamp_ns, frame.seq, arrival_ns, depth, odometry))
        return [self._window()] if len(self._placed) == self.frames else []

    def _window(self) -> FrameWindow:
        # of all colours in turn
        thin = [frame.image.reshape(len(frame.image), -1)[::16, ::8] for frame in self._placed]
        before, self._thin = self._thin if self.frames == 1 else thin[0], thin[-1]
        window = FrameWindow(
            frames=tuple(self._placed),
            fps=self.fps,
            epoch=self.epoch,
            window_id=self.next_id,
            dropped=self.dropped,
            static=before is not None and all(np.array_equal(each, before) for each in thin),
        )
        self.built += 1
        self.next_id += 1
        self._skip = max(0, self._stride - self.frames)
        for _ in range(min(self._stride, self.frames)):
            self._placed.popleft()
        return window


class _TimeGrid:
    """Points in time, evenly spaced; with `follow` > 0 each is drawn that part of the way to the frame it took."""

    def __init__(self, *, fps: float, follow: float) -> None:
        self.period_ns = 1e9 / fps
        self.next_ns = 0
        self._follow = follow
        self._start_ns = 0
        self._index = 0

    def start(self, stamp_ns: int) -> None:
        self._start_ns = self.next_ns = stamp_ns
        self._index = 0

    def advance(self, taken_ns: int | None) -> None:
        """Go to the next point; taken_ns is the stamp of the frame this one took, None for a hole."""
        if taken_ns is not None and self._follow > 0:
            self._start_ns += round(self._follow * (taken_ns - self.next_ns))
        self._index += 1
        self.next_ns = self._start_ns + round(self._index * self.period_ns)


# From one thread to the other.


class WindowSlot:
    """A slot for one window between two threads. A newer window replaces an unread one, which counts as dropped; with
    `lossless`, `put` waits instead. It also shows what the next window holds so far. The giver ends with `finish`, the
    taker with `close`.
    """

    def __init__(self, *, lossless: bool = False) -> None:
        self._lossless = lossless
        self._changed = threading.Condition()
        self._slot: FrameWindow | None = None
        self._finished = self._is_shown = False
        self._error: Exception | None = None
        self.dropped = 0
        """Windows that were replaced before anybody took them."""
        self.closed = False
        """Whether the taker wants no more."""
        self.filling: PartialWindow | None = None
        """What the next window holds so far; None where nobody knows."""

    def put(self, window: FrameWindow) -> bool:
        """Leave a window; waits for room if lossless. False, and it is not left, once the slot is closed."""
        with self._changed:
            self.filling = None  # it is this window's
            if self._lossless:
                self._changed.wait_for(lambda: self.closed or self._slot is None)
            if self.closed:
                return False
            self.dropped += self._slot is not None
            self._slot = window
            self._changed.notify_all()
            return True

    def show(self, filling: PartialWindow) -> None:
        """Giver: this is what the next window holds so far. Never waits."""
        with self._changed:
            self.filling = filling
            self._is_shown = True
            self._changed.notify_all()

    def take(self, idle_work: Callable[[], bool] | None = None) -> FrameWindow | None:
        """Wait for a window. None after `close`, or after `finish` once the last window was taken.

        Args:
            idle_work: what to do while there is nothing to take: called until it returns False, and anew after every
                `show`. A window that comes is taken as soon as the call under way returns.
        Raises:
            the error given to `finish`, once, after the last window was taken; what `idle_work` raises.
        """
        asleep = idle_work is None
        while True:
            with self._changed:
                if asleep:
                    self._changed.wait_for(lambda: self._is_due or (self._is_shown and idle_work is not None))
                self._is_shown = False
                if self._is_due:
                    window, self._slot = self._slot, None
                    self._changed.notify_all()
                    error, self._error = (None, self._error) if window is not None else (self._error, None)
                    if error is not None and not self.closed:
                        raise error
                    return window
            asleep = idle_work is None or not idle_work()

    @property
    def _is_due(self) -> bool:
        return self.closed or self._finished or self._slot is not None

    def finish(self, error: Exception | None = None) -> None:
        """Giver: nothing more comes. What was left can still be taken; then `take` raises `error`, if there is one."""
        with self._changed:
            self._finished, self._error = True, error
            self._changed.notify_all()

    def close(self) -> None:
        """Taker: stop at once. Everybody who waits is let go; a window that was left is forgotten."""
        with self._changed:
            self.closed, self._slot = True, None
            self._changed.notify_all()


def read(source: FrameSource, windows: WindowBuilder, newest: WindowSlot) -> None:
    """Reader thread: every frame is used; of complete windows the newest wins, and of the window that fills, the slot
    shows every frame as it arrives.

    Returns when the source has ended or `newest` was closed; an error of the source goes to whoever takes from
    `newest`. To stop early, close `newest` first, then the source.
    """
    try:
        for frame in source.frames():
            for window in windows.push(frame, time.monotonic_ns()):
                newest.put(window)
            newest.show(windows.filling)
            if newest.closed:
                break
        else:
            for window in windows.flush():
                newest.put(window)
            if windows.built == 0 and not newest.closed:
                spoilt = "".join(f", {count} x {reason}" for reason, count in sorted(windows.reasons.items()))
                raise TooShortError(
                    f"TOO_SHORT n={windows.pushed}: {windows.placed} frames of {source.info.id} are usable{spoilt}; a "
                    f"window takes {windows.frames} in a row at {windows.fps:g} FPS: give more, or another [window] fps"
                )
    except NodeError as error:
        newest.finish(error)
    except Exception as error:  # the end of a thread: whoever takes gets it
        broken = ReaderError(f"reading frames broke: {type(error).__name__}: {error}")
        broken.__cause__ = error
        newest.finish(broken)
    else:
        newest.finish()
