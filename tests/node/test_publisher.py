"""The publisher, read by a real second process over ipc and tcp, and by plain ZeroMQ sockets."""

import socket
import stat
import threading
import time
import zlib
from functools import partial
from pathlib import Path

import pytest
import zmq
from cameras import until
from wire_messages import end, lines_of, origin, pixels, start_reader, window
from zmtp import GREETING, message, ready

from gcd_client.protocol import EndMessage, StatusMessage, decode, topic_key
from gcd_client.subscriber import StatusSubscriber, ViewSubscriber
from gcd_node.config import PublishConfig
from gcd_node.errors import ConfigError, EndpointError, NodeError
from gcd_node.publisher import Publisher

pytestmark = pytest.mark.timeout(60)


def opened(folder: Path, *, readers: int = 0, data: str = "", status: str = "", **more) -> Publisher:
    data, status = data or f"ipc://{folder}/data", status or f"ipc://{folder}/status"
    config = PublishConfig(data=data, status=status, min_subscribers=readers, end_delay_ms=200)
    return Publisher(config, **{"drain_ms": 3000, **more})


def plain_reader(context: zmq.Context, endpoint: str, *topics: bytes) -> zmq.Socket:
    reader = context.socket(zmq.SUB)
    reader.set(zmq.LINGER, 0)
    for topic in topics:
        reader.set(zmq.SUBSCRIBE, topic)
    reader.connect(endpoint)
    return reader


@pytest.fixture
def context():
    with zmq.Context() as made:
        yield made
        made.destroy(linger=0)


# A second process


@pytest.mark.parametrize("transport", ["ipc", "tcp"])
def test_a_second_process_receives_every_window_bit_for_bit(tmp_path, transport) -> None:
    data = f"ipc://{tmp_path}/data" if transport == "ipc" else "tcp://127.0.0.1:0"
    with opened(tmp_path, data=data, readers=1, lockstep=True) as publisher:
        reader = start_reader(publisher.endpoint, "top", "--all")
        for i in range(5):
            assert publisher.send(window(i))
        publisher.end(end(window_id=4), delay_ms=0)
    expected = [f"{i} {i} 0 False {zlib.crc32(pixels(i))}" for i in range(5)]
    assert lines_of(reader) == [*expected, "end"]


@pytest.mark.parametrize("transport", ["ipc", "tcp"])
def test_only_what_leaves_the_machine_s_memory_carries_a_checksum(tmp_path, context, transport) -> None:
    data = f"ipc://{tmp_path}/data" if transport == "ipc" else "tcp://127.0.0.1:0"
    with opened(tmp_path, data=data) as publisher:
        views = plain_reader(context, publisher.endpoint, topic_key("view/top/win"))
        notes = plain_reader(context, publisher.status_endpoint, topic_key("status"))
        until(lambda: publisher.stats.subscribers == 1)
        publisher.send(window())
        publisher.note("status", origin(), {"state": "active"})
        parts = [each.recv() for each in (views, notes) if each.poll(10_000)]
    found = [int.from_bytes(part[56:60], "little") for part in parts]
    assert found == [0 if transport == "ipc" else zlib.crc32(parts[0][64:]), zlib.crc32(parts[1][64:])]


def test_lockstep_never_skips_for_a_slow_reader(tmp_path) -> None:
    big = pixels(1, frames=14, height=128, width=192)  # 1 MB: more than the kernel's buffers hold
    with opened(tmp_path, lockstep=True, readers=1) as publisher:
        reader = start_reader(publisher.endpoint, "top", "--all", "--slow", "0.05")
        for i in range(30):
            publisher.send(window(i, images=big))
        publisher.end(end(window_id=29))
    rows = [line.split()[:3] for line in lines_of(reader)]
    assert rows == [[str(i), str(i), "0"] for i in range(30)] + [["end"]]


def test_a_conflated_slow_reader_gets_the_newest_window_and_then_the_end(tmp_path) -> None:
    with opened(tmp_path) as publisher:
        reader = start_reader(publisher.endpoint, "top", "--slow", "0.15")
        until(lambda: publisher.stats.subscribers == 1)
        for i in range(40):
            publisher.send(window(i))
            time.sleep(0.01)
        publisher.end(end(window_id=39), delay_ms=400)
    seen = [int(line.split()[0]) for line in lines_of(reader)[:-1]]
    assert seen[-1] == 39
    assert seen == sorted(set(seen))
    assert len(seen) < 30


# Sockets as the protocol has them


