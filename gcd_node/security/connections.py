"""The connections of a bound socket, seen through ZeroMQ's monitor: to tell who was dropped, and to cut who must go.

Standard library only, Python 3.10 syntax: planners import this.
"""

import logging
import os
import socket
import stat

_LOG = logging.getLogger(__name__)
_MOST = 256


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
        kept = self._kept.pop(handle, None)
        if kept is not None:
            kept.close()
