"""A file on a disk that may be full: takes pieces whole or not at all, and keeps room for its own end.

What was committed has left this process: it survives `kill -9`. Every few seconds it is also asked to leave the
machine's memory, which is what survives a power cut.
"""

import errno
import logging
import os
import tempfile
from pathlib import Path
from typing import BinaryIO

_LOG = logging.getLogger(__name__)
_RESERVE = 2**20
_INDEX_SHARE = 256  # one byte of index for so many of content: 64 KiB chunks, 200 bytes of index each
_UNSUPPORTED = (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS)


class DiskFile:
    """What the mcap writer writes to. Nothing reaches the disk before `commit`."""

    def __init__(self, path: Path) -> None:
        """Create `path`. Raises OSError: it exists, cannot be created, or there is no room for its end."""
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        self._pending: list[bytes] = []
        self._pending_bytes = self._committed = self._largest = 0
        try:
            self._reserve = _Reserve(path.parent)
            self._reserve.hold(_RESERVE)
        except BaseException:
            os.close(self._file)
            path.unlink(missing_ok=True)
            raise

    @property
    def size(self) -> int:
        """Bytes on the disk."""
        return self._committed

    # What the mcap writer calls.

    def write(self, data: bytes) -> int:
        """Keep until `commit`."""
        self._pending.append(data)
        self._pending_bytes += len(data)
        return len(data)

    def tell(self) -> int:
        """Where the next byte will stand."""
        return self._committed + self._pending_bytes

    def flush(self) -> None:
        """Nothing: see `commit`."""

    # What the recording calls.

    def commit(self) -> None:
        """Write what is pending. Raises OSError: it could not be written whole, so none of it is there; it is still
        pending."""
        if not self._pending:
            return
        try:
            _write_all(self._file, b"".join(self._pending))
        except OSError:
            os.ftruncate(self._file, self._committed)
            os.lseek(self._file, self._committed, os.SEEK_SET)
            raise
        self._largest = max(self._largest, self._pending_bytes)
        self._committed += self._pending_bytes
        self.forget()

    def forget(self) -> None:
        """Give up what is pending."""
        self._pending.clear()
        self._pending_bytes = 0

    def sync(self) -> None:
        """Make what was committed survive a power cut, and keep enough room for the end. Raises OSError: the disk is
        full or broken."""
        self._reserve.hold(_RESERVE + 2 * self._largest + self._committed // _INDEX_SHARE)
        os.fdatasync(self._file)

    def make_room(self) -> None:
        """Give back the room that was kept for the end."""
        self._reserve.release()

    def close(self) -> None:
        """Close; what is pending is lost. Raises OSError."""
        self._reserve.release()
        os.close(self._file)


class _Reserve:
    """Room on a disk that nobody else gets: a file without a name, which vanishes with this process."""

    def __init__(self, folder: Path) -> None:
        self._file: BinaryIO | None = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  closed by release()
        self._held = 0

    def hold(self, size: int) -> None:
        """At least so many bytes; what a file system cannot reserve is not. Raises OSError: there is no room."""
        if self._file is None or size <= self._held:
            return
        try:
            os.posix_fallocate(self._file.fileno(), self._held, size - self._held)
        except OSError as error:
            if error.errno not in _UNSUPPORTED:
                raise
            _LOG.info("this file system cannot keep room for the end of a recording: %s", error)
        self._held = size

    def release(self) -> None:
        """Give it all back."""
        if self._file is not None:
            self._file.close()
            self._file = None


def _write_all(file: int, data: bytes) -> None:
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(file, rest) :]
