"""The bird's-eye grids of a node: of every window one message of each, made before its views are painted."""

import time
from collections.abc import Callable, Mapping, Sequence

from msgspec.structs import replace

from gcd_client.images import GridLayers, grid_payload
from gcd_client.protocol import GridHeader, GridMessage, QualityRecord, grid_topic
from gcd_model import CameraMount, Grid, GridMapper, PlacedFrame
from gcd_node.config import GridConfig
from gcd_node.messages import MessageSink, captured, end_message, input_flags, ontology, utc_offset_ns, world_flags
from gcd_node.stream_context import StreamContext
from gcd_node.window import FrameWindow

FRAME_ID = "base_link"
"""Of REP 105: x ahead, y left, z up, the origin on the ground."""


class Grids:
    """Makes and sends them. For one thread at a time. The launch file alone says which there are."""

    def __init__(
        self, configs: Mapping[str, GridConfig], sink: MessageSink, context: Callable[[], StreamContext]
    ) -> None:
        """context: what is known of the source now."""
        self._configs, self._sink, self._context = configs, sink, context
        self._mappers: dict[str, tuple[CameraMount, GridMapper]] = {}

    def publish(self, context: StreamContext, window: FrameWindow, placed: Sequence[PlacedFrame]) -> None:
        """Take in a window's frames, and send what is known after its last one."""
        mount = context.mount
        if mount is None:  # `prepare_stream` refuses a grid without one
            return
        for grid_id, config in self._configs.items():
            started_ns = time.monotonic_ns()
            made = self._mappers.get(grid_id)
            if made is None or made[0] != mount:
                mapper = GridMapper(mount, extent_m=config.extent_m, cell_m=config.cell_m, seconds=config.seconds)
                made = self._mappers[grid_id] = mount, mapper
            stamps_s = [stamp_ns / 1e9 for stamp_ns in window.stamps_ns]
            grids = [made[1].update(each.seen, at) for each, at in zip(placed, stamps_s, strict=True)]
            score = placed[-1].seen.geometry.ood
            self._sink.send(grid_message(context, window, grid_id, config, grids[-1], score, started_ns))

    def announce_end(self, last_window_id: int, *, delay_ms: int | None) -> None:
        """End every grid. delay_ms: see MessageSink."""
        for grid_id in self._configs:
            message = end_message(self._context(), grid_topic(grid_id), grid_id, 1, last_window_id)
            self._sink.end(message, delay_ms=delay_ms)


def grid_message(
    context: StreamContext,
    window: FrameWindow,
    grid_id: str,
    config: GridConfig,
    grid: Grid,
    score: float,
    started_ns: int,
) -> GridMessage:
    """A grid of the window's last frame. score: `FrameGeometry.ood`. started_ns: on the monotonic clock."""
    flags = (*context.ood, *input_flags(window), *world_flags(context.traits, score))
    header = GridHeader(
        **captured(context, window, (started_ns, time.monotonic_ns()), utc_offset_ns()),
        view_id=grid_id,
        view_rev=1,
        frame_id=FRAME_ID,
        quality=QualityRecord(nan_frames=0, ood=flags, steps=0, seed=0, ood_score=score),
        shape=grid.occupancy.shape,
        cell_m=config.cell_m,
        origin_m=(config.extent_m[0], config.extent_m[2]),
        classes=ontology(context.traits),
    )
    header = replace(header, t_capture_ns=header.t_capture_ns[-1:], src=replace(header.src, seq=header.src.seq[-1:]))
    cells = GridLayers(grid.occupancy, grid.visibility, grid.classes, grid.height_m, grid.age_ms)
    return GridMessage(topic=grid_topic(grid_id), header=header, payload=grid_payload(cells))
