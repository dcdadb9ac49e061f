"""Where frames come from: recordings, cameras, and a moving pattern. One contract, `gcd_node.frame`.

What needs an optional package is imported when such a source is opened.
"""

from typing import TYPE_CHECKING

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
from gcd_node.sources.image_folder import ImageFolder, list_pictures, read_picture
from gcd_node.sources.packaged import resolve_path
from gcd_node.sources.synthetic import MovingPattern
from gcd_node.sources.v4l2_device import V4l2Request, open_v4l2
from gcd_node.sources.video_file import VideoFile
from gcd_node.sources.video_stream import open_stream

if TYPE_CHECKING:
    from gcd_node.auth import EventSink, ServerSecurity

__all__ = [
    "ImageFolder",
    "MovingPattern",
    "V4l2Request",
    "VideoFile",
    "list_pictures",
    "open_source",
    "open_stream",
    "open_v4l2",
    "read_picture",
    "resolve_path",
]


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
            return MovingPattern(fps=config.fps, frames=config.frames, pace=config.pace)
        case V4l2Source():
            request = V4l2Request(width=config.width, height=config.height, fps=config.fps)
            return open_v4l2(config.device, request, open_timeout_s=config.open_timeout_s)
        case RtspSource():
            return open_stream(config.url, fps=config.fps, open_timeout_s=config.open_timeout_s)
        case OakSource():
            from gcd_node.sources.oak_camera import open_oak

            return open_oak(config)
        case PushSource():
            from gcd_node.sources.push import open_push

            timeout_s = config.open_timeout_s
            return open_push(
                config.endpoint, fps=config.fps, open_timeout_s=timeout_s, security=security, on_event=on_event
            )
