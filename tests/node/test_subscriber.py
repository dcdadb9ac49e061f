"""The subscriber: what it checks, what it leaves out, and that a planner can import it with next to nothing."""

import gc
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import zmq
from wire_messages import CLASSES, OTHER_BOOT, class_map, end, lines_of, numbers, pixels, start_reader, window

import gcd_node
from gcd_node.envelope import encode
from gcd_node.errors import ConfigError, MessageError, StaleError
from gcd_node.publisher import Publisher, PublisherOptions
from gcd_node.subscriber import ViewSubscriber

pytestmark = pytest.mark.timeout(30)


class Sender:
    """Publishes whatever bytes it is told to."""

    def __init__(self, endpoint: str) -> None:
        self.endpoint = endpoint
        self.context = zmq.Context()
        self.socket = self.context.socket(zmq.XPUB)
        self.socket.bind(endpoint)

    def wait(self) -> None:
        assert self.socket.poll(5000)
        assert self.socket.recv()[:1] == b"\1"

    def send(self, *parts: bytes) -> None:
        for part in parts:
            self.socket.send(part)

    def numbered(self, sequence: int, message) -> bytes:
        part = bytearray(encode(message))
        part[48:56] = sequence.to_bytes(8, "little")
        return bytes(part)


@pytest.fixture
def sender(tmp_path):
    made = Sender(f"ipc://{tmp_path}/data")
    yield made
    made.context.destroy(linger=0)


@pytest.fixture
def views(sender):
    with ViewSubscriber(sender.endpoint, "top", conflate=False) as made:
        sender.wait()
        yield made


def lockstep(tmp_path: Path) -> PublisherOptions:
    return PublisherOptions(
        data=f"ipc://{tmp_path}/data", status=None, lockstep=True, min_subscribers=1, end_delay_ms=0
    )


def test_a_view_arrives_with_its_pixels_age_and_header(tmp_path) -> None:
    message = window(4, age_ms=250.0)
    with Publisher(lockstep(tmp_path)) as publisher, ViewSubscriber(publisher.endpoint, "top") as views:
        publisher.send(message)
        view = views.receive(5000)
    assert view.header == message.header
    assert np.array_equal(view.images, pixels(4))
    assert not view.images.flags.writeable
    assert view.age_ms >= 250.0
    assert not view.expired
    assert not view.restarted


def test_a_planner_needs_only_numpy_and_zeromq(tmp_path) -> None:
    # reader_process.py refuses torch, cv2, kornia, msgspec, rich and typer to whoever imports them
    with Publisher(lockstep(tmp_path)) as publisher:
        reader = start_reader(publisher.endpoint, "top", "--all")
        publisher.send(window())
        publisher.end(end())
    assert len(lines_of(reader)) == 2


def test_importing_the_subscriber_loads_nothing_heavy() -> None:
    code = "import sys, gcd_node.subscriber; print(sorted({n.partition('.')[0] for n in sys.modules}))"
    root = str(Path(gcd_node.__file__).parent.parent)
    out = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True, timeout=20)
    assert "'zmq'" in out.stdout
    assert not {"torch", "cv2", "kornia", "msgspec", "rich", "typer"} & set(eval(out.stdout))


def test_silence_gives_none_in_time(tmp_path) -> None:
    with ViewSubscriber(f"ipc://{tmp_path}/nobody", "top") as views:
        assert views.receive(30) is None
        assert not views.ended


def test_an_old_view_is_stale_and_the_next_call_goes_on(sender) -> None:
    with ViewSubscriber(sender.endpoint, "top", conflate=False, max_age_ms=1000) as views:
        sender.wait()
        sender.send(sender.numbered(0, window(0, age_ms=1500.0)), sender.numbered(1, window(1)))
        with pytest.raises(StaleError, match=r"window 0 is 15.. ms old, wanted at most 1000"):
            views.receive(5000)
        assert views.receive(5000).header.window_id == 1
        assert views.stats.stale == 1


