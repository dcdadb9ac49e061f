"""Inputs somebody has tampered with, and what must become of each: something valid, or a documented error.

GCD_MUTATIONS=100000 makes as many inputs for each parser; the default is a fraction. With --log-cli-level=INFO pytest
shows how they ended and what they left behind.
"""

import gc
import logging
import os
import random
import tracemalloc
from collections import Counter
from collections.abc import Callable, Sequence

import psutil

from gcd_client.protocol import MAGIC

_LOG = logging.getLogger(__name__)
ROUNDS = int(os.environ.get("GCD_MUTATIONS", "400"))
MOST_TRACED = 1000
GROWN_BYTES = 2_000_000  # tracemalloc: of Python and numpy
GROWN_MB = 128.0  # resident: of OpenCV too, which keeps some for itself

TEXT_PIECES = (
    b"null", b"true", b"[", b"]", b"{", b"}", b'"', b"\\", b"\\ud800", b",", b":", b"=", b"\n", b"#", b"'''", b"\0",
    b"1e999", b"-0", b"NaN", b"9" * 400, b"\xff\xfe", b"\xed\xa0\x80", b"*a", b"&a ", b"[" * 300, b"2020-01-01",
)  # fmt: skip
BYTE_PIECES = (b"\0" * 8, b"\xff" * 8, b"\x7f" + b"\xff" * 7, b"\1" + b"\0" * 7, b"\xff\xd8\xff", b"\x89PNG", MAGIC)


class Mutator:
    """Turns bits, sets bytes to extremes, cuts out, doubles, moves, and joins one example to another."""

    def __init__(self, seed: int, examples: Sequence[bytes], pieces: Sequence[bytes]) -> None:
        self._chance, self._examples, self._pieces = random.Random(seed), examples, pieces

    def next(self) -> bytes:
        out = bytearray(self._chance.choice(self._examples))
        for _ in range(self._chance.choice((1, 1, 1, 2, 3, 8))):
            self._change(out)
        return bytes(out)

    def _change(self, out: bytearray) -> None:
        chance = self._chance
        at, span = chance.randrange(len(out) + 1), chance.choice((1, 1, 2, 4, 16, 64))
        act = chance.randrange(8)
        if act == 0 and at < len(out):
            out[at] ^= 1 << chance.randrange(8)
        elif act == 1:
            out[at : at + 1] = bytes([chance.randrange(256)])
        elif act == 2:
            del out[at : at + span]
        elif act == 3:
            out[at:at] = out[at : at + span]
        elif act == 4:
            piece = chance.choice(self._pieces)
            out[at : at + chance.choice((0, len(piece)))] = piece
        elif act == 5:
            there = chance.randrange(len(out) + 1)
            out[at:at] = out[there : there + span]
        elif act == 6:
            other = chance.choice(self._examples)
            out[at:] = other[at:]
        else:
            del out[at:]


def outcomes(read: Callable[[bytes], str], inputs: Mutator, *refusals: type[Exception]) -> Counter[str]:
    """Read ROUNDS inputs; how many ended how. What is no documented error fails the test, and so does growth."""
    ended: Counter[str] = Counter()

    def read_some(count: int) -> None:
        for part in (inputs.next() for _ in range(count)):
            line = None
            try:
                outcome = read(part)
            except refusals as known:
                outcome, line = "refused", str(known)
            except Exception as other:
                raise AssertionError(f"{type(other).__name__} for {part[:2000]!r}") from other
            ended[outcome] += 1
            assert line is None or 0 < len(line) < 2000
        gc.collect()

    few = max(1, min(ROUNDS // 4, MOST_TRACED))
    tracemalloc.start()  # reading is four times as slow then
    try:
        read_some(few)
        before = tracemalloc.get_traced_memory()[0]
        read_some(few)
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    before_mb = psutil.Process().memory_info().rss / 2**20
    read_some(ROUNDS - 2 * few)
    grown_mb = psutil.Process().memory_info().rss / 2**20 - before_mb
    _LOG.info("%s; grown by %d bytes, resident %.1f MiB", dict(ended), grown, grown_mb)
    assert grown < GROWN_BYTES
    assert grown_mb < GROWN_MB
    return ended
