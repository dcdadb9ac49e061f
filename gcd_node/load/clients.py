"""Processes of our own that connect to a node, seen from the one that starts them."""

import subprocess
import sys
import threading
from collections import deque
from types import TracebackType
from typing import Generic, TypeVar

import msgspec

Said = TypeVar("Said", bound=msgspec.Struct)
_KEPT = 100_000
_END_S = 5.0


class Arrival(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A view reached a reader. arrived_ns: monotonic clock, which all processes of a machine share.

    first_seq, last_seq: of its input frames. skipped: messages missed before it.
    """

    arrived_ns: int
    first_seq: int
    last_seq: int
    window_id: int
    skipped: int


class Attacks(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a hostile client has done so far, by kind; refused: connections it did not get."""

    done: dict[str, int]
    refused: int


class Client(Generic[Said]):
    """A client process and what it says. Use it as a context manager.

    kind: of what it says, one object a line. module: to run; see load.reader and load.hostile.
    """

    def __init__(self, kind: type[Said], module: str, *arguments: str) -> None:
        self._kind = kind
        self._said: deque[Said] = deque(maxlen=_KEPT)
        command = [sys.executable, "-m", f"gcd_node.load.{module}", *arguments]
        self._process = subprocess.Popen(  # noqa: S603
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
        )
        self._thread = threading.Thread(target=self._listen, name="client output", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether it still runs."""
        return self._process.poll() is None

    @property
    def last(self) -> Said | None:
        """What it said last, None if nothing; `take` removes it."""
        return self._said[-1] if self._said else None

    def take(self) -> list[Said]:
        """Everything it has said since the last call."""
        return [self._said.popleft() for _ in range(len(self._said))]

    def close(self) -> None:
        """End it; a second call does nothing."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._thread.join()

    def __enter__(self) -> "Client[Said]":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    def _listen(self) -> None:
        output = self._process.stdout
        assert output is not None
        with output:
            for line in output:
                self._said.append(msgspec.json.decode(line, type=self._kind))


def reader(endpoint: str, view: str, *options: str) -> Client[Arrival]:
    """A reader of windows; options as in load.reader."""
    return Client(Arrival, "reader", endpoint, view, *options)


def hostile(data: str, status: str, control: str, seed: int) -> Client[Attacks]:
    """A client that attacks every socket of a node."""
    return Client(Attacks, "hostile", data, status, control, str(seed))
