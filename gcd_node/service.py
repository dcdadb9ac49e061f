"""How the process fits into its machine: service manager, watchdog, log lines, and addresses of its HTTP pages."""

import contextlib
import json
import logging
import math
import os
import queue
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
    """Tells systemd how the node does (Type=notify, WatchdogSec). Without a service manager nothing is sent.

    watchdog_s: it restarts the node after so long without `alive`; None if it does not watch this process.
    """

    def __init__(self, environment: Mapping[str, str], clock: Callable[[], float] = time.monotonic) -> None:
        """environment: normally os.environ. clock: monotonic seconds."""
        self._address = environment.get("NOTIFY_SOCKET", "")
        self._clock, self._fed_s, self._complained = clock, -math.inf, False
        period, process = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
        watches = bool(self._address) and period.isdecimal() and process in ("", str(os.getpid()))
        self.watchdog_s = int(period) / 1e6 or None if watches else None

    def ready(self) -> bool:
        """The start is over: call it once views can come. This and the others: whether it was sent."""
        return self._notify("READY=1")

    def alive(self) -> bool:
        """Feed the watchdog: call it often, and only while nothing hangs; it is sent four times in each period."""
        if (
            self.watchdog_s is None
            or self._clock() - self._fed_s < self.watchdog_s / 4
            or not self._notify("WATCHDOG=1")
        ):
            return False
        self._fed_s = self._clock()
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
            if not self._complained:
                _LOG.warning("cannot reach the service manager at %s: %s; going on without it", self._address, error)
            self._complained = True
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
        self._report, self._health, self._hang_s, self._service = report, health, hang_s, service
        self._clock = ClockWatch()
        self._watched: list[Callable[[], list[str]]] = []
        self._hung = self._was_ready = False
        self._dead: list[str] = []

    def watch(self, dead_threads: Callable[[], list[str]]) -> None:
        """Ask this for the names of threads that have died, from now on."""
        self._watched.append(dead_threads)

    def check(self, silent_s: float) -> None:
        """Call it often. silent_s: how long the model has been at one step."""
        self._check_model(silent_s)
        self._check_threads()
        step_ms = self._clock.step_ms()
        if step_ms is not None:
            self._report("CLOCK_STEP", Level.WARN, {"clock": "utc", "step_ms": round(step_ms)})
        if self._service is not None and not self._hung and not self._dead:
            self._service.alive()

    def loading(self) -> None:
        """The model is about to be loaded, which may take long."""
        if self._service is not None:
            self._service.extend_start(_LOADING_S)

    def ready(self) -> None:
        """The start is over: views come, or the node waits for something that is not its to bring about."""
        if self._service is not None and not self._was_ready:
            self._service.ready()
        self._was_ready = True

    def stopping(self) -> None:
        """The end has begun."""
        if self._service is not None:
            self._service.stopping()

    def _check_model(self, silent_s: float) -> None:
        hung = silent_s > self._hang_s
        if hung and not self._hung:
            self._health.raise_reason("MODEL_HUNG", Level.ERROR)
            self._report("MODEL_HUNG", Level.ERROR, {"silent_s": round(silent_s, 1)})
        elif self._hung and not hung:
            self._health.clear_reason("MODEL_HUNG")
        self._hung = hung

    def _check_threads(self) -> None:
        dead = [name for names in self._watched for name in names()]
        for name in dead:
            if name not in self._dead:
                self._report(THREAD_DIED, Level.ERROR, {"thread": name, "message": "restart the node"})
                self._health.raise_reason(THREAD_DIED, Level.ERROR)
        self._dead = dead


class ClockWatch:
    """Notices when somebody sets this machine's clock (wire protocol, section 7, F24). Ages are not affected."""

    def __init__(
        self, utc_ns: Callable[[], int] | None = None, monotonic_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._utc_ns, self._monotonic_ns = utc_ns or (lambda: time.time_ns()), monotonic_ns
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


def loopback_address(address: str, setting: str) -> tuple[str, int]:
    """Host, without brackets, and port of an HTTP page on this machine. setting: its name, for errors.

    Raises:
        ConfigError: it has no port, or other machines could reach it.
    """
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port[:6]) > 65535:
        raise ConfigError(f'{setting} must be "127.0.0.1:PORT", got {address[:80]!r}')
    if not is_loopback(f"tcp://{address}"):
        raise ConfigError(
            f'{setting} = "{address}" can be reached from other machines, and nothing there asks who calls: use '
            f"127.0.0.1:{port}, and a proxy on this machine or a tunnel (ssh -L {port}:127.0.0.1:{port} ROBOT)"
        )
    return host.strip("[]"), int(port)


def listen(address: str, setting: str) -> socket.socket:
    """A listening socket for an HTTP page on this machine.

    Raises:
        ConfigError: see loopback_address(). EndpointError: the port is in use or cannot be bound.
    """
    host, port = loopback_address(address, setting)
    try:
        return socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
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
    written as text. Long texts are cut, and nothing a record holds makes this fail.
    """

    def format(self, record: logging.LogRecord) -> str:
        """The line, without a line break."""
        extra = {key: _plain(value) for key, value in vars(record).items() if key not in _STANDARD}
        line = extra | {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="microseconds")[:-6] + "Z",
            "level": record.levelname,
            "logger": record.name,
            "message": _cut(_message(record)),
            "thread": record.threadName,
            "pid": record.process,
        }
        if record.exc_info and record.exc_info[0] is not None:
            line["exception"] = _cut("".join(traceback.format_exception(*record.exc_info)).rstrip())
        return json.dumps(line, allow_nan=False)


def _log_uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    logging.getLogger("gcd_node").critical("uncaught %s", kind.__name__, exc_info=(kind, error, trace))


def _log_uncaught_in_thread(args: threading.ExceptHookArgs) -> None:
    if args.exc_value is not None and not isinstance(args.exc_value, SystemExit):
        name = "?" if args.thread is None else args.thread.name
        exc_info = (args.exc_type, args.exc_value, args.exc_traceback)
        logging.getLogger("gcd_node").critical("uncaught %s in %s", args.exc_type.__name__, name, exc_info=exc_info)


def _message(record: logging.LogRecord) -> str:
    try:
        return record.getMessage()
    except Exception:  # whatever an argument does when it is written: better this than no line
        return f"{_text(record.msg)} {_text(record.args)}"


def _plain(value: object) -> Any:
    if value is None or isinstance(value, bool) or (isinstance(value, float) and math.isfinite(value)):
        return value
    if isinstance(value, int) and abs(value) <= _LARGEST_INTEGER:
        return value
    return _cut(_text(value))


def _text(value: object) -> str:
    try:
        return str(value)
    except Exception:  # a foreign object's own method
        return f"<{type(value).__name__} that cannot be written>"


def _cut(text: str) -> str:
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."
