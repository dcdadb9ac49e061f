"""Keeps what a node publishes: pixels go to disk as they come, and every window becomes an entry of the manifest."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gcd_node.envelope import EndMessage, NoteTopic, ViewMessage, kind_of
from gcd_node.publishing.options import PublisherStats
from gcd_node.rendering.model_worker import WindowReport
from gcd_node.replay.manifest import ClassEntry, MapKind, SizeEntry, TroubleEntry, ViewEntry, WindowEntry, to_stamp
from gcd_node.replay.pixel_file import Pixels, PixelWriter, pixel_digest
from gcd_node.replay.run_folder import map_path, pictures_path
from gcd_node.wire.header import ClassRecord, OriginHeader, ViewHeader

_TROUBLES = ("MODEL_NAN", "GPU_OOM")


@dataclass(slots=True)
class _Arrived:
    """What has come of a view of the window in work: its header, the digests of its pixels and of its maps by kind."""

    header: ViewHeader
    sha256: str
    classes_sha256: str | None = None
    maps: dict[MapKind, str] = field(default_factory=dict[MapKind, str])


@dataclass(slots=True)
class Kept:
    """What a run came to. size, fps: of its windows, None before the first."""

    windows: list[WindowEntry] = field(default_factory=list[WindowEntry])
    troubles: list[TroubleEntry] = field(default_factory=list[TroubleEntry])
    classes: tuple[ClassEntry, ...] = ()
    size: SizeEntry | None = None
    fps: float = 0.0


class RunWriter:
    """An Outbox that needs no reader: takes the rgb8 messages of a lockstep node and keeps windows and their maps.

    Single frames are part of their window, and deviations of its samples: neither is kept. Use it as a context
    manager; at its end the videos are finished.
    """

    def __init__(self, folder: Path) -> None:
        self.kept = Kept()
        self._folder = folder
        self._videos: dict[Path, PixelWriter] = {}
        self._arrived: dict[str, _Arrived] = {}
        self._sent = 0

    def __enter__(self) -> "RunWriter":
        return self

    def __exit__(self, *_: object) -> None:
        for video in self._videos.values():
            video.close()

    def send(self, message: ViewMessage) -> bool:
        """Take a view; see Outbox. Raises OutputError if its video cannot be begun."""
        self._sent += 1
        header, kind = message.header, kind_of(message.topic)
        if kind == "win":
            pixels = _pixels(message)
            self._append(pictures_path(self._folder, header.view_id), header, pixels)
            self._arrived[header.view_id] = _Arrived(header=header, sha256=pixel_digest(pixels))
        elif kind in ("cls", "vis", "depth"):
            numbers, arrived = _pixels(message), self._arrived[header.view_id]
            self._append(map_path(self._folder, header.view_id, kind), header, numbers)
            if kind == "cls":
                arrived.classes_sha256 = pixel_digest(numbers)
                self.kept.classes = tuple(_class_entry(each) for each in header.classes or ())
            else:
                arrived.maps[kind] = pixel_digest(numbers)
        return True

    def finish_window(self, report: WindowReport) -> None:
        """Take note that all views of a window were sent; a node's `on_window`."""
        window, arrived, self._arrived = report.window, self._arrived, {}
        frames, height, width, _ = next(iter(arrived.values())).header.shape
        self.kept.size, self.kept.fps = SizeEntry(frames=frames, height=height, width=width), window.fps
        self.kept.windows.append(
            WindowEntry(
                window_id=window.window_id,
                epoch=window.epoch,
                stamps=tuple(to_stamp(stamp_ns) for stamp_ns in window.stamps_ns),
                seqs=window.seqs,
                input_sha256=pixel_digest(window.images),
                render_ms=round(report.render_s * 1000, 3),
                views={view_id: _view_entry(each) for view_id, each in arrived.items()},
            )
        )

    def end(self, message: EndMessage, *, delay_ms: int | None = None) -> None:
        """Nothing follows from it; see Outbox."""

    def note(self, topic: NoteTopic, header: OriginHeader, fields: Mapping[str, Any]) -> None:
        """Keep what the model could not do; see Outbox."""
        if topic == "event" and fields["code"] in _TROUBLES:
            detail = fields["rung"] if "rung" in fields else f"seeds {', '.join(map(str, fields['seeds']))}"
            trouble = TroubleEntry(code=fields["code"], window_id=fields["window_id"], detail=detail)
            self.kept.troubles.append(trouble)

    def hurry(self) -> None:
        """Nobody is waited for; see Outbox."""

    @property
    def stats(self) -> PublisherStats:
        """Messages taken; see Outbox."""
        return PublisherStats(sent=self._sent, dropped=0, subscribers=0, bytes=0)

    def _append(self, path: Path, header: ViewHeader, pixels: Pixels) -> None:
        if path not in self._videos:
            _, height, width = pixels.shape[:3]
            self._videos[path] = PixelWriter(path, height=height, width=width, fps=header.src.fps_cond)
        self._videos[path].write(pixels)


def _pixels(message: ViewMessage) -> Pixels:
    """Pictures [T, H, W, 3]; of maps the bytes of each row, [T, H, W] or of depth [T, H, 2 W]."""
    frames, height, width, channels = message.header.shape
    bytes_ = np.frombuffer(message.payload, np.uint8)
    return bytes_.reshape((frames, height, width, 3) if channels == 3 else (frames, height, -1))


def _view_entry(arrived: _Arrived) -> ViewEntry:
    header = arrived.header
    return ViewEntry(
        view_rev=header.view_rev,
        sha256=arrived.sha256,
        classes_sha256=arrived.classes_sha256,
        maps_sha256=arrived.maps,
        seed=header.quality.seed,
        steps=header.quality.steps,
        ood=header.quality.ood,
        nan_frames=header.quality.nan_frames,
    )


def _class_entry(each: ClassRecord) -> ClassEntry:
    return ClassEntry(id=each.id, name=each.name, colour=each.colour)
