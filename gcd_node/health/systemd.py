"""Tells systemd how the node does (Type=notify, WatchdogSec): ready, alive, stopping. Standard library only.

Without a service manager there is no NOTIFY_SOCKET, and nothing is sent.
"""

import logging
import os
import socket
import time
from collections.abc import Callable, Mapping

_LOG = logging.getLogger(__name__)
_SEND_TIMEOUT_S = 0.5
_LONGEST_STATUS = 200


class ServiceManager:
    """The service manager that started this process, if one did.

    watchdog_s: it restarts the node after so long without `alive`; None if it does not watch.
    """

    def __init__(self, environment: Mapping[str, str], clock: Callable[[], float] = time.monotonic) -> None:
        """Look who started us. environment: normally os.environ. clock: monotonic seconds."""
        self._address = environment.get("NOTIFY_SOCKET", "")
        self._clock = clock
        self._fed_s: float | None = None
        self._complained = False
        self.watchdog_s = _watchdog_s(environment) if self._address else None
        if self._address and self._address[0] not in "/@":
            self._complain(f"NOTIFY_SOCKET={self._address!r} is neither a path nor an abstract name")
            self._address = ""

    @property
    def present(self) -> bool:
        """Whether anybody listens."""
        return bool(self._address)

    def ready(self, status: str = "") -> bool:
        """The start is over: call it once views can come."""
        return self._notify("READY=1", *_status_line(status))

    def status(self, text: str) -> bool:
        """One line for `systemctl status`."""
        return self._notify(*_status_line(text))

    def alive(self) -> bool:
        """Feed the watchdog: call it often, and only while nothing hangs; it is sent four times in each period."""
        if self.watchdog_s is None:
            return False
        now_s = self._clock()
        if self._fed_s is not None and now_s - self._fed_s < self.watchdog_s / 4:
            return False
        sent = self._notify("WATCHDOG=1")
        if sent:
            self._fed_s = now_s
        return sent

    def extend_start(self, seconds: float) -> bool:
        """Loading takes longer: allow so much more from now, for starting and for stopping."""
        return self._notify(f"EXTEND_TIMEOUT_USEC={round(seconds * 1e6)}")

    def stopping(self, status: str = "") -> bool:
        """The end has begun."""
        return self._notify("STOPPING=1", *_status_line(status))

    def _notify(self, *lines: str) -> bool:
        """Whether it was sent. A failure is logged once: the node goes on without."""
        if not self._address or not lines:
            return False
        address = "\0" + self._address[1:] if self._address[0] == "@" else self._address
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as link:
                link.settimeout(_SEND_TIMEOUT_S)
                link.connect(address)
                link.sendall("\n".join(lines).encode())
        except OSError as error:
            self._complain(f"cannot reach the service manager at {self._address}: {error}")
            return False
        return True

    def _complain(self, text: str) -> None:
        if not self._complained:
            _LOG.warning("%s; the node goes on without telling it", text)
        self._complained = True


def service_manager() -> ServiceManager:
    """The one of this process."""
    return ServiceManager(os.environ)


def _watchdog_s(environment: Mapping[str, str]) -> float | None:
    """The watchdog's period if it watches this very process."""
    period, process = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
    if not period.isdecimal() or int(period) == 0:
        return None
    if process and process != str(os.getpid()):
        return None
    return int(period) / 1e6


def _status_line(text: str) -> tuple[str, ...]:
    """STATUS=..., or nothing: line breaks would begin another assignment."""
    line = " ".join(text.split())
    return (f"STATUS={line[:_LONGEST_STATUS]}",) if line else ()
