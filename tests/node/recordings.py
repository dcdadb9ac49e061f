"""Recordings for tests: made by a node over fakes, read back by the reference libraries."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from fakes import LOCKSTEP, Box, FakeSource, FakeSynthesizer, fake_config, made_node, run, traits
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader
from mcap_ros2.decoder import DecoderFactory
from zstandard import ZstdError

from gcd_model import Traits
from gcd_node.config import NodeConfig
from gcd_node.frame import Frame, FrameSource, LensModel
from gcd_node.node import Node
from gcd_node.sources import open_source

SECOND_NS = 10**9
LENS = LensModel(
    width=192, height=128, fx=200.0, fy=201.0, cx=95.5, cy=63.5, distortion="plumb_bob",
    coefficients=(-0.1, 0.02, 0.0, 0.0, 0.0),
)  # fmt: skip


class Calibrated(FakeSource):
    """A source that knows its lens, with noise that no coder keeps whole."""

    def __init__(self, count: int = 30, fps: float = 24.0) -> None:
        super().__init__(count, fps=fps, size=(192, 128))
        self.info = replace(self.info, lens=LENS)

    def frames(self) -> Iterator[Frame]:
        draw = np.random.default_rng(0)
        for frame in super().frames():
            yield replace(frame, image=draw.integers(0, 256, frame.image.shape, np.uint8))


@dataclass(frozen=True)
class Said:
    """One message of a recording; value: decoded by the reference library for ROS 2."""

    topic: str
    log_ns: int
    publish_ns: int
    sequence: int
    value: Any

    @property
    def stamp_ns(self) -> int:
        """Of its header."""
        return self.value.header.stamp.sec * SECOND_NS + self.value.header.stamp.nanosec

    @property
    def told(self) -> dict[str, Any]:
        """The JSON in it."""
        return json.loads(self.value.data)


def recorder_config(folder: Path, *changes: str, source: str = LOCKSTEP, keep_free_mb: float = 0.0) -> NodeConfig:
    """changes: KEY=VALUE."""
    where = (f"record.folder={folder}", f"record.keep_free_mb={keep_free_mb}", "record.autostart=true")
    return fake_config(*where, *changes, source=source)


def recorded(
    config: NodeConfig, source: FrameSource | None = None, made: Traits | None = None, holds: Sequence[str] = ()
) -> tuple[Node, Box]:
    """A node that recorded a whole run. holds: see FakeSynthesizer."""
    box = Box()
    node = made_node(config, FakeSynthesizer(made or traits(), holds=holds), source or FakeSource(30), box)
    node.run()
    return node, box


def replayed(path: Path, made: Traits | None = None, topic: str = "") -> tuple[FrameSource, Box]:
    """What a node makes of a recording."""
    named = f'topic = "{topic}"' if topic else ""
    config = fake_config(source=f'kind = "mcap"\npath = "{path}"\npace = "lockstep"\n{named}')
    opened = open_source(config.source)
    return opened, run(config, FakeSynthesizer(made or traits()), opened)


def files(folder: Path) -> list[Path]:
    """Every file of every recording, in the order of their names."""
    return sorted(folder.rglob("*.mcap"))


def said(path: Path) -> list[Said]:
    """Every message of a finished file."""
    with path.open("rb") as file:
        return [
            Said(channel.topic, message.log_time, message.publish_time, message.sequence, decoded)
            for _, channel, message, decoded in make_reader(
                file, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages()
        ]


def of(messages: Sequence[Said], topic: str) -> list[Said]:
    return [each for each in messages if each.topic == topic]


def summary(path: Path) -> Any:
    with path.open("rb") as file:
        return make_reader(file).get_summary()


def extras(path: Path) -> tuple[dict[str, dict[str, str]], dict[str, bytes]]:
    """Its metadata and attachments, by name."""
    with path.open("rb") as file:
        reader = make_reader(file)
        metadata = {each.name: each.metadata for each in reader.iter_metadata()}
        return metadata, {each.name: each.data for each in reader.iter_attachments()}


def salvaged(path: Path, topic: str) -> list[int]:
    """Sequence numbers on a topic, as far as the reference reader gets front to back in a file without an end."""
    found: list[int] = []
    with path.open("rb") as file:
        try:
            for _, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
                if channel.topic == topic:
                    found.append(message.sequence)
        except (McapError, EOFError, ValueError, ZstdError):
            pass  # where it was cut
    return found
