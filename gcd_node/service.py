"""How the process fits into its machine: service manager, addresses of its HTTP pages, log lines."""

import contextlib
import json
import logging
import math
import os
import queue
import re
import socket
import sys
import threading
import time
from collections.abc import Callable, Generator, Mapping
from datetime import UTC, datetime
from logging.handlers import QueueHandler, QueueListener
from typing import Any

from gcd_node.auth import is_loopback
from gcd_node.errors import ConfigError, EndpointError

_LOG = logging.getLogger(__name__)
_SEND_TIMEOUT_S = 0.5
_WAITING_LINES = 1000
_LAST_LINES_S = 1.0
_LONGEST = 16_000


class ServiceManager:
    """Tells systemd how the node does (Type=notify, WatchdogSec). Without a service manager nothing is sent."""

    def __init__(self, environment: Mapping[str, str], clock: Callable[[], float] = time.monotonic) -> None:
        """environment: normally os.environ. clock: monotonic seconds."""
        self._address = environment.get("NOTIFY_SOCKET", "")
        self._clock, self._fed_s, self._failed = clock, -math.inf, False
        period, process = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
        watched = period.isdecimal() and process in ("", str(os.getpid()))
        self._period_s = int(period) / 1e6 if watched else 0.0

    def ready(self) -> None:
        """The start is over: views come, or the node waits for something that is not its to bring about."""
        self._notify("READY=1")

    def alive(self) -> None:
        """Feed the watchdog: call it often, and only while nothing hangs; it is sent four times in each period."""
        now_s = self._clock()
        is_due = self._period_s > 0 and now_s - self._fed_s >= self._period_s / 4
        if is_due and self._notify("WATCHDOG=1"):
            self._fed_s = now_s

    def stopping(self) -> None:
        """The end has begun."""
        self._notify("STOPPING=1")

    def _notify(self, line: str) -> bool:
        """Whether it was sent. A failure is logged once: the node goes on without."""
        if not self._address:
            return False
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as link:
                link.settimeout(_SEND_TIMEOUT_S)
                link.connect("\0" + self._address[1:] if self._address[0] == "@" else self._address)
                link.sendall(line.encode())
        except OSError as error:
            if not self._failed:
                _LOG.warning("cannot reach the service manager at %s: %s; going on without it", self._address, error)
            self._failed = True
            return False
        return True


def listen(address: str, setting: str) -> socket.socket:
    """A listening socket for an HTTP page on this machine. setting: the address' name, for errors.

    Raises:
        ConfigError: it has no port, or other machines could reach it. EndpointError: the port is in use, or cannot be
            bound.
    """
    host, _, port = address.rpartition(":")
    if not host or not re.fullmatch("[0-9]{1,5}", port) or int(port) > 65535:
        raise ConfigError(f'{setting} must be "127.0.0.1:PORT", got {address[:80]!r}')
    if not is_loopback(f"tcp://{address}"):
        raise ConfigError(
            f'{setting} = "{address}" can be reached from other machines, and nothing there asks who calls: use '
            f"127.0.0.1:{port}, and a proxy on this machine or a tunnel (ssh -L {port}:127.0.0.1:{port} ROBOT)"
        )
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host.strip("[]"), int(port)), family=family)
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise EndpointError(
            f"cannot bind http://{address}: {reason}; stop who uses it or choose another port"
        ) from error


@contextlib.contextmanager
def background_logging(*, as_json: bool) -> Generator[None]:
    """Let a thread of its own write log lines, so that no other waits for a stderr that nobody reads.

    as_json: one JSON object a line; then warnings and uncaught errors of all threads are logged too, as else they
    would break the lines.
    """
    root = logging.getLogger()
    handlers = root.handlers[:]
    if as_json:
        for handler in handlers:
            handler.setFormatter(JsonLines())
        logging.captureWarnings(True)
        sys.excepthook = lambda kind, error, trace: _log_uncaught("", (kind, error, trace))
        threading.excepthook = lambda args: _log_uncaught(f" in {args.thread.name if args.thread else '?'}", args[:3])
    waiting: queue.Queue[Any] = queue.Queue(_WAITING_LINES)
    listener = QueueListener(waiting, *handlers)
    root.handlers = [_Waiting(waiting)]
    listener.start()
    try:
        yield
    finally:
        root.handlers = handlers
        stopping = threading.Thread(target=listener.stop, daemon=True)
        stopping.start()
        stopping.join(_LAST_LINES_S)  # no longer: stderr may be stuck


class _Waiting(QueueHandler):
    """Leaves records for the thread that writes them."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  logging's name
        """What finds no room is lost: a word about it would have to wait for stderr."""


class JsonLines(logging.Formatter):
    """A log record as one line of JSON: `time` (UTC, RFC 3339, microseconds), `level`, `logger`, `message` (with the
    traceback of an error; the end of a long one), `thread`, `pid`; `event`: the node's event that the line tells of."""

    def format(self, record: logging.LogRecord) -> str:
        """The line, without a line break."""
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="microseconds")[:-6] + "Z",
            "level": record.levelname,
            "logger": record.name,
            "message": super().format(record)[-_LONGEST:],
            "thread": record.threadName,
            "pid": record.process,
        }
        event = vars(record).get("event")
        return json.dumps(line if event is None else line | {"event": event}, default=str)


def _log_uncaught(where: str, error: Any) -> None:
    """error: type, value and traceback."""
    if not issubclass(error[0], SystemExit):
        logging.getLogger("gcd_node").critical("uncaught %s%s", error[0].__name__, where, exc_info=error)
