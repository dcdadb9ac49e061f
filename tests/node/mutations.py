"""Inputs somebody has tampered with, and what must become of each: something valid, or a documented error.

GCD_MUTATIONS=100000 makes as many inputs for each parser; the default is a fraction.
"""

import gc
import os
import random
import tracemalloc
from collections import Counter
from collections.abc import Callable, Sequence

from gcd_client.protocol import MAGIC

ROUNDS = int(os.environ.get("GCD_MUTATIONS", "200"))
MOST_TRACED = 1000
GROWN_BYTES = 2_000_000

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

    def read_some(count: int) -> int:
        """How much Python and numpy hold then, if that is traced."""
        for part in (inputs.next() for _ in range(count)):
            try:
                ended[read(part)] += 1
            except refusals as known:
                ended["refused" if 0 < len(str(known)) < 2000 else "refused without a line"] += 1
            except Exception as other:
                raise AssertionError(f"{type(other).__name__} for {part[:2000]!r}") from other
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    few = max(1, min(ROUNDS // 4, MOST_TRACED))
    tracemalloc.start()  # reading is four times as slow then
    try:
        before = read_some(few)
        assert read_some(few) - before < GROWN_BYTES
    finally:
        tracemalloc.stop()
    read_some(ROUNDS - 2 * few)
    assert "refused without a line" not in ended
    return ended