def test_iteration_leaves_stale_views_out(sender) -> None:
    with ViewSubscriber(sender.endpoint, "top", conflate=False, max_age_ms=1000) as views:
        sender.wait()
        for i in range(4):
            sender.send(sender.numbered(i, window(i, age_ms=5000.0 if i % 2 else 1.0)))
        sender.send(sender.numbered(4, end()))
        assert [view.header.window_id for view in views] == [0, 2]
        assert views.stats.stale == 2


def test_a_view_past_its_validity_is_marked(sender, views, monkeypatch) -> None:
    message = window()
    monkeypatch.setattr(time, "time_ns", lambda: message.header.t_publish_ns + 60_001 * 10**6)
    sender.send(encode(message))
    view = views.receive(5000)
    assert view.expired
    assert view.age_ms == pytest.approx(40.5 + 60_001)


def test_a_clock_that_runs_behind_makes_no_view_younger(sender, views, monkeypatch) -> None:
    message = window()
    monkeypatch.setattr(time, "time_ns", lambda: message.header.t_publish_ns - 10**9)
    sender.send(encode(message))
    assert views.receive(5000).age_ms == 40.5


def test_an_older_view_revision_is_dropped(sender, views) -> None:
    for sequence, revision in enumerate((1, 2, 1, 2)):
        sender.send(sender.numbered(sequence, window(sequence, view_rev=revision)))
    received = [views.receive(5000) for _ in range(3)]
    assert [view.header.window_id for view in received] == [0, 1, 3]
    assert [view.skipped for view in received] == [0, 0, 0]
    assert views.stats.outdated == 1


def test_gaps_are_counted_and_repeats_dropped(sender, views) -> None:
    for sequence in (7, 8, 8, 12):
        sender.send(sender.numbered(sequence, window(sequence)))
    assert [views.receive(5000).skipped for _ in range(3)] == [0, 0, 3]
    assert (views.stats.skipped, views.stats.outdated, views.stats.received) == (3, 1, 3)


def test_a_restart_is_said_once_and_forgets_sequence_and_revision(sender, views) -> None:
    sender.send(sender.numbered(9, window(9, view_rev=5)))
    sender.send(sender.numbered(0, window(0, boot_id=OTHER_BOOT, view_rev=1)))
    sender.send(sender.numbered(1, window(1, boot_id=OTHER_BOOT, view_rev=1)))
    assert [views.receive(5000).restarted for _ in range(3)] == [False, True, False]
    assert views.stats.restarts == 1


def test_a_restart_hidden_by_a_stale_view_is_still_said(sender) -> None:
    with ViewSubscriber(sender.endpoint, "top", conflate=False, max_age_ms=1000) as views:
        sender.wait()
        sender.send(encode(window()))
        sender.send(sender.numbered(0, window(0, boot_id=OTHER_BOOT, age_ms=9000.0)))
        sender.send(sender.numbered(1, window(1, boot_id=OTHER_BOOT)))
        assert [view.restarted for view in (views.receive(5000),)] == [False]
        with pytest.raises(StaleError):
            views.receive(5000)
        assert views.receive(5000).restarted


def test_damage_raises_and_the_next_call_goes_on(sender, views) -> None:
    damaged = bytearray(encode(window()))
    damaged[-1] ^= 1
    sender.send(bytes(damaged), encode(window()))
    with pytest.raises(MessageError, match="checksum"):
        views.receive(5000)
    assert views.receive(5000).header.window_id == 0


def test_the_welcome_message_is_no_view(sender) -> None:
    with ViewSubscriber(sender.endpoint, "top", conflate=False) as views:
        sender.wait()
        views._link._socket.subscribe(bytes(32))  # as a reader who wants to know when it is connected
        sender.wait()
        sender.send(bytes(64), encode(window(3)))
        assert views.receive(5000).header.window_id == 3


def test_a_payload_over_the_limit_never_arrives(sender) -> None:
    with ViewSubscriber(sender.endpoint, "top", conflate=False, max_payload=100) as views:
        sender.wait()
        sender.send(encode(window()))
        with pytest.raises(MessageError, match="at most 100 bytes"):
            views.receive(5000)  # small enough for the socket's limit, which allows for a long header
        sender.send(encode(window(images=pixels(frames=14, height=64, width=64))))
        assert views.receive(200) is None


