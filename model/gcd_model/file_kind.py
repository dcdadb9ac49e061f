"""What a file is, by its first bytes and its table of contents, and what to do if it is not weights. Opens nothing."""

import zipfile
from collections.abc import Sequence
from typing import Literal

from gcd_model.errors import CheckpointError

HEAD = 512
"""How many first bytes `file_kind` wants."""

FETCH_AGAIN = "fetch it again and compare its size with the publisher's"
SAVE_AGAIN = "load it where it was made and write it again with torch.save (torch 1.6 or newer)"
_LARGEST_HEADER = 1 << 24  # SVD has 0.4 MB; the library takes 100 MB, and builds gigabytes from them

FileKind = Literal["zip", "safetensors"]


def file_kind(head: bytes, size: int) -> FileKind:
    """Tell a torch zip from safetensors.

    Args:
        head: the first HEAD bytes. size: of the whole file.
    Raises:
        CheckpointError: names what it is instead, and the remedy.
    """
    if size == 0:
        raise CheckpointError(f"is empty (0 bytes); {FETCH_AGAIN}")
    if head.startswith(b"PK\x03\x04"):
        return "zip"
    if head.startswith(b"version https://git-lfs"):
        raise CheckpointError("is a Git LFS pointer, not the weights themselves; run `git lfs pull` where it lies")
    if head.lstrip().lower().startswith((b"<!doctype", b"<html", b"<?xml")):
        raise CheckpointError("is a web page, not weights: the download needs another address or a login")
    if head.startswith((b"\x80\x02", b"\x80\x03", b"\x80\x04")) or head[257:262] == b"ustar":
        raise CheckpointError(f"was written in torch's old format, before zip, and cannot be mapped; {SAVE_AGAIN}")
    if head[8:9] == b"{":
        return _safetensors(int.from_bytes(head[:8], "little"), size)
    raise CheckpointError(
        "is neither a torch zip (.ckpt) nor safetensors; wanted are GCD's .ckpt, svd.safetensors, a diffusers "
        "folder or a file of `gcd-node weights convert`"
    )


def _safetensors(length: int, size: int) -> FileKind:
    if length > _LARGEST_HEADER:
        raise CheckpointError(f"has a safetensors header of {length} bytes, too long to be true; {FETCH_AGAIN}")
    if 8 + length > size:
        raise CheckpointError(f"ends within its header ({size} bytes, the header alone has {length}); {FETCH_AGAIN}")
    return "safetensors"


def check_archive(entries: Sequence[zipfile.ZipInfo]) -> None:
    """Whether a zip is a checkpoint torch can map. Raises CheckpointError if not."""
    inner = {entry.filename.partition("/")[2] for entry in entries}
    if any(entry.filename.endswith("constants.pkl") for entry in entries):
        raise CheckpointError("is a TorchScript program, which would be executed; wanted are weights only")
    if "data.pkl" not in inner:
        raise CheckpointError("is a zip without data.pkl, not a torch checkpoint; unpack it if it only wraps one")
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
        raise CheckpointError(f"is a zip whose tensors are compressed and cannot be mapped; {SAVE_AGAIN}")
