"""The publisher, read by a real second process over ipc and tcp, and by plain ZeroMQ sockets."""

import socket
import stat
import threading
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
import zmq
from cameras import until
from fakes import Box, FakeSource, fake_config, traits
from wire_messages import end, lines_of, origin, pixels, start_reader, window

from gcd_client.images import images
from gcd_client.protocol import PREVIEW_TOPIC, EndMessage, StatusMessage, ViewMessage, decode, topic_key
from gcd_client.subscriber import StatusSubscriber, ViewSubscriber
from gcd_node.config import PublishConfig
from gcd_node.errors import ConfigError, EndpointError, NodeError
from gcd_node.frame import Frame
from gcd_node.messages import PREVIEW_WIDTH, PublisherStats, preview_message
from gcd_node.publisher import Publisher
from gcd_node.stream_context import StreamContext, prepare_stream
from gcd_node.views import InputPreview


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


@pytest.mark.parametrize("transport", ["ipc", "tcp"])
def test_only_what_leaves_the_machine_s_memory_carries_a_checksum(tmp_path, context, transport) -> None:
    data = f"ipc://{tmp_path}/data" if transport == "ipc" else "tcp://127.0.0.1:0"
    with opened(tmp_path, data=data) as publisher:
        views = plain_reader(context, publisher.endpoint, topic_key("view/top/win"))
        notes = plain_reader(context, publisher.status_endpoint, topic_key("status"))
        welcomed = plain_reader(context, publisher.endpoint, bytes(32))
        assert welcomed.poll(5000)
        assert welcomed.recv() == bytes(64)  # who wants no views
        until(lambda: publisher.stats.subscribers == 1)
        publisher.send(window())
        publisher.note("status", origin(), {"state": "active"})
        parts = [each.recv() for each in (views, notes) if each.poll(10_000)]
    found = [int.from_bytes(part[56:60], "little") for part in parts]
    assert found == [0 if transport == "ipc" else zlib.crc32(parts[0][64:]), zlib.crc32(parts[1][64:])]


@pytest.mark.parametrize("transport", ["ipc", "tcp"])
def test_lockstep_never_skips_for_a_slow_process(tmp_path, transport) -> None:
    data = "" if transport == "ipc" else "tcp://127.0.0.1:0"
    big = pixels(1, frames=14, height=128, width=192)  # 1 MB: more than the kernel's buffers hold
    with opened(tmp_path, data=data, lockstep=True, readers=1) as publisher:
        reader = start_reader(publisher.endpoint, "top", "--all", "--slow", "0.05")
        for i in range(30):
            publisher.send(window(i, images=big))
        publisher.end(end(window_id=29))
    assert lines_of(reader) == [*(f"{i} {i} 0 False {zlib.crc32(big)}" for i in range(30)), "end"]  # bit for bit


def test_sequences_count_each_topic_on_its_own_and_the_end_follows_by_its_delay(tmp_path, context) -> None:
    with opened(tmp_path, lockstep=True, readers=1) as publisher:
        reader = plain_reader(context, publisher.endpoint, b"view/")
        for view_id in ("a", "b", "a", "a", "b"):
            publisher.send(window(view_id=view_id))
        publisher.end(end(view_id="a"), delay_ms=300)
        found = [decode(reader.recv()) for _ in range(5)]
        start = time.monotonic()
        found.append(decode(reader.recv()))
        assert time.monotonic() - start > 0.25
        reader.close()
    assert [message.sequence for message in found] == [0, 0, 1, 2, 1, 3]


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


def test_f20_a_live_ipc_endpoint_is_refused_and_stays_alive_and_the_file_of_a_dead_process_is_replaced(
    tmp_path,
) -> None:
    for endpoint in ("tcp://0.0.0.0:5580", "tcp://*:5580", "tcp://192.168.1.4:1", "tcp://robot:1"):
        with pytest.raises(ConfigError):  # beyond this machine, without keys
            opened(tmp_path, data=endpoint)
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(f"{tmp_path}/data")
    with opened(tmp_path, lockstep=True, readers=1) as first:
        with pytest.raises(EndpointError) as caught:
            opened(tmp_path)
        assert (caught.value.exit_code, f"{tmp_path}/data" in str(caught.value)) == (73, True)
        with ViewSubscriber(first.endpoint, "top", conflate=False) as views:
            first.send(window())
            assert views.receive(5000) is not None


def test_the_runtime_folder_is_private_and_shared_by_both_sides(tmp_path, monkeypatch) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with Publisher(PublishConfig(min_subscribers=1), lockstep=True) as publisher:
        assert stat.S_IMODE((tmp_path / "gcd").stat().st_mode) == 0o700
        assert publisher.status_endpoint == f"ipc://{tmp_path}/gcd/status"
        with ViewSubscriber("ipc", "top", conflate=False) as views:
            publisher.send(window(7))
            assert views.receive(5000).header.window_id == 7
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "open"))
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    with pytest.raises(EndpointError):
        Publisher(PublishConfig())


def test_a_close_that_waits_for_readers_can_be_cut_short(tmp_path) -> None:
    publisher = opened(tmp_path, readers=1, lockstep=True, drain_ms=100)
    publisher.send(window())
    publisher.send(window())
    with pytest.raises(EndpointError):  # no reader takes them
        publisher.close()
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
    with opened(tmp_path, linger_ms=0) as publisher, zmq.Context() as context, context.socket(zmq.SUB) as reader:
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


