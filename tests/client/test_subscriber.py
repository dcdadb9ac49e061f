"""The subscribers: what they check, leave out and count; blocking, with callbacks, and with asyncio."""

import ast
import asyncio
import gc
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import zmq
from msgspec.structs import replace
from wire_messages import CLASSES, OTHER_BOOT, cells, class_map, end, grid, numbers, origin, pixels, window

import gcd_client
from gcd_client import GridSubscriber, ReceivedView, SetupError, StatusMessage, StatusSubscriber, ViewSubscriber
from gcd_client.protocol import EndMessage, Message, encode, topic_key

pytestmark = pytest.mark.timeout(30)


class Sender:
    """Publishes whatever bytes it gets."""

    def __init__(self, endpoint: str) -> None:
        self.endpoint = endpoint
        self.context = zmq.Context()
        self.socket = self.context.socket(zmq.XPUB)
        self.socket.bind(endpoint)

    def wait(self) -> None:
        assert self.socket.poll(5000)
        assert self.socket.recv()[:1] == b"\1"

    def send(self, *parts: bytes | Message) -> None:
        """Messages, numbered from 0 in this call, or raw bytes."""
        for number, part in enumerate(parts):
            self.socket.send(part if isinstance(part, bytes) else encode(replace(part, sequence=number)))

    def numbered(self, sequence: int, message: Message) -> None:
        self.socket.send(encode(replace(message, sequence=sequence)))


@pytest.fixture
def sender(tmp_path: Path) -> Iterator[Sender]:
    made = Sender(f"ipc://{tmp_path}/data")
    yield made
    made.context.destroy(linger=0)


@pytest.fixture
def views(sender: Sender) -> Iterator[ViewSubscriber]:
    with ViewSubscriber(sender.endpoint, "top", conflate=False, max_age_ms=60_000) as made:
        sender.wait()
        yield made


def damaged(message: Message) -> bytes:
    part = bytearray(encode(message))
    part[-1] ^= 1
    return bytes(part)


def window_ids(views: ViewSubscriber) -> list[int]:
    return [view.header.window_id for view in views]


def test_a_view_arrives_with_its_pixels_age_and_header(sender: Sender, views: ViewSubscriber) -> None:
    message = window(4, age_ms=250.0)
    sender.send(message)
    view = views.receive(5000)
    assert view.header == message.header
    assert np.array_equal(view.images, pixels(4))
    assert 250.0 <= view.age_ms < 10_000.0
    assert not view.expired
    assert not view.restarted


def test_damaged_and_stale_messages_never_end_a_loop_and_are_counted(sender: Sender, views: ViewSubscriber) -> None:
    key, old = topic_key("view/top/win"), window(2, age_ms=61_000.0)
    sender.send(damaged(window()), key, key + b"noise" * 20, window(3), window(4), old, damaged(end()))
    sender.numbered(8, window(5))
    sender.numbered(9, end())
    assert window_ids(views) == [3, 4, 5]
    assert (views.damaged, views.stale, views.received) == (4, 1, 3)
    assert "checksum" in views.last_error


def test_a_flood_of_damaged_messages_does_not_hold_a_call_beyond_its_time(
    sender: Sender, views: ViewSubscriber
) -> None:
    stop = threading.Event()

    def flood() -> None:
        while not stop.is_set():
            sender.send(*[b"view/top/win".ljust(64, b"\0")] * 100)

    thread = threading.Thread(target=flood)
    thread.start()
    try:
        began_s = time.monotonic()
        assert views.receive(50) is None
        assert time.monotonic() - began_s < 5
    finally:
        stop.set()
        thread.join()
    assert views.damaged > 0


def test_a_view_past_its_validity_is_marked(
    sender: Sender, views: ViewSubscriber, monkeypatch: pytest.MonkeyPatch
) -> None:
    message = replace(window(), header=replace(window().header, valid_for_ms=100))
    monkeypatch.setattr(time, "time_ns", lambda: message.header.t_publish_ns + 101 * 10**6)
    sender.send(message)
    view = views.receive(5000)
    assert view.expired
    assert view.age_ms == pytest.approx(40.5 + 101)
    monkeypatch.setattr(time, "time_ns", lambda: message.header.t_publish_ns - 10**9)  # a clock that runs behind
    sender.numbered(1, message)
    view = views.receive(5000)
    assert view.age_ms == 40.5


