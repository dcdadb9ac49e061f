"""Where frames come from: video files, folders of pictures, and a drawn drive. One contract, `gcd_node.frame`."""

from gcd_node.config import SourceConfig
from gcd_node.errors import ConfigError
from gcd_node.frame import FrameSource
from gcd_node.sources.image_folder import ImageFolder, list_pictures, read_picture
from gcd_node.sources.packaged import resolve_path
from gcd_node.sources.synthetic import SyntheticDrive
from gcd_node.sources.video_file import VideoFile

__all__ = [
    "ImageFolder",
    "SyntheticDrive",
    "VideoFile",
    "list_pictures",
    "open_source",
    "read_picture",
    "resolve_path",
]


def open_source(config: SourceConfig) -> FrameSource:
    """The source a launch file asks for, open.

    Raises:
        SourceError: it cannot be opened; the message says why.
        ConfigError: a setting is missing.
    """
    if config.kind == "synthetic":
        fps = 10.0 if config.fps is None else config.fps
        return SyntheticDrive(fps=fps, seed=config.seed, frames=config.frames, pace=config.pace)
    if config.path is None:
        raise ConfigError(f"source kind {config.kind!r} needs a path")
    path = resolve_path(config.path)
    if config.kind == "file":
        return VideoFile(path, pace=config.pace, loop=config.loop, fps=config.fps)
    if config.fps is None:
        raise ConfigError("an image folder does not know its frame rate: give fps in [source]")
    return ImageFolder(path, fps=config.fps, pace=config.pace, loop=config.loop)
