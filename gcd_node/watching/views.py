"""Watches a node's views: a live table, and pictures on disk. What `gcd-node view` does between its options and its
screen; nothing here prints."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from gcd_client.endpoints import ClientKeys
from gcd_client.protocol import MessageError, ViewHeader, ViewKind, kind_of
from gcd_client.subscriber import ReceivedView, ViewSubscriber
from gcd_model import hatched
from gcd_node.errors import OutputError
from gcd_node.frame import Image
from gcd_node.image_io import legend, video_writer, write_npy, write_png

_REFRESH_MS = 250
_RATE_SPAN = 10
_LEGEND_WIDTH = 384

_STYLES = {"live": "green", "expired": "yellow", "ended": "dim"}


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewRow:
    """One line of the table, for one topic.

    shape: [T, H, W, C]. age_ms: of the newest input frame, now. rate_hz: messages a second, 0 until two came.
    missed: messages published but not received. bytes: payload received in total. state: live, expired or ended.
    """

    topic: str
    window_id: int
    shape: tuple[int, ...]
    age_ms: float
    rate_hz: float
    missed: int
    bytes: int
    state: str


@dataclass(frozen=True, kw_only=True, slots=True)
class WatchRequest:
    """What to watch.

    view: one view's id, None for all. kind: as in ViewSubscriber, None for all. save: folder for pictures, or None.
    hatch: see ViewSaver; needs the kinds win and vis.
    limit: stop after this many messages. timeout_s: stop when nothing came for so long. None for no bound.
    keys: for a node that asks for them.
    """

    endpoint: str = "ipc"
    view: str | None = None
    kind: ViewKind | tuple[ViewKind, ...] | None = "win"
    save: Path | None = None
    hatch: bool = False
    limit: int | None = None
    timeout_s: float | None = None
    keys: ClientKeys | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class WatchReport:
    """How it went. ended: the node said that the stream ended. damaged: messages that were no valid ones.
    restarts: how often the node was started anew. files: what was written."""

    rows: tuple[ViewRow, ...]
    received: int
    ended: bool
    damaged: int
    restarts: int
    files: int


class ViewTable:
    """The live model behind the table; times are monotonic seconds, given by the caller."""

    def __init__(self) -> None:
        self._tracks: dict[str, _Track] = {}

    def add(self, view: ReceivedView, now_s: float) -> None:
        """Take note of a message that arrived now."""
        track = self._tracks.setdefault(view.message.topic, _Track(last=view))
        track.last = view
        track.arrivals.append(now_s)
        track.missed += view.skipped
        track.bytes += len(view.message.payload)

    def rows(self, now_s: float, *, ended: bool = False) -> list[ViewRow]:
        """The table as it stands now, by topic; `ended` if the stream has ended."""
        return [self._tracks[topic].row(now_s, ended) for topic in sorted(self._tracks)]


class ViewSaver:
    """Writes each window's frames as `<view>/<window>_<frame>.png`, and all of a view as lossless `<view>.mkv`.

    What is no window goes to a folder of its kind: `<view>/<kind>/<window>_<frame>.png`, `<view>/<kind>.mkv`. Single
    frames, of which a window may give many, are numbered as the source did. Class maps are shown in the colours of
    their ontology, with a `legend.png`; the class numbers themselves are in `<window>.npy`, u8 [T, H, W]. So is
    visibility; of depth the file has float32 [T, H, W], 1/m.

    hatch: draw lines over the painted pixels of windows. A window whose visibility did not come is hatched all over.

    Raises:
        OutputError: a file cannot be written, or a view changes its size.
    """

    def __init__(self, folder: Path, *, hatch: bool = False) -> None:
        self._folder, self._hatch = folder, hatch
        self._held: dict[str, tuple[ReceivedView, Image]] = {}  # windows that wait for their visibility, which is next
        self._videos: dict[Path, tuple[cv2.VideoWriter, tuple[int, ...]]] = {}
        self._legends: set[Path] = set()
        self.files = 0

    def add(self, view: ReceivedView) -> None:
        """Write one message's frames; of a window to be hatched, once its visibility is here."""
        view_id, kind, frames = view.header.view_id, kind_of(view.message.topic), view.colours
        if self._hatch and kind == "win":
            self._write_held(view_id, None)
            self._held[view_id] = view, frames
            return
        if kind == "vis":
            self._write_held(view_id, view)
        self._write(view, frames)

    def _write_held(self, view_id: str, visibility: ReceivedView | None) -> None:
        if view_id not in self._held:
            return
        held, frames = self._held.pop(view_id)
        seen = np.zeros(frames.shape[:3], np.uint8)
        if visibility is not None and _moment(visibility.header) == _moment(held.header):
            seen = visibility.images[..., 0]
        self._write(held, hatched(frames, seen))

    def _write(self, view: ReceivedView, frames: Image) -> None:
        header, kind = view.header, kind_of(view.message.topic)
        folder = self._folder / header.view_id
        folder = folder if kind == "win" else folder / kind
        single = kind == "frm"  # many of these share a window
        for index, frame in enumerate(frames):
            number = f"{header.src.seq[0]:06d}" if single else f"{index:02d}"
            write_png(folder / f"{header.window_id:06d}_{number}.png", frame)
        self.files += len(frames)
        if kind == "depth" or header.classes is not None:
            self._keep_numbers(folder, view)
        video = self._video(folder.with_suffix(".mkv"), header)
        for frame in frames:
            video.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))

    def close(self) -> None:
        """Finish the videos; until then they may lack their end."""
        for view_id in tuple(self._held):
            self._write_held(view_id, None)
        for video, _ in self._videos.values():
            video.release()
        self._videos.clear()

    def __enter__(self) -> "ViewSaver":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    def _keep_numbers(self, folder: Path, view: ReceivedView) -> None:
        classes = view.header.classes
        numbers = view.inverse_depth if classes is None else view.images[..., 0]
        write_npy(folder / f"{view.header.window_id:06d}.npy", numbers)
        self.files += 1
        path = folder / "legend.png"
        if classes is not None and path not in self._legends:
            write_png(path, legend(classes, _LEGEND_WIDTH))
            self._legends.add(path)
            self.files += 1

    def _video(self, path: Path, header: ViewHeader) -> cv2.VideoWriter:
        size = header.shape[1:3]
        if path not in self._videos:
            self._videos[path] = (video_writer(path, size[1], size[0], header.src.fps_cond), size)
            self.files += 1
        video, first = self._videos[path]
        if first != size:
            raise OutputError(f"view {header.view_id} was {first} (height, width), now {size}; save to a new folder")
        return video