def test_who_takes_back_what_nobody_asked_for_makes_no_reader_disappear(tmp_path) -> None:
    greeting = b"\xff" + bytes(8) + b"\x7f" + b"\3\0" + b"NULL".ljust(20, b"\0") + bytes(32)  # ZeroMQ RFC 23, ZMTP 3.0
    ready = b"\x05READY" + b"\x0bSocket-Type" + b"\0\0\0\3SUB"
    asked = (b"\0never", b"\0never", b"\0never", b"\1once", b"\1then")
    with opened(tmp_path, linger_ms=0) as publisher, ViewSubscriber(publisher.endpoint, "top"):
        until(lambda: publisher.stats.subscribers == 1)
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
            link.connect(f"{tmp_path}/data")
            link.sendall(greeting)
            link.recv(len(greeting), socket.MSG_WAITALL)
            link.sendall(bytes([4, len(ready)]) + ready + b"".join(bytes([0, len(each)]) + each for each in asked))
            until(lambda: publisher.stats.subscribers == 3)
        until(lambda: publisher.stats.subscribers == 1)


# The preview of the input on src/frm: who gets it, what it says, and that nobody else pays for it.


def context_of(source: FakeSource, *changes: str) -> StreamContext:
    return prepare_stream(fake_config("source.pace=realtime", *changes), traits(), source.info)


def frame_of(width: int, height: int, seq: int = 7) -> Frame:
    return Frame(image=np.full((height, width, 3), (200, 100, 50), np.uint8), stamp_ns=5_000_000_000, seq=seq)


def preview(width: int, height: int, *changes: str) -> ViewMessage:
    shown = context_of(FakeSource(1, size=(width, height)), *changes)
    return preview_message(shown, frame_of(width, height), time.monotonic_ns(), 3)


def test_a_preview_is_the_whole_picture_and_no_generated_view_and_says_what_frame_it_is() -> None:
    for width, height in ((96, 64), (641, 480), (1920, 1080), (3000, 100)):
        message = preview(width, height)
        _, shown_height, shown_width, _ = message.header.shape
        assert shown_width == min(width, PREVIEW_WIDTH)
        assert shown_height == pytest.approx(shown_width * height / width, abs=0.51)
        assert np.abs(images(message)[0].astype(int) - (200, 100, 50)).max() <= 4  # JPEG
        assert message.header.intrinsics is None
    header = preview(1280, 720, "source.hfov_deg=90.0").header
    assert (header.view_id, header.synthetic, header.encoding, header.window_id) == ("src", False, "jpeg", -1)
    assert header.t_capture_ns == (5_000_000_000,)  # of a recording, its own clock
    assert (header.src.seq, header.src.epoch, header.model.name) == ((7,), 3, "none")
    assert 0 <= header.age_ms < 30_000
    assert header.intrinsics[0] == pytest.approx(320.0)  # half of 640 over tan 45 degrees
    assert (header.intrinsics[2], header.intrinsics[5]) == (319.5, 179.5)


def test_nothing_is_made_while_nobody_looks_and_at_most_five_a_second_then() -> None:
    class Watched(Box):
        previews = 0

        @property
        def stats(self) -> PublisherStats:
            return PublisherStats(subscribers=self.previews, previews=self.previews)

    box, now = Watched(), [0.0]
    shown = InputPreview(box, lambda: context_of(FakeSource(1)), lambda: now[0])
    for seq in range(48 + 240):  # 12 s
        if seq == 48:
            assert box.views == []
            box.previews = 1
        now[0] = seq / 24
        shown.offer(frame_of(96, 64, seq), time.monotonic_ns(), 3)
    shown.announce_end(delay_ms=None)
    seqs = [message.header.src.seq[0] for message in box.views]
    assert 0 < len(seqs) <= 50
    assert seqs == sorted(set(seqs))
    assert [message.topic for message in box.ends] == [PREVIEW_TOPIC]


def test_a_reader_of_previews_that_hangs_does_not_hold_up_a_lockstep_run(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    shown = context_of(FakeSource(1, size=(640, 480)))
    picture = preview_message(shown, Frame(image=noise, stamp_ns=0, seq=0), time.monotonic_ns(), 0)
    with (
        opened(tmp_path, readers=1, lockstep=True) as publisher,
        ViewSubscriber(publisher.endpoint, "src", "frm", conflate=False),
        ViewSubscriber(publisher.endpoint, "top", conflate=False) as views,
    ):
        until(lambda: publisher.stats.subscribers == 2)
        fill(publisher, picture)
        for number in range(20):
            publisher.send(window(number))
        assert [views.receive(60_000).header.window_id for _ in range(20)] == list(range(20))
        publisher.stop_waiting()


def fill(publisher: Publisher, picture: ViewMessage) -> None:
    """Send until nothing leaves any more: every buffer on the way is full."""
    refused = 0
    while refused < 5:
        before, until_s = publisher.stats.sent, time.monotonic() + 0.1
        publisher.preview(lambda: picture)
        while publisher.stats.sent == before and time.monotonic() < until_s:
            time.sleep(0.001)
        refused += publisher.stats.sent == before
