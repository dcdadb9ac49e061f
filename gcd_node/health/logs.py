"""Log lines on stderr: plain text for people, or one JSON object a line for machines."""

import json
import logging
import math
import sys
import threading
import traceback
from datetime import UTC, datetime
from types import TracebackType
from typing import Any

_LONGEST = 16_000
_LARGEST_INTEGER = 2**53 - 1  # readers that hold numbers as doubles lose digits beyond
_STANDARD = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}


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
            "time": _utc(record.created),
            "level": record.levelname,
            "logger": record.name,
            "message": _cut(_message(record)),
            "thread": record.threadName,
            "pid": record.process,
        }
        if record.exc_info and record.exc_info[0] is not None:
            line["exception"] = _cut("".join(traceback.format_exception(*record.exc_info)).rstrip())
        return json.dumps(line, allow_nan=False)


def log_json_lines() -> None:
    """From now on every handler of the root logger writes JSON lines; warnings and uncaught errors of all threads
    are logged too, as else they would break the lines."""
    for handler in logging.getLogger().handlers:
        handler.setFormatter(JsonLines())
    logging.captureWarnings(True)
    sys.excepthook = _log_uncaught
    threading.excepthook = _log_uncaught_in_thread


def _log_uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    logging.getLogger("gcd_node").critical("uncaught %s", kind.__name__, exc_info=(kind, error, trace))


def _log_uncaught_in_thread(args: threading.ExceptHookArgs) -> None:
    error = args.exc_value
    if error is None or isinstance(error, SystemExit):
        return
    name = "?" if args.thread is None else args.thread.name
    exc_info = (args.exc_type, error, args.exc_traceback)
    logging.getLogger("gcd_node").critical("uncaught %s in %s", args.exc_type.__name__, name, exc_info=exc_info)


def _utc(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")


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
