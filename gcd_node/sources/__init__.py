"""Where frames come from: recordings, cameras, and a moving pattern. One contract, `gcd_node.frame`.

What needs an optional package is imported when such a source is opened.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from gcd_node.errors import SourceError
from gcd_node.frame import FrameSource
from gcd_node.source_config import (
    FileSource,
    FolderSource,
    McapSource,
    OakSource,
    PushSource,
    RtspSource,
    SourceConfig,
    SyntheticSource,
    V4l2Source,
)
from gcd_node.sources.files import ImageFolder, MovingPattern, VideoFile
from gcd_node.sources.opencv import open_stream, open_v4l2

if TYPE_CHECKING:
    from gcd_node.auth import EventSink, ServerSecurity

__all__ = ["open_source", "resolve_path"]

_PACKAGE = "package:"


def open_source(
    config: SourceConfig, security: "ServerSecurity | None" = None, on_event: "EventSink | None" = None
) -> FrameSource:
    """The source a launch file asks for, open. security, on_event: for one that listens, see open_push().

    Raises:
        SourceAbsentError: there is no such camera, or it does not answer in time.
        SourceError: it cannot be opened, or the package it needs is not installed; the message says which.
        ConfigError: a setting is wrong.
    """
    match config:
        case FileSource():
            return VideoFile(resolve_path(config.path), pace=config.pace, loop=config.loop, fps=config.fps)
        case FolderSource():
            return ImageFolder(resolve_path(config.path), fps=config.fps, pace=config.pace, loop=config.loop)
        case McapSource():
            from gcd_node.sources.logs import LogSource

            return LogSource(
                resolve_path(config.path),
                topic=config.topic,
                depth_topic=config.depth_topic,
                odometry_topic=config.odometry_topic,
                pace=config.pace,
                loop=config.loop,
            )
        case SyntheticSource():
            return MovingPattern(fps=config.fps, frames=config.frames, pace=config.pace, loop=config.loop)
        case V4l2Source():
            return open_v4l2(config)
        case RtspSource():
            return open_stream(config)
        case OakSource():
            from gcd_node.sources.oak import open_oak

            return open_oak(config)
        case PushSource():
            from gcd_node.sources.push import open_push

            return open_push(config, security, on_event)


def resolve_path(name: str) -> Path:
    """The path a launch file means: `package:drive.mp4` is a file of this package, anything else is itself.

    Raises:
        SourceError: the package has no such file.
    """
    if not name.startswith(_PACKAGE):
        return Path(name).expanduser()
    assets = Path(__file__).parent.parent / "assets"
    path = assets / name.removeprefix(_PACKAGE)
    if path.parent != assets or not path.is_file():
        known = ", ".join(sorted(_PACKAGE + entry.name for entry in assets.glob("*.mp4")))
        raise SourceError(f"the package has no file {name}; it has {known or 'none, install it again'}")
    return path