def test_a_new_subscriber_is_welcomed_with_zeros(tmp_path, context) -> None:
    with opened(tmp_path) as publisher:
        reader = plain_reader(context, publisher.endpoint, bytes(32))
        assert reader.poll(5000)
        assert reader.recv() == bytes(64)
        assert publisher.stats.subscribers == 0  # who waits for the welcome alone wants no views


def test_sequences_count_each_topic_on_its_own(tmp_path, context) -> None:
    with opened(tmp_path, lockstep=True, readers=1) as publisher:
        reader = plain_reader(context, publisher.endpoint, b"view/")
        for view_id in ("a", "b", "a", "a", "b"):
            publisher.send(window(view_id=view_id))
        publisher.end(end(view_id="a"))
        found = [decode(reader.recv()) for _ in range(6)]
        reader.close()
    assert [message.sequence for message in found] == [0, 0, 1, 2, 1, 3]


def test_the_end_follows_the_last_window_by_its_delay(tmp_path, context) -> None:
    with opened(tmp_path, lockstep=True, readers=1) as publisher:
        reader = plain_reader(context, publisher.endpoint, b"view/")
        publisher.send(window())
        publisher.end(end(), delay_ms=300)
        reader.recv()
        start = time.monotonic()
        reader.recv()
        assert time.monotonic() - start > 0.25
        reader.close()


@pytest.mark.parametrize("topic", ["status", "meta"])
def test_who_comes_late_gets_the_last_note_of_a_topic(tmp_path, topic) -> None:
    with opened(tmp_path) as publisher:
        for level in range(3):
            publisher.note(topic, origin(), {"level": level})
        with StatusSubscriber(publisher.status_endpoint, (topic,)) as first:
            note = until_level(first, 2)
            assert note.sequence == 2
            with StatusSubscriber(publisher.status_endpoint, (topic,)) as second:
                assert until_level(second, 2).sequence == 2
            assert first.receive(50) is None  # the repeat for the second is no news to the first
            publisher.note(topic, origin(), {"level": 3})
            assert until_level(first, 3).sequence == 3


def until_level(notes: StatusSubscriber, level: int) -> StatusMessage:
    while (note := notes.receive(5000)) is not None:
        if note.fields["level"] == level:
            return note
    raise AssertionError(f"no note of level {level} came")


# Hand-over


def test_lockstep_that_no_reader_takes_is_an_error_at_the_end(tmp_path) -> None:
    publisher = opened(tmp_path, readers=1, lockstep=True, drain_ms=100)
    publisher.send(window())
    publisher.send(window())
    with pytest.raises(EndpointError):
        publisher.close()


def test_a_slow_reader_cannot_stretch_the_end_of_a_node_that_was_told_to_stop(tmp_path, monkeypatch) -> None:
    publisher, tries = opened(tmp_path, lockstep=True, queue_size=64, linger_ms=300), []

    def room_now_and_then(*parcel: object) -> bool:
        time.sleep(0.05)
        tries.append(parcel)
        return len(tries) % 2 == 0

    monkeypatch.setattr(publisher, "_send", room_now_and_then)
    for _ in range(60):
        publisher.send(window())
    publisher.stop_waiting()
    publisher.close()
    assert len(tries) < 60  # all 60 messages would take two tries each


def test_a_full_queue_loses_no_end_of_a_node_that_was_told_to_stop(tmp_path, monkeypatch) -> None:
    publisher = opened(tmp_path, queue_size=1)
    ready, left = threading.Event(), []
    monkeypatch.setattr(publisher, "_send", lambda _, follow_s: ready.is_set() and not left.append(follow_s))
    publisher.send(window())
    publisher.stop_waiting()
    for view_id in ("left", "right", "top"):
        publisher.end(end(view_id=view_id))
    ready.set()
    publisher.close()
    assert [follow_s is not None for follow_s in left] == [False, True, True, True]


def test_a_reader_that_was_busy_at_the_end_is_told_of_every_end(tmp_path, context) -> None:
    views = [f"view{i}" for i in range(12)]
    with opened(tmp_path) as publisher:
        reader = plain_reader(context, publisher.endpoint, b"view/")
        reader.set(zmq.RCVHWM, 1)
        until(lambda: publisher.stats.subscribers == 1)
        for i in range(300):  # more than the buffers on the way hold
            publisher.send(window(i))
        for view_id in views:
            publisher.end(end(view_id=view_id), delay_ms=0)
        closing = threading.Thread(target=publisher.close)
        closing.start()
        time.sleep(0.2)
        parts = []
        while reader.poll(500):
            parts.append(reader.recv())
        closing.join()
    ends = [message for part in parts if isinstance(message := decode(part), EndMessage)]
    assert {message.header.view_id for message in ends} == set(views)