def test_a_stream_ends_and_may_begin_again(sender, views) -> None:
    sender.send(sender.numbered(0, window(0)), sender.numbered(1, end()))
    assert [view.header.window_id for view in views] == [0]
    assert views.ended
    sender.send(sender.numbered(2, window(1)), sender.numbered(3, end()))
    assert [view.header.window_id for view in views] == [1]


def test_all_views_end_when_the_last_one_does(sender) -> None:
    with ViewSubscriber(sender.endpoint, conflate=False) as views:
        sender.wait()
        sender.send(encode(window(0, view_id="a")), encode(window(0, view_id="b")))
        sender.send(sender.numbered(1, end(view_id="a")), sender.numbered(1, window(1, view_id="b")))
        sender.send(encode(window(0, view_id="b", kind="frm")), sender.numbered(2, end(view_id="b")))
        found = [(view.header.view_id, view.header.window_id) for view in views]
    assert found == [("a", 0), ("b", 0), ("b", 1)]


@pytest.mark.parametrize(("view", "kind"), [(None, "win"), ("top", None), (None, None)])
def test_all_views_or_kinds_cannot_be_conflated(view, kind) -> None:
    with pytest.raises(ConfigError, match="name a view and a kind"):
        ViewSubscriber("tcp://127.0.0.1:1", view, kind, conflate=True)


def test_a_class_map_arrives_with_its_ontology_and_ends_on_its_own(tmp_path) -> None:
    with Publisher(lockstep(tmp_path)) as publisher, ViewSubscriber(publisher.endpoint, "top", "cls") as views:
        publisher.send(window(3))
        publisher.send(class_map(3))
        view = views.receive(5000)
        publisher.end(end(kind="win"))
        publisher.end(end(kind="cls", window_id=3))
        assert views.receive(5000) is None
        assert views.ended
    assert view.header.encoding == "class8"
    assert view.header.classes == CLASSES
    assert np.array_equal(view.images[..., 0], numbers(3))
    assert not view.images.flags.writeable
    assert [tuple(pixel) for pixel in view.colours[0, 0].tolist()] == [
        next(each.colour for each in CLASSES if each.id == number) for number in numbers(3)[0, 0]
    ]


def test_all_kinds_of_one_view_leave_other_views_out(sender) -> None:
    with ViewSubscriber(sender.endpoint, "top", None, conflate=False) as views:
        sender.wait()
        sender.send(encode(window(0, view_id="topdown")), encode(window(1)), encode(class_map(1)))
        sender.send(sender.numbered(1, end()), sender.numbered(1, end(kind="cls")))
        found = [(view.message.topic, view.header.window_id) for view in views]
    assert found == [("view/top/win", 1), ("view/top/cls", 1)]


@pytest.mark.parametrize("endpoint", ["", "here", "http://127.0.0.1:80"])
def test_what_is_no_endpoint_is_refused(endpoint) -> None:
    with pytest.raises(ConfigError, match="an endpoint is"):
        ViewSubscriber(endpoint, "top")


def test_a_conflated_reader_finds_the_newest_of_many(sender) -> None:
    with ViewSubscriber(sender.endpoint, "top") as views:
        sender.wait()
        for i in range(50):
            sender.send(sender.numbered(i, window(i)))
        time.sleep(0.2)
        view = views.receive(5000)
        assert view.header.window_id == 49
        assert views.receive(20) is None


def test_pixels_outlive_what_comes_later_and_the_subscriber(sender) -> None:
    big = pixels(1, frames=14, height=64, width=96)  # large enough that ZeroMQ's own memory is looked at
    with ViewSubscriber(sender.endpoint, "top", conflate=False) as views:
        sender.wait()
        for i in range(4):
            sender.send(sender.numbered(i, window(i, images=big + np.uint8(i))))
        kept = [views.receive(5000).images for _ in range(4)]
    gc.collect()
    assert [(each == big + np.uint8(i)).all() for i, each in enumerate(kept)] == [True] * 4
    with pytest.raises(ValueError, match="read-only"):
        kept[0][:] = 0
