"""Received views as files: what `gcd-node view --save` writes."""

from pathlib import Path

import numpy as np

from gcd_client.protocol import ViewHeader, kind_of
from gcd_client.subscriber import ReceivedView
from gcd_model import hatched
from gcd_node.frame import Image
from gcd_node.image_io import VideoWriter, legend, write_npy, write_png

_LEGEND_WIDTH = 384


class ViewSaver:
    """Writes each window's frames as `<view>/<window>_<frame>.png`, and all of a view as lossless `<view>.mkv`.

    Other kinds go to a folder of their own: `<view>/<kind>/<window>_<frame>.png`, `<view>/<kind>.mkv`. Single frames,
    of which a window may give many, are numbered as the source did. Class maps and visibility are shown in colour, with
    a `legend.png`; their numbers are in `<window>.npy`, u8 [T, H, W]; of depth float32 [T, H, W], 1/m.

    hatch: draw lines over the painted pixels of windows. A window whose visibility did not come is hatched all over.

    Raises:
        OutputError: a file cannot be written, or a view changes its size.
    """

    def __init__(self, folder: Path, *, hatch: bool = False) -> None:
        self._folder, self._hatch = folder, hatch
        self._held: dict[str, tuple[ReceivedView, Image]] = {}  # windows that wait for their visibility, which is next
        self._videos: dict[Path, VideoWriter] = {}
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

    def close(self) -> None:
        """Finish the videos; until then they may lack their end."""
        for view_id in tuple(self._held):
            self._write_held(view_id, None)
        for video in self._videos.values():
            video.close()
        self._videos.clear()

    def __enter__(self) -> "ViewSaver":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

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
        folder = self._folder / header.view_id / ("" if kind == "win" else kind)
        for index, frame in enumerate(frames):
            number = f"{header.src.seq[0]:06d}" if kind == "frm" else f"{index:02d}"  # many of these share a window
            write_png(folder / f"{header.window_id:06d}_{number}.png", frame)
        self.files += len(frames)
        if kind == "depth" or header.classes is not None:
            write_npy(
                folder / f"{header.window_id:06d}.npy", view.inverse_depth if kind == "depth" else view.images[..., 0]
            )
            self.files += 1
        if header.classes is not None and folder not in self._legends:
            write_png(folder / "legend.png", legend(header.classes, _LEGEND_WIDTH))
            self._legends.add(folder)
            self.files += 1
        path = folder.with_suffix(".mkv")
        if path not in self._videos:
            self._videos[path] = VideoWriter(path, header.src.fps_cond)
            self.files += 1
        self._videos[path].add(frames)


def _moment(header: ViewHeader) -> tuple[object, ...]:
    return header.boot_id, header.view_rev, header.window_id, header.shape[:3]
