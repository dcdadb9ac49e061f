"""Frames become windows: resampled by their stamps to the rate the network was trained at, T at a time."""

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gcd_node.frame import Frame, Image
from gcd_node.preprocess import write_planes

Reason: TypeAlias = Literal["WIN_GAP", "CLOCK_STEP", "SRC_FORMAT", "SRC_LOST"]
"""Why frames did not become a window: a hole in time, a step of the source's clock, another picture size, a source
that was lost."""

RATE_TOLERANCE = 0.01
"""Rates that differ by this part are the same: 23.976 is 24."""

_LONGEST_STEP_NS = 1_000_000_000
_SURE, _FOLLOW = 0.05, 0.1  # periods that nothing nearer can come within; how far the grid is drawn to each frame
_EARLY = 0.5  # periods of the source: of the frames around a grid point, the nearest comes at most so early


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PartialWindow:
    """The frames that the next window holds so far, from none to all but one; or all of them, see FrameWindow.

    clip: as the network takes them, float32 [n, 3, H, W] in [-1, 1]; not to be changed.
    stamps_ns, seqs, depths, odometry: of each frame, as the source gave them; depth in the size of the clip.
    fps: the rate the network is told.
    epoch: counts the restarts of the builder; stamps of different epochs cannot be compared.
    """

    clip: NDArray[np.float32]
    stamps_ns: tuple[int, ...]
    seqs: tuple[int, ...]
    depths: tuple[NDArray[np.float32] | None, ...]
    odometry: tuple[NDArray[np.float64] | None, ...]
    fps: float
    epoch: int


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class FrameWindow(PartialWindow):
    """T frames at an even rate, still with their stamps.

    images: u8 [T, H, W, 3], RGB, read-only; the same as `clip`.
    window_id: counts windows, from where the builder was told to begin.
    arrival_ns: when the newest frame arrived, on the monotonic clock.
    dropped: frames the builder has thrown away so far, for a stamp that did not rise.
    static: all pictures are alike; of a single one, it is like the one before.
    """

    images: Image
    window_id: int
    arrival_ns: int
    dropped: int
    static: bool


class _Arrived(NamedTuple):
    frame: Frame
    arrival_ns: int