def test_an_older_view_revision_is_dropped(sender: Sender, views: ViewSubscriber) -> None:
    sender.send(*(window(i, view_rev=revision) for i, revision in enumerate((1, 2, 1, 2))), end())
    assert [(view.header.window_id, view.skipped) for view in views] == [(0, 0), (1, 0), (3, 0)]
    assert views.outdated == 1


def test_gaps_are_counted_and_repeats_dropped(sender: Sender, views: ViewSubscriber) -> None:
    for sequence in (7, 8, 8, 12):
        sender.numbered(sequence, window(sequence))
    sender.numbered(13, end())
    assert [view.skipped for view in views] == [0, 0, 3]
    assert (views.skipped, views.outdated, views.received) == (3, 1, 3)


def test_a_restart_is_told_once_even_behind_a_stale_view(sender: Sender, views: ViewSubscriber) -> None:
    sender.numbered(9, window(9, view_rev=5))
    sender.send(
        window(0, boot_id=OTHER_BOOT, age_ms=90_000.0),
        window(1, boot_id=OTHER_BOOT),
        window(2, boot_id=OTHER_BOOT),
        end(boot_id=OTHER_BOOT),
    )
    assert [view.restarted for view in views] == [False, True, False]
    assert views.restarts == 1


def test_the_welcome_message_is_no_view(sender: Sender, views: ViewSubscriber) -> None:
    views._connection.socket.subscribe(bytes(32))  # as a reader who wants to know when it is connected
    sender.wait()
    sender.send(bytes(64), window(3), end())
    assert window_ids(views) == [3]
    assert views.damaged == 0


def test_a_payload_over_the_limit_never_arrives(sender: Sender) -> None:
    with ViewSubscriber(sender.endpoint, "top", conflate=False, max_payload=100) as views:
        sender.wait()
        sender.send(window(images=pixels(frames=14, height=64, width=64)))  # ZeroMQ itself drops this one
        sender.send(window())  # this one passes it, because it allows for a long header
        assert views.receive(200) is None
        assert views.damaged <= 1


def test_a_stream_ends_and_may_begin_again(sender: Sender, views: ViewSubscriber) -> None:
    sender.send(window(0), end())
    assert window_ids(views) == [0]
    assert views.ended
    sender.numbered(2, window(1))
    sender.numbered(3, end())
    assert window_ids(views) == [1]


@pytest.mark.parametrize(("view", "kind"), [(None, "win"), ("top", None), (None, None), ("top", ("vis", "depth"))])
def test_all_views_or_kinds_cannot_be_conflated(view, kind) -> None:
    with pytest.raises(SetupError, match="name a view and a kind"):
        ViewSubscriber("tcp://127.0.0.1:1", view, kind, conflate=True)


def test_a_class_map_arrives_with_its_ontology_and_ends_on_its_own(sender: Sender) -> None:
    with ViewSubscriber(sender.endpoint, "top", "cls", conflate=False) as views:
        sender.wait()
        sender.send(window(3), class_map(3), end(kind="win"))
        sender.numbered(2, end(kind="cls"))
        (view,) = views
    assert view.header.classes == CLASSES
    assert np.array_equal(view.images[..., 0], numbers(3))
    assert view.colours.shape == (2, 4, 6, 3)


def test_all_kinds_of_one_view_leave_other_views_out(sender: Sender) -> None:
    with ViewSubscriber(sender.endpoint, "top", None, conflate=False) as views:
        sender.wait()
        sender.send(window(0, view_id="topdown"))
        sender.send(window(1))
        sender.send(class_map(1), end(kind="cls"))
        sender.numbered(1, end())
        found = [(view.message.topic, view.header.window_id) for view in views]
    assert found == [("view/top/win", 1), ("view/top/cls", 1)]


def test_a_grid_arrives_alone_until_it_ends(sender: Sender) -> None:
    with GridSubscriber(sender.endpoint, "around", conflate=False, max_age_ms=60_000) as grids:
        sender.wait()
        sender.send(window(), grid(view_id="around2"))
        for sequence, age_ms in ((0, 1.0), (3, 1e6), (4, 2.0)):
            sender.numbered(sequence, grid(age_ms=age_ms))
        sender.numbered(5, EndMessage(topic="grid/around", header=replace(end().header, view_id="around")))
        received = list(grids)
    assert [(each.header.age_ms, each.skipped) for each in received] == [(1.0, 0), (2.0, 0)]
    assert received[0].layers.occupancy.tolist() == cells().occupancy.tolist()
    assert (grids.received, grids.stale, grids.skipped, grids.damaged, grids.ended) == (2, 1, 2, 0, True)


