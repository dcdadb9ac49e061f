"""How the process fits into its machine: service manager, watchdog, addresses of its HTTP pages, log lines."""

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
import traceback
from collections.abc import Callable, Generator, Mapping
from datetime import UTC, datetime
from logging.handlers import QueueHandler, QueueListener
from types import TracebackType
from typing import Any

from gcd_node.auth import is_loopback
from gcd_node.errors import ConfigError, EndpointError
from gcd_node.health import THREAD_DIED, Health, Level

_LOG = logging.getLogger(__name__)
_SEND_TIMEOUT_S = 0.5
_LOADING_S = 300.0
_CLOCK_STEP_NS = 100_000_000
_WAITING_LINES = 1000
_LAST_LINES_S = 1.0
_LONGEST = 16_000
_LARGEST_INTEGER = 2**53 - 1  # readers that hold numbers as doubles lose digits beyond
_STANDARD = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}


class ServiceManager:
    """Tells systemd how the node does (Type=notify, WatchdogSec). Without a service manager nothing is sent. Each
    method says whether something was sent."""

    def __init__(self, environment: Mapping[str, str], clock: Callable[[], float] = time.monotonic) -> None:
        """environment: normally os.environ. clock: monotonic seconds."""
        self._address = environment.get("NOTIFY_SOCKET", "")
        self._clock, self._fed_s, self._failed = clock, -math.inf, False
        period, process = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
        watched = period.isdecimal() and process in ("", str(os.getpid()))
        self._period_s = int(period) / 1e6 if watched else 0.0

    def ready(self) -> bool:
        """The start is over: call it once views can come."""
        return self._notify("READY=1")

    def alive(self) -> bool:
        """Feed the watchdog: call it often, and only while nothing hangs; it is sent four times in each period."""
        now_s = self._clock()
        due = self._period_s > 0 and now_s - self._fed_s >= self._period_s / 4
        if not (due and self._notify("WATCHDOG=1")):
            return False
        self._fed_s = now_s
        return True

    def extend_start(self, seconds: float) -> bool:
        """Loading takes longer: allow so much more from now, for starting and for stopping."""
        return self._notify(f"EXTEND_TIMEOUT_USEC={round(seconds * 1e6)}")

    def stopping(self) -> bool:
        """The end has begun."""
        return self._notify("STOPPING=1")

    def _notify(self, line: str) -> bool:
        """A failure is logged once: the node goes on without."""
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


class Watchdog:
    """Looks after a running node: a model that hangs, a thread that died, a clock that was set. Feeds systemd's.

    Called by the node's life loop alone.
    """

    def __init__(
        self,
        report: Callable[[str, Level, Mapping[str, object]], None],
        health: Health,
        hang_s: float,
        service: ServiceManager | None,
    ) -> None:
        """report: takes an event. hang_s: how long a step of the model may take. service: who started this process."""
        self._report, self._health, self._hang_s = report, health, hang_s
        self._service, self._clock = service or ServiceManager({}), ClockWatch()
        self._watched: list[Callable[[], list[str]]] = []
        self._hung = self._was_ready = False
        self._dead: set[str] = set()

    def watch(self, dead_threads: Callable[[], list[str]]) -> None:
        """Ask this for the names of threads that have died, from now on."""
        self._watched.append(dead_threads)

    def check(self, silent_s: float) -> None:
        """Call it often. silent_s: how long the model has been at one step."""
        was_hung, self._hung = self._hung, silent_s > self._hang_s
        if self._hung and not was_hung:
            self._health.raise_reason("MODEL_HUNG", Level.ERROR)
            self._report("MODEL_HUNG", Level.ERROR, {"silent_s": round(silent_s, 1)})
        elif was_hung and not self._hung:
            self._health.clear_reason("MODEL_HUNG")
        was_dead, self._dead = self._dead, {name for names in self._watched for name in names()}
        for name in self._dead - was_dead:
            self._report(THREAD_DIED, Level.ERROR, {"thread": name, "message": "restart the node"})
            self._health.raise_reason(THREAD_DIED, Level.ERROR)
        if (step_ms := self._clock.step_ms()) is not None:
            self._report("CLOCK_STEP", Level.WARN, {"clock": "utc", "step_ms": round(step_ms)})
        if not self._hung and not self._dead:
            self._service.alive()

    def loading(self) -> None:
        """The model is about to be loaded, which may take long."""
        self._service.extend_start(_LOADING_S)

    def ready(self) -> None:
        """The start is over: views come, or the node waits for something that is not its to bring about."""
        if not self._was_ready:
            self._service.ready()
        self._was_ready = True

    def stopping(self) -> None:
        """The end has begun."""
        self._service.stopping()


