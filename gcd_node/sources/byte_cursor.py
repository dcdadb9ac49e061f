"""Reads numbers, strings and blobs from bytes one after another, and never past the end."""

import struct

from gcd_node.errors import SourceError


class ByteCursor:
    """A place in some bytes.

    aligned: numbers begin at multiples of their size, counted from the beginning, as in CDR.
    big_endian: byte order of numbers.
    """

    def __init__(self, data: bytes | memoryview, *, aligned: bool = False, big_endian: bool = False) -> None:
        self._data = memoryview(data)
        self._place = 0
        self._aligned = aligned
        self._order = ">" if big_endian else "<"

    @property
    def left(self) -> int:
        """Bytes not yet read."""
        return len(self._data) - self._place

    def integer(self, code: str) -> int:
        """The next integer, by its code in `struct`. Raises SourceError at the end."""
        return int(self._numbers(code, 1)[0])

    def floats(self, count: int) -> tuple[float, ...]:
        """The next `count` float64. Raises SourceError if there are fewer."""
        return tuple(map(float, self._numbers("d", count)))

    def blob(self, length: int) -> memoryview:
        """The next `length` bytes, not copied. Raises SourceError if there are fewer."""
        if not 0 <= length <= self.left:
            raise SourceError(f"a message ends {length - self.left} bytes before a field of it does: it is damaged")
        part = self._data[self._place : self._place + length]
        self._place += length
        return part

    def text(self) -> str:
        """A string behind its u32 length; an end mark (NUL) is left out. Raises SourceError if it is cut short."""
        raw = bytes(self.blob(self.integer("I")))
        return raw.rstrip(b"\0").decode("utf-8", "replace")

    def _numbers(self, code: str, count: int) -> tuple[int | float, ...]:
        size = struct.calcsize("=" + code)
        if self._aligned and count:
            self.blob(min(-self._place % size, self.left))
        return struct.unpack(f"{self._order}{count}{code}", self.blob(size * count))
