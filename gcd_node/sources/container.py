"""Which files are videos, by their first bytes.

The decoder alone is no judge: it plays a text file as a picture of its letters, and follows a play list to files and
addresses nobody named.
"""

from pathlib import Path

from gcd_node.errors import SourceError

_HEAD_BYTES = 512
_TRANSPORT_PACKET_BYTES = 188
_BOXES = frozenset({b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot", b"moof", b"styp", b"sidx"})
_SIGNATURES = (
    b"\x1a\x45\xdf\xa3",  # mkv, webm
    b"OggS",
    b"FLV\x01",
    b"DKIF",  # ivf
    b"\x30\x26\xb2\x75\x8e\x66\xcf\x11",  # wmv, asf
    b"GIF8",
    b"YUV4MPEG2",
    b"\xff\xd8\xff",  # a stream of jpeg pictures
    b"\x00\x00\x01",  # raw mpeg, h264, h265
    b"\x00\x00\x00\x01",
)
_PICTURES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff"})


def check_video(path: Path) -> None:
    """Raise SourceError unless `path` is a file that begins as a video does."""
    if not path.exists():
        raise SourceError(f"no such video: {path}; check the path")
    if path.is_dir():
        raise SourceError(f'{path} is a folder, not a video; for a folder of pictures say kind = "folder"')
    if not path.is_file():
        raise SourceError(f"{path} is not a regular file; give a video file")
    if path.suffix.lower() in _PICTURES:
        raise SourceError(f'{path} is a still picture, not a video; put pictures in a folder and say kind = "folder"')
    head = _head(path)
    if not head:
        raise SourceError(f"{path} is empty (0 bytes); copy or record it again")
    if not looks_like_video(head):
        raise SourceError(
            f"{path} is not a video: its first bytes, {head[:8]!r}, are none of mp4, mkv, webm, avi, mov or a raw "
            "stream; give a video file"
        )


def looks_like_video(head: bytes) -> bool:
    """True if a file that begins with `head` is of a container or stream kind that holds video."""
    return (
        head.startswith(_SIGNATURES)
        or head[4:8] in _BOXES
        or (head.startswith(b"RIFF") and head[8:12] == b"AVI ")
        or (head[:1] == b"\x47" and head[_TRANSPORT_PACKET_BYTES : _TRANSPORT_PACKET_BYTES + 1] == b"\x47")
    )


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(_HEAD_BYTES)
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror}; check its permissions") from error