def test_what_stops_the_thread_reaches_the_caller(tmp_path, monkeypatch) -> None:
    publisher = opened(tmp_path)
    monkeypatch.setattr(publisher, "_serve_sockets", lambda: 1 / 0)
    publisher.guard.wake()
    publisher._thread.join(5)
    for call in (publisher.check, lambda: publisher.send(window()), publisher.close):
        with pytest.raises(NodeError):
            call()


# Endpoints


def test_a_live_ipc_endpoint_is_refused_and_stays_alive_and_the_file_of_a_dead_process_is_replaced(tmp_path) -> None:
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(f"{tmp_path}/data")
    with opened(tmp_path, lockstep=True, readers=1) as first:
        with pytest.raises(EndpointError):
            opened(tmp_path)
        with ViewSubscriber(first.endpoint, "top", conflate=False) as views:
            first.send(window())
            assert views.receive(5000) is not None


@pytest.mark.parametrize("endpoint", ["tcp://0.0.0.0:5580", "tcp://*:5580", "tcp://192.168.1.4:1", "tcp://robot:1"])
def test_tcp_beyond_this_machine_is_refused(tmp_path, endpoint) -> None:
    with pytest.raises(ConfigError) as caught:
        opened(tmp_path, data=endpoint)
    assert caught.value.exit_code == 78


def test_the_runtime_folder_is_private_and_shared_by_both_sides(tmp_path, monkeypatch) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with Publisher(PublishConfig(min_subscribers=1), lockstep=True) as publisher:
        assert stat.S_IMODE((tmp_path / "gcd").stat().st_mode) == 0o700
        assert publisher.status_endpoint == f"ipc://{tmp_path}/gcd/status"
        with ViewSubscriber("ipc", "top", conflate=False) as views:
            publisher.send(window(7))
            assert views.receive(5000).header.window_id == 7


def test_a_runtime_folder_anyone_may_write_is_refused(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "open"))
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    with pytest.raises(EndpointError):
        Publisher(PublishConfig())


def test_a_close_that_waits_for_readers_can_be_cut_short(tmp_path) -> None:
    publisher = opened(tmp_path, lockstep=True, readers=1)
    publisher.send(window())
    closing = threading.Thread(target=publisher.close, daemon=True)
    closing.start()
    closing.join(0.1)
    assert closing.is_alive()
    publisher.close(orderly=False)
    closing.join(1)
    assert not closing.is_alive()


def test_many_topics_are_counted_by_what_they_let_through(tmp_path: Path) -> None:
    config = PublishConfig(data=f"ipc://{tmp_path}/data", status=f"ipc://{tmp_path}/status")
    with Publisher(config, linger_ms=0) as publisher, zmq.Context() as context, context.socket(zmq.SUB) as reader:
        reader.linger = 0
        reader.set_hwm(0)  # of what it asks for, too
        reader.connect(publisher.endpoint)
        for topic in (b"", b"src/", topic_key("src/frm"), b"view/", topic_key("view/a/win")):
            reader.subscribe(topic)
        until(lambda: publisher.stats.subscribers == 5)
        assert (publisher.stats.watchers, publisher.stats.previews) == (3, 3)
        begun_s = time.monotonic()
        for number in range(5_000):
            reader.subscribe(b"view/%d" % number)
        until(lambda: publisher.stats.subscribers == 5_005)
        assert time.monotonic() - begun_s < 20  # quadratic, it took minutes
        reader.unsubscribe(b"")
        until(lambda: publisher.stats.previews == 2)


def test_who_takes_back_what_nobody_asked_for_makes_no_reader_disappear(tmp_path: Path) -> None:
    opened = partial(
        Publisher, PublishConfig(data=f"ipc://{tmp_path}/data", status=f"ipc://{tmp_path}/status"), linger_ms=0
    )
    with opened() as publisher, ViewSubscriber(publisher.endpoint, "top"):
        until(lambda: publisher.stats.subscribers == 1)
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
            link.connect(f"{tmp_path}/data")
            link.sendall(GREETING)
            link.recv(len(GREETING), socket.MSG_WAITALL)
            link.sendall(ready("SUB"))
            link.sendall(3 * message(b"\0never") + message(b"\1once") + message(b"\1then"))
            until(lambda: publisher.stats.subscribers == 3)
        until(lambda: publisher.stats.subscribers == 1)