def watch(request: WatchRequest, on_change: Callable[[Sequence[ViewRow]], None]) -> WatchReport:
    """Receive until the limit, the timeout or the end of the stream; `on_change` gets the rows as they change, and
    four times a second in between, so that ages grow on the screen.

    Raises:
        SetupError, MessageError: no such endpoint, or view id. OutputError: a picture cannot be written.
        AuthError: the node does not let us in.
    """
    with ViewSubscriber(request.endpoint, request.view, request.kind, conflate=False, keys=request.keys) as views:
        if request.save is None:
            return _Watch(request, views, None).run(on_change)
        with ViewSaver(request.save, hatch=request.hatch) as saver:
            return _Watch(request, views, saver).run(on_change)


def render(rows: Sequence[ViewRow]) -> Table:
    """The rows as a table for rich."""
    title = "Virtual views: generated pixels, never evidence of free space"
    table = Table(
        title=title, title_style="dim", box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0), min_width=len(title)
    )
    for name in ("topic", "window", "shape", "age ms", "rate Hz", "missed", "MB", "state"):
        left = name in ("topic", "state")
        table.add_column(name, justify="left" if left else "right", no_wrap=name != "topic", overflow="fold")
    for row in rows:
        shape = "x".join(map(str, row.shape))
        numbers = (f"{row.age_ms:.0f}", f"{row.rate_hz:.2f}", str(row.missed), f"{row.bytes / 1e6:.1f}")
        state = Text(row.state, style=_STYLES[row.state])
        table.add_row(row.topic, str(row.window_id), shape, *numbers, state)
    return table


def _moment(header: ViewHeader) -> tuple[object, ...]:
    return header.boot_id, header.view_rev, header.window_id, header.shape[:3]


class _Watch:
    """One run of watch()."""

    def __init__(self, request: WatchRequest, views: ViewSubscriber, saver: ViewSaver | None) -> None:
        self._request, self._views, self._saver = request, views, saver
        self._table = ViewTable()
        self._damaged = 0
        self._heard_s = time.monotonic()

    def run(self, on_change: Callable[[Sequence[ViewRow]], None]) -> WatchReport:
        while not self._over():
            self._step()
            on_change(self._table.rows(time.monotonic(), ended=self._views.ended))
        return self._report()

    def _step(self) -> None:
        view = self._views.receive(_REFRESH_MS)
        if view is None:
            return
        self._heard_s = time.monotonic()
        self._table.add(view, self._heard_s)
        try:
            if self._saver is not None:
                self._saver.add(view)
        except MessageError:  # its pixels
            self._damaged += 1

    def _over(self) -> bool:
        limit, timeout_s = self._request.limit, self._request.timeout_s
        enough = limit is not None and self._views.received >= limit
        silent = timeout_s is not None and time.monotonic() - self._heard_s >= timeout_s
        return self._views.ended or enough or silent

    def _report(self) -> WatchReport:
        rows = tuple(self._table.rows(time.monotonic(), ended=self._views.ended))
        return WatchReport(
            rows=rows,
            received=self._views.received,
            ended=self._views.ended,
            damaged=self._damaged + self._views.damaged,
            restarts=self._views.restarts,
            files=0 if self._saver is None else self._saver.files,
        )


class _Track:
    """What is known of one topic."""

    def __init__(self, *, last: ReceivedView) -> None:
        self.last = last
        self.arrivals: deque[float] = deque(maxlen=_RATE_SPAN)
        self.missed = 0
        self.bytes = 0

    def row(self, now_s: float, ended: bool) -> ViewRow:
        header = self.last.header
        since_ms = (now_s - self.arrivals[-1]) * 1000
        expired = self.last.expired or since_ms > header.valid_for_ms
        return ViewRow(
            topic=self.last.message.topic,
            window_id=header.window_id,
            shape=header.shape,
            age_ms=self.last.age_ms + since_ms,
            rate_hz=self._rate_hz(),
            missed=self.missed,
            bytes=self.bytes,
            state="ended" if ended else "expired" if expired else "live",
        )

    def _rate_hz(self) -> float:
        span = self.arrivals[-1] - self.arrivals[0]
        return (len(self.arrivals) - 1) / span if span > 0 else 0.0
