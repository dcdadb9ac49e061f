"""The connections of a bound socket, seen through ZeroMQ's monitor: to tell who was dropped, and to cut who must go.

Standard library only, Python 3.10 syntax: planners import this.
"""

import fcntl
import logging
import os
import socket
import stat
import struct
import termios
from collections.abc import Iterator
from dataclasses import dataclass

_LOG = logging.getLogger(__name__)
_MOST = 256
_RECEIVED_AT = 128  # `tcpi_bytes_received` in `struct tcp_info`, Linux 4.1 and later

_RESET = struct.pack("ii", 1, 0)


@dataclass(frozen=True)
class Allowance:
    """How much a client may send before its message ends: so many bytes, and so many more a second.

    ZeroMQ hands over whole messages alone, limits each part of one, and not their number: what a client sends without
    an end piles up inside of it, 64 bytes of memory for two on the wire.
    """

    burst: int
    per_s: float = 0.0


class Connections:
    """Tells a client that was dropped from one that left; the monitor's events are the same for both.

    A second handle on each connection stays when ZeroMQ closes its own: where the other end is still there, or has
    sent what nobody read, it was not the client who hung up. After a handshake, ZeroMQ hangs up on oversize alone.
    A failed handshake names no connection, but the next one to end is always its own.
    """

    def __init__(self) -> None:
        self._kept: dict[int, socket.socket] = {}
        self._unnoticed: set[int] = set()
        self._failed = False
        self._begun: dict[int, tuple[int, float]] = {}  # bytes taken, and when, as the message in work began
        self._whole: set[int] = set()

    def accepted(self, handle: int) -> None:
        """Keep a second handle; a connection already gone, or too many of them, and it goes unnoticed."""
        self._forget(handle)
        if len(self._kept) >= _MOST:
            self._unnoticed.add(handle)
            return
        try:
            if stat.S_ISSOCK(os.fstat(handle).st_mode):
                self._kept[handle] = socket.socket(fileno=os.dup(handle))
        except OSError as error:
            _LOG.debug("a connection was gone before it could be looked at: %s", error)

    def missed(self, handle: int) -> None:
        """It had ended before it could be looked at; what was kept may be another one, so it goes unnoticed."""
        self._forget(handle)
        self._unnoticed.discard(handle)

    def failed(self) -> None:
        """A handshake came to nothing."""
        self._failed = True

    def cut_off(self, handle: int) -> bool:
        """Whether this end hung up on a client it had welcomed; lets go of the connection."""
        self._unnoticed.discard(handle)
        welcomed, self._failed = not self._failed, False
        kept = self._kept.get(handle)
        if kept is None:
            return False
        try:
            return kept.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) != b"" and welcomed
        except BlockingIOError:
            return welcomed
        except OSError:
            return False  # the other end died
        finally:
            self._forget(handle)

    def whole(self, handle: int) -> None:
        """A message has arrived whole; from any thread."""
        self._whole.add(handle)

    def cut_endless(self, port: int, allowance: Allowance, now_s: float) -> int:
        """Hang up on whoever has sent more than he may, to this port of ours, since his last whole message; tcp alone.

        Returns:
            How many.
        """
        whole, self._whole = self._whole, set()
        endless: list[int] = []
        for handle, connection in self._at_hand():
            taken = _taken(connection, port)
            if taken is None:
                continue
            begun, since_s = self._begun.setdefault(handle, (0, now_s))
            if handle in whole:
                self._begun[handle] = taken, now_s
            elif taken - begun > allowance.burst + allowance.per_s * (now_s - since_s) and _shut(connection):
                endless.append(handle)
        for handle in endless:  # its end is told here, once
            self._forget(handle)
        return len(endless)

    def _at_hand(self) -> Iterator[tuple[int, socket.socket]]:
        yield from tuple(self._kept.items())
        for handle in tuple(self._unnoticed):
            try:
                borrowed = socket.socket(fileno=os.dup(handle))
            except OSError:
                continue
            with borrowed:
                yield handle, borrowed

    def cut_all(self, port: int) -> int:
        """Hang up on everybody who is connected to this port of ours; whoever may, connects again by himself.

        Returns:
            How many had gone unnoticed, and are still connected.
        """
        for kept in self._kept.values():
            try:
                if kept.getsockname()[1] == port:  # a number may have come to stand for another socket meanwhile
                    kept.shutdown(socket.SHUT_RDWR)
            except OSError as error:
                _LOG.debug("a connection was gone before it could be cut: %s", error)
        self.forget()
        unnoticed, self._unnoticed = len(self._unnoticed), set()
        return unnoticed

    def forget(self) -> None:
        """Let go of all."""
        for handle in tuple(self._kept):
            self._forget(handle)

    def _forget(self, handle: int) -> None:
        self._begun.pop(handle, None)
        kept = self._kept.pop(handle, None)
        if kept is not None:
            kept.close()


def _taken(connection: socket.socket, port: int) -> int | None:
    """How many bytes ZeroMQ has taken from a tcp connection to this port of ours; None of any other."""
    try:
        if connection.family == socket.AF_UNIX or connection.getsockname()[1] != port:
            return None
        told = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _RECEIVED_AT + 8)
        (waiting,) = struct.unpack("i", fcntl.ioctl(connection, termios.FIONREAD, bytes(4)))
        return struct.unpack_from("=Q", told, _RECEIVED_AT)[0] - waiting if len(told) > _RECEIVED_AT else None
    except OSError:
        return None  # it is gone, or was never one


def _shut(connection: socket.socket) -> bool:
    """Hang up so that the other end hears of it whatever it still has to send; False if it was gone."""
    try:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        connection.shutdown(socket.SHUT_RDWR)
    except OSError as error:
        _LOG.debug("a connection was gone before it could be cut: %s", error)
        return False
    return True
