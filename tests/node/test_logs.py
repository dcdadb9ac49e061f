"""JSON log lines: one object a line whatever is logged, and nothing that breaks the lines."""

import io
import json
import logging
import subprocess
import sys
import threading
import warnings
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

import pytest

from gcd_node.health.logs import JsonLines, log_json_lines


@pytest.fixture
def stream() -> io.StringIO:
    return io.StringIO()


@pytest.fixture
def log(stream: io.StringIO) -> Iterator[logging.Logger]:
    """A logger of its own that writes JSON lines to `stream`."""
    logger = logging.Logger("gcd_node.test", level=logging.DEBUG)
    handler = logging.StreamHandler(stream)
    handler.setFormatter(JsonLines())
    logger.addHandler(handler)
    yield logger
    handler.close()


def lines(stream: io.StringIO) -> list[dict[str, Any]]:
    return [json.loads(line, parse_constant=_refuse) for line in stream.getvalue().splitlines()]


def _refuse(name: str) -> None:
    raise AssertionError(f"{name} is not JSON")


def test_a_line_says_when_where_and_what(log: logging.Logger, stream: io.StringIO) -> None:
    before = datetime.now(UTC)
    log.warning("window %d took %.1f s", 7, 2.5)
    (line,) = lines(stream)
    assert before <= datetime.fromisoformat(line.pop("time")) <= datetime.now(UTC)
    assert isinstance(line.pop("pid"), int)
    assert line == {
        "level": "WARNING",
        "logger": "gcd_node.test",
        "message": "window 7 took 2.5 s",
        "thread": threading.current_thread().name,
    }


def test_extra_fields_keep_their_names_and_types(log: logging.Logger, stream: io.StringIO) -> None:
    log.info("event", extra={"code": "SRC_LOST", "count": 3, "share": 0.5, "seen": True, "view": None})
    (line,) = lines(stream)
    assert {key: line[key] for key in ("code", "count", "share", "seen", "view")} == {
        "code": "SRC_LOST",
        "count": 3,
        "share": 0.5,
        "seen": True,
        "view": None,
    }


def test_an_extra_field_cannot_forge_what_is_always_there(log: logging.Logger, stream: io.StringIO) -> None:
    log.info("true", extra={"time": "never", "level": "NONE", "logger": "other"})
    (line,) = lines(stream)
    assert (line["level"], line["logger"], line["message"]) == ("INFO", "gcd_node.test", "true")
    assert line["time"] != "never"


@pytest.mark.parametrize(
    "message",
    ['two\nlines\r\n{"level": "INFO"}', "tab\t\x00\x1b[31m", "\ud800 alone", "né 東京 \u2028 \u2029", "", "%s %d"],
)
def test_whatever_is_logged_is_one_line(log: logging.Logger, stream: io.StringIO, message: str) -> None:
    log.error(message)
    (line,) = lines(stream)
    assert line["message"] == message


@pytest.mark.parametrize("value", [float("nan"), float("inf"), b"\xff", {1: {2}}, object, [1, (2,)], 2**53])
def test_what_json_cannot_hold_becomes_text(log: logging.Logger, stream: io.StringIO, value: object) -> None:
    log.info("x", extra={"value": value})
    (line,) = lines(stream)
    assert line["value"] == str(value)


def test_arguments_that_do_not_fit_still_make_a_line(log: logging.Logger, stream: io.StringIO) -> None:
    log.info("%d of %d", "three")
    (line,) = lines(stream)
    assert line["message"] == "%d of %d ('three',)"


class Unwritable:
    """Fails whenever it is to become text."""

    def __str__(self) -> str:
        raise RuntimeError("no")

    __repr__ = __str__


def test_an_object_that_cannot_be_written_still_makes_a_line(log: logging.Logger, stream: io.StringIO) -> None:
    log.info("window %s", Unwritable(), extra={"value": Unwritable(), "huge": 10**5000})
    (line,) = lines(stream)
    assert line["message"] == "window %s <tuple that cannot be written>"
    assert line["value"] == "<Unwritable that cannot be written>"
    assert line["huge"] == "<int that cannot be written>"


def test_long_messages_are_cut(log: logging.Logger, stream: io.StringIO) -> None:
    log.info("x" * 1_000_000)
    (line,) = lines(stream)
    assert len(line["message"]) == 16_000
    assert line["message"].endswith("x...")


def test_an_error_brings_its_traceback_within_the_line(log: logging.Logger, stream: io.StringIO) -> None:
    try:
        raise ValueError("bad\nnews")
    except ValueError:
        log.exception("failed")
    (line,) = lines(stream)
    assert line["exception"].startswith("Traceback")
    assert line["exception"].endswith("ValueError: bad\nnews")


def test_the_whole_process_switches_to_json_lines() -> None:
    """In a process of its own: warnings, errors of threads and the last error of all are lines too."""
    code = """
import logging, sys, threading, warnings
from gcd_node.health.logs import log_json_lines
logging.basicConfig(level="INFO", format="%(message)s", stream=sys.stderr)
log_json_lines()
logging.getLogger("gcd_node.x").info("hello")
warnings.warn("careful")
thread = threading.Thread(target=lambda: 1 / 0, name="model")
thread.start(); thread.join()
raise RuntimeError("the end")
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=50, check=False)
    told = [json.loads(line) for line in ended.stderr.splitlines()]
    assert ended.returncode == 1
    assert [line["level"] for line in told] == ["INFO", "WARNING", "CRITICAL", "CRITICAL"]
    assert [line["logger"] for line in told] == ["gcd_node.x", "py.warnings", "gcd_node", "gcd_node"]
    assert told[2]["message"] == "uncaught ZeroDivisionError in model"
    assert "RuntimeError: the end" in told[3]["exception"]


def test_switching_reaches_every_handler_of_the_root(monkeypatch: pytest.MonkeyPatch) -> None:
    root = logging.getLogger()
    handlers = [logging.StreamHandler(io.StringIO()) for _ in range(2)]
    monkeypatch.setattr(root, "handlers", handlers)
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    monkeypatch.setattr(threading, "excepthook", threading.excepthook)
    try:
        with warnings.catch_warnings():
            log_json_lines()
            assert [type(handler.formatter) for handler in handlers] == [JsonLines, JsonLines]
    finally:
        logging.captureWarnings(False)