@pytest.mark.parametrize(
    "endpoint", ["", "here", "http://127.0.0.1:80", "ipc://", "tcp://nowhere", "ipc://" + "x" * 5000]
)
def test_what_is_no_endpoint_is_refused(endpoint: str) -> None:
    with pytest.raises(SetupError):
        ViewSubscriber(endpoint, "top")


def test_a_conflated_reader_finds_the_newest_of_many(sender: Sender) -> None:
    with ViewSubscriber(sender.endpoint, "top") as views:
        sender.wait()
        sender.send(*(window(i) for i in range(50)))
        time.sleep(0.2)
        view = views.receive(5000)
        assert view.header.window_id == 49
        assert views.receive(20) is None


def test_pixels_outlive_what_comes_later_and_the_subscriber(sender: Sender) -> None:
    big = pixels(1, frames=14, height=64, width=96)  # large enough that ZeroMQ's own memory is used
    with ViewSubscriber(sender.endpoint, "top", conflate=False) as views:
        sender.wait()
        sender.send(*(window(i, images=big + np.uint8(i)) for i in range(4)), end())
        kept = [view.images for view in views]
    gc.collect()
    assert [(each == big + np.uint8(i)).all() for i, each in enumerate(kept)] == [True] * 4


# Status


def test_each_status_message_arrives_once(tmp_path: Path) -> None:
    def note(level: int) -> StatusMessage:
        return StatusMessage(topic="status", header=origin(), fields={"level": level})

    sender = Sender(f"ipc://{tmp_path}/status")
    with StatusSubscriber(sender.endpoint, ("status",)) as messages:
        sender.wait()
        for sequence, level in ((0, 0), (0, 0), (1, 2)):  # the node repeats the last one for new readers
            sender.numbered(sequence, note(level))
        sender.send(damaged(note(0)))
        assert [message.fields["level"] for message in (messages.receive(5000), messages.receive(5000))] == [0, 2]
        assert messages.receive(100) is None
        assert messages.damaged == 1
    sender.context.destroy(linger=0)


# Callbacks and asyncio


def test_run_calls_back_until_the_stream_ends_or_another_thread_says_so(sender: Sender, views: ViewSubscriber) -> None:
    called: list[int] = []
    sender.send(window(0), damaged(window(1)), window(2), end())
    views.run(lambda view: called.append(view.header.window_id))
    assert called == [0, 2]
    found, stop = list[ReceivedView](), threading.Event()
    thread = threading.Thread(target=views.run, args=(found.append, stop))
    thread.start()
    sender.numbered(4, window(3))
    while not found:
        time.sleep(0.01)
    stop.set()
    thread.join(5)
    assert not thread.is_alive()


def in_time(work: Callable[[], object]) -> None:
    asyncio.run(asyncio.wait_for(work(), 20))  # type: ignore[arg-type]


def test_asyncio_reads_views_while_other_tasks_run(sender: Sender, views: ViewSubscriber) -> None:
    async def read() -> None:
        ticks = 0

        async def tick() -> None:
            nonlocal ticks
            while True:
                await asyncio.sleep(0.01)
                ticks += 1
                if ticks == 5:
                    sender.send(window(0), damaged(window(1)), window(2), end())

        ticker = asyncio.create_task(tick())
        assert await views.receive_async(20) is None
        assert [view.header.window_id async for view in views] == [0, 2]
        assert ticks >= 5
        ticker.cancel()

    in_time(read)
    assert views.damaged == 1


def test_a_cancelled_task_loses_no_view(sender: Sender, views: ViewSubscriber) -> None:
    async def read() -> None:
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(views.receive_async(), 0.1)
        sender.send(window(0))
        view = await views.receive_async(5000)
        assert view.header.window_id == 0

    in_time(read)


# What importing it costs


def test_importing_the_client_loads_neither_numpy_nor_asyncio() -> None:
    code = "import sys, gcd_client; print(sorted({n.partition('.')[0] for n in sys.modules}))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60).stdout
    assert not {"numpy", "asyncio", "cv2", "torch", "rich", "typer", "gcd_node", "gcd_model"} & set(
        ast.literal_eval(out)
    )


@pytest.mark.parametrize("path", sorted(Path(gcd_client.__file__).parent.glob("*.py")), ids=lambda path: path.name)
def test_the_source_is_python_3_10(path: Path) -> None:
    assert ast.parse(path.read_text(), feature_version=(3, 10)).body
