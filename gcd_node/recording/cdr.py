"""Lays values out one after another as ROS 2 does (CDR, little-endian). `gcd_node.sources` reads the same."""

import struct
from collections.abc import Sequence
from typing import Literal, TypeAlias

Code: TypeAlias = Literal["B", "i", "I", "d"]
"""A number's kind, as in `struct`: u8, i32, u32, float64."""

_ENCAPSULATION = b"\0\1\0\0"
_SIZES: dict[Code, int] = {"B": 1, "i": 4, "I": 4, "d": 8}
_SECOND_NS = 1_000_000_000
_LATEST_S = 2**31 - 1  # builtin_interfaces/Time ends in 2038


class CdrWriter:
    """The fields of one message, in their order. Numbers begin at multiples of their size."""

    def __init__(self) -> None:
        self._parts: list[bytes | memoryview] = [_ENCAPSULATION]
        self._size = 0  # without the four bytes above, from where places are counted

    def number(self, code: Code, value: float) -> "CdrWriter":
        """One number."""
        return self.numbers(code, (value,))

    def numbers(self, code: Code, values: Sequence[float]) -> "CdrWriter":
        """Several of a fixed count, as in `float64[9]`."""
        self._add(b"\0" * (-self._size % _SIZES[code]))
        self._add(struct.pack(f"<{len(values)}{code}", *values))
        return self

    def listed(self, code: Code, values: Sequence[float]) -> "CdrWriter":
        """A sequence behind its length, as in `float64[]`."""
        self.number("I", len(values))
        return self.numbers(code, values) if values else self

    def blob(self, data: bytes | memoryview) -> "CdrWriter":
        """Bytes behind their length, as in `uint8[]`; not copied yet."""
        self.number("I", len(data))
        self._add(data)
        return self

    def text(self, value: str) -> "CdrWriter":
        """A string behind its length; its end mark counts."""
        return self.blob(value.encode() + b"\0")

    def stamp(self, stamp_ns: int) -> "CdrWriter":
        """builtin_interfaces/Time; nanoseconds since 1970, or since whatever a recording's clock counts from."""
        seconds, nanoseconds = divmod(stamp_ns, _SECOND_NS)
        return self.number("i", min(seconds, _LATEST_S)).number("I", nanoseconds)

    def header(self, stamp_ns: int, frame_id: str) -> "CdrWriter":
        """std_msgs/Header."""
        return self.stamp(stamp_ns).text(frame_id)

    def done(self) -> bytes:
        """The whole message."""
        return b"".join(self._parts)

    def _add(self, data: bytes | memoryview) -> None:
        self._parts.append(data)
        self._size += len(data)