class ClockWatch:
    """Notices when somebody sets this machine's clock (docs/node.md, F24). Ages are not affected."""

    def __init__(
        self, utc_ns: Callable[[], int] = lambda: time.time_ns(), monotonic_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._utc_ns, self._monotonic_ns = utc_ns, monotonic_ns
        self._offset_ns: int | None = None
        self.step_ms()

    def step_ms(self) -> float | None:
        """How far UTC was moved since the last look, ms, forwards positive; None if by less than 100: a clock that is
        only slewed never shows here."""
        before_ns, utc_ns, after_ns = self._monotonic_ns(), self._utc_ns(), self._monotonic_ns()
        if after_ns - before_ns > _CLOCK_STEP_NS // 20:
            return None  # interrupted between the two clocks
        last_ns, self._offset_ns = self._offset_ns, utc_ns - before_ns
        if last_ns is None or abs(self._offset_ns - last_ns) < _CLOCK_STEP_NS:
            return None
        return (self._offset_ns - last_ns) / 1e6


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
        sys.excepthook, threading.excepthook = _log_uncaught, _log_uncaught_in_thread
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
    """Leaves records for the thread that writes them; what finds no room is lost."""

    def prepare(self, record: logging.LogRecord) -> logging.LogRecord:
        """Write out the arguments now, before they change; keep the error, for its traceback."""
        record.msg, record.args = _message(record), None
        return record

    def enqueue(self, record: logging.LogRecord) -> None:
        with contextlib.suppress(queue.Full):
            self.queue.put_nowait(record)


class JsonLines(logging.Formatter):
    """A log record as one line of JSON.

    Always there: `time` (UTC, RFC 3339, microseconds), `level`, `logger`, `message`, `thread`, `pid`. `exception`: with
    its traceback, if there is one. What was passed as `extra` comes under its own name; what JSON cannot hold is
    written as text. Long texts are cut.
    """

    def format(self, record: logging.LogRecord) -> str:
        """The line, without a line break."""
        line = {key: _plain(value) for key, value in vars(record).items() if key not in _STANDARD}
        line |= {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="microseconds")[:-6] + "Z",
            "level": record.levelname,
            "logger": record.name,
            "message": _message(record)[:_LONGEST],
            "thread": record.threadName,
            "pid": record.process,
        }
        if record.exc_info and record.exc_info[0] is not None:
            line["exception"] = "".join(traceback.format_exception(*record.exc_info)).rstrip()[-_LONGEST:]
        return json.dumps(line, allow_nan=False)


def _log_uncaught(
    kind: type[BaseException], error: BaseException | None, trace: TracebackType | None, where: str = ""
) -> None:
    if error is not None and not isinstance(error, SystemExit):
        exc_info = (kind, error, trace)
        logging.getLogger("gcd_node").critical("uncaught %s%s", kind.__name__, where, exc_info=exc_info)


def _log_uncaught_in_thread(args: threading.ExceptHookArgs) -> None:
    name = "?" if args.thread is None else args.thread.name
    _log_uncaught(args.exc_type, args.exc_value, args.exc_traceback, f" in {name}")


def _message(record: logging.LogRecord) -> str:
    try:
        return record.getMessage()
    except Exception:  # arguments that do not fit the text: better this than no line
        return f"{record.msg} {record.args}"


def _plain(value: object) -> Any:
    if value is None or isinstance(value, bool) or (isinstance(value, float) and math.isfinite(value)):
        return value
    whole = isinstance(value, int) and abs(value) <= _LARGEST_INTEGER
    try:
        return value if whole else str(value)[:_LONGEST]
    except Exception:  # nothing that a record holds costs its line
        return f"<{type(value).__name__}>"
