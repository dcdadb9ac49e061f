"""How many read what, counted from what ZeroMQ says of subscriptions."""

import socket
import time
from functools import partial
from pathlib import Path

import zmq
from cameras import until
from zmtp import GREETING, message, ready

from gcd_client.protocol import topic_key
from gcd_client.subscriber import ViewSubscriber
from gcd_node.config import PublishConfig
from gcd_node.publisher import Publisher


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
