"""Where frames come from: recordings, cameras, and a drawn drive. One contract, `gcd_node.frame`.

What needs an optional package is imported when such a source is opened.
"""

from pathlib import Path

from gcd_node.config import SourceConfig
from gcd_node.errors import ConfigError
from gcd_node.frame import FrameSource
from gcd_node.sources.image_folder import ImageFolder, list_pictures, read_picture
from gcd_node.sources.packaged import resolve_path
from gcd_node.sources.synthetic import SyntheticDrive
from gcd_node.sources.v4l2_device import V4l2Request, open_v4l2
from gcd_node.sources.video_file import VideoFile
from gcd_node.sources.video_stream import open_stream

__all__ = [
    "ImageFolder",
    "SyntheticDrive",
    "V4l2Request",
    "VideoFile",
    "list_pictures",
    "open_source",
    "open_stream",
    "open_v4l2",
    "read_picture",
    "resolve_path",
]


def open_source(config: SourceConfig) -> FrameSource:
    """The source a launch file asks for, open.

    Raises:
        SourceAbsentError: there is no such camera, or it does not answer in time.
        SourceError: it cannot be opened, or the package it needs is not installed; the message says which.
        ConfigError: a setting is missing or wrong.
    """
    if config.kind in ("v4l2", "rtsp", "oak"):
        return _open_camera(config)
    if config.kind == "synthetic":
        fps = 10.0 if config.fps is None else config.fps
        return SyntheticDrive(fps=fps, seed=config.seed, frames=config.frames, pace=config.pace)
    return _open_recording(config)


def _open_camera(config: SourceConfig) -> FrameSource:
    if config.kind == "v4l2":
        request = V4l2Request(width=config.width, height=config.height, fps=config.fps)
        return open_v4l2(config.device, request, open_timeout_s=config.open_timeout_s)
    if config.kind == "rtsp":
        if config.url is None:
            raise ConfigError("source kind 'rtsp' needs a url")
        return open_stream(config.url, fps=config.fps, open_timeout_s=config.open_timeout_s)
    from gcd_node.sources.oak_camera import open_oak

    return open_oak(config)


def _open_recording(config: SourceConfig) -> FrameSource:
    if config.path is None:
        raise ConfigError(f"source kind {config.kind!r} needs a path")
    path = resolve_path(config.path)
    if config.kind == "file":
        return VideoFile(path, pace=config.pace, loop=config.loop, fps=config.fps)
    if config.kind == "mcap":
        return _open_log(config, path)
    if config.fps is None:
        raise ConfigError("an image folder does not know its frame rate: give fps in [source]")
    return ImageFolder(path, fps=config.fps, pace=config.pace, loop=config.loop)


def _open_log(config: SourceConfig, path: Path) -> FrameSource:
    if config.fps is not None:
        raise ConfigError("the pictures of a log have stamps of their own: leave fps out of [source]")
    from gcd_node.sources.mcap_log import McapLog

    return McapLog(path, topic=config.topic, pace=config.pace, loop=config.loop)
