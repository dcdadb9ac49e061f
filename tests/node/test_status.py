"""What the node tells of itself, beside what test_node_life and test_health see on the sockets."""

import logging

import pytest
from fakes import Box

from gcd_node.health import Health, Level
from gcd_node.status import Announcer


class Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_warnings_are_logged_with_their_fields_and_good_news_is_not(caplog: pytest.LogCaptureFixture) -> None:
    outbox = Box()
    announcer = Announcer("gcd", "0" * 32, outbox, Health())
    announcer.event("NOT_READY", Level.ERROR, {"verb": "activate", "message": "no camera"})
    announcer.event("STATE", Level.OK, {"state": "active"})
    (record,) = caplog.records
    assert (record.levelno, record.getMessage()) == (logging.ERROR, "NOT_READY no camera (verb: activate)")
    assert vars(record)["event"]["verb"] == "activate"
    assert [fields["code"] for _, fields in outbox.notes] == ["NOT_READY", "STATE"]


def test_a_code_that_comes_all_the_time_is_published_each_time_and_logged_now_and_then(
    caplog: pytest.LogCaptureFixture,
) -> None:
    outbox, clock = Box(), Clock()
    announcer = Announcer("gcd", "0" * 32, outbox, Health(), clock)
    for count in range(25):
        announcer.event("WIN_GAP", Level.WARN, {"count": count})
        announcer.event("MODEL_NAN", Level.ERROR, {"window_id": count})
        clock.now_s += 1.0
    assert [record.getMessage() for record in caplog.records if "WIN_GAP" in record.message] == [
        f"WIN_GAP (count: {count})" for count in (0, 10, 20)
    ]
    assert len(outbox.notes) == 50