class _Placed(NamedTuple):  # on the grid; its pixels are among those of the next window
    stamp_ns: int
    seq: int
    arrival_ns: int
    depth: NDArray[np.float32] | None
    odometry: NDArray[np.float64] | None


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

    With windows of one frame every frame is one at once, without waiting for a nearer one; at a rate below the
    source's, the first that is due.

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
        fit_depth: Callable[[NDArray[np.float32]], NDArray[np.float32]] | None = None,
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
            fit_depth: the same for depth; None: nobody wants depth and odometry.
            first_id, first_epoch: of the first window, for a builder that goes on where another one ended.
        """
        self.frames = frames
        self._stride = frames if stride is None else stride
        self._max_skew = max_skew
        self._fit, self._fit_depth = fit, fit_depth
        self.run_at(fps, source_fps)
        self._placed: deque[_Placed] = deque()
        self._pixels = _WindowPixels(frames)
        self._waiting: _Arrived | None = None
        self._newest: Frame | None = None
        self._arrival_ns = 0
        self._thin: NDArray[np.uint8] | None = None  # of the last window, to see whether anything changes
        self._skip = 0
        self._first_id = first_id
        self.epoch = first_epoch
        """Of the window being built."""
        self.pushed = self.placed = self.built = self.dropped = 0
        """Frames so far, those on the grid, windows, and frames whose stamp did not rise."""
        self._reasons: Counter[Reason] = Counter()

    @property
    def reasons(self) -> dict[Reason, int]:
        """How often each reason has spoilt a window or restarted the builder."""
        return dict(self._reasons)

    @property
    def next_id(self) -> int:
        """What the next window will be called."""
        return self._first_id + self.built

    @property
    def filling(self) -> PartialWindow:
        """What the next window holds so far."""
        placed = list(self._placed)
        return PartialWindow(
            clip=self._pixels.filled(len(placed)),
            stamps_ns=tuple(each.stamp_ns for each in placed),
            seqs=tuple(each.seq for each in placed),
            fps=self.fps,
            epoch=self.epoch,
            depths=tuple(each.depth for each in placed),
            odometry=tuple(each.odometry for each in placed),
        )

    def push(self, frame: Frame, arrival_ns: int) -> list[FrameWindow]:
        """Take the next frame, and give the windows it completes; mostly none, hardly ever two.

        Args:
            frame: from the source, any size; sizes may change, stamps should rise.
            arrival_ns: when it arrived, on the monotonic clock.
        Raises:
            ConfigError: `fit` refuses the picture.
        """
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
        if self.frames == 1:
            return self._alone(_Arrived(frame=frame, arrival_ns=arrival_ns))
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
        self.epoch += 1
        self._placed.clear()
        self._waiting = None
        self._newest = self._thin = None
        self._skip = 0

    def run_at(self, fps: float, source_fps: float | None) -> None:
        """Another rate of the grid from here on; only before the first frame, or the first after `restart`.

        Args:
            fps, source_fps: as of a new builder.
        """
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

    def _alone(self, arrived: _Arrived) -> list[FrameWindow]:
        """A window of one frame, unless the grid is slower than the source and the frame is not due."""
        stamp_ns = arrived.frame.stamp_ns
        if not self._follows and stamp_ns < self._grid.next_ns - self._early_ns:
            return []
        windows = self._take(arrived)
        while self._grid.next_ns <= stamp_ns:
            self._grid.advance(None)
        return windows

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

        def distance_ns(arrived: _Arrived) -> int:
            return abs(arrived.frame.stamp_ns - self._grid.next_ns)

        near = [each for each in candidates if each is not None and distance_ns(each) <= self._skew_ns]
        return min(near, key=distance_ns, default=None)

    def _hole(self) -> None:
        if self._placed:
            self._reasons["WIN_GAP"] += 1
            self._placed.clear()
        self._skip = 0
        self._grid.advance(None)

    def _take(self, arrived: _Arrived) -> list[FrameWindow]:
        self.placed += 1
        self._grid.advance(arrived.frame.stamp_ns)
        if self._skip > 0:
            self._skip -= 1
            return []
        frame = arrived.frame
        self._pixels.put(len(self._placed), frame.image if self._fit is None else self._fit(frame.image))
        depth = None if frame.depth is None or self._fit_depth is None else self._fit_depth(frame.depth)
        odometry = None if self._fit_depth is None else frame.odometry
        self._placed.append(_Placed(frame.stamp_ns, frame.seq, arrived.arrival_ns, depth, odometry))
        return [self._window()] if len(self._placed) == self.frames else []

    def _window(self) -> FrameWindow:
        placed = list(self._placed)
        images, clip = self._pixels.hand_over()
        thin = images.reshape(*images.shape[:2], -1)[:, ::16, ::8]  # of all three colours in turn
        before, self._thin = self._thin if self.frames == 1 else thin[0], thin[-1]
        window = FrameWindow(
            images=images,
            clip=clip,
            stamps_ns=tuple(each.stamp_ns for each in placed),
            seqs=tuple(each.seq for each in placed),
            window_id=self.next_id,
            fps=self.fps,
            arrival_ns=placed[-1].arrival_ns,
            dropped=self.dropped,
            epoch=self.epoch,
            static=before is not None and all(np.array_equal(each, before) for each in thin),
            depths=tuple(each.depth for each in placed),
            odometry=tuple(each.odometry for each in placed),
        )
        self.built += 1
        self._skip = max(0, self._stride - self.frames)
        for _ in range(min(self._stride, self.frames)):
            self._placed.popleft()
        return window


class _WindowPixels:
    """The next window's pixels: as pictures, and as the network takes them."""

    def __init__(self, frames: int) -> None:
        self._frames = frames
        self._images: NDArray[np.uint8] = np.empty((frames, 0, 0, 3), np.uint8)
        self._clip: NDArray[np.float32] = np.empty((frames, 3, 0, 0), np.float32)

    def put(self, place: int, image: Image) -> None:
        """Take the picture of one place: u8 [H, W, 3].

        Places are filled one after another, from 0, or after `hand_over` from any other: then what comes before it is
        how the last window ended. Pictures of one window have one size. What was ever given away stays as it was.
        """
        if place == 0 or not self._images.flags.writeable or self._images.shape[1:] != image.shape:
            self._begin(image, place)
        self._images[place] = image
        write_planes(image, self._clip[place])

    def hand_over(self) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """The whole window, as of FrameWindow; nothing of it changes any more."""
        self._images.setflags(write=False)
        return self._images, self._clip

    def filled(self, count: int) -> NDArray[np.float32]:
        """The first places of the next window; after `hand_over` how the last window ended."""
        begin = 0 if self._images.flags.writeable else self._frames - count
        return self._clip[begin : begin + count]

    def _begin(self, image: Image, shared: int) -> None:
        """Other arrays, which begin with the last `shared` places of these."""
        height, width, _ = image.shape
        images = np.empty((self._frames, height, width, 3), np.uint8)
        clip = np.empty((self._frames, 3, height, width), np.float32)
        if shared > 0:
            images[:shared], clip[:shared] = self._images[-shared:], self._clip[-shared:]
        self._images, self._clip = images, clip


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
