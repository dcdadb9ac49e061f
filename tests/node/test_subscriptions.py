"""How many read what, counted from what ZeroMQ says of subscriptions."""

import socket
from collections import Counter
from pathlib import Path

from cameras import until
from hypothesis import given
from hypothesis import strategies as st
from zmtp import GREETING, message, ready

from gcd_client.protocol import topic_key
from gcd_client.subscriber import ViewSubscriber
from gcd_node.publisher import Publisher
from gcd_node.sockets import PublisherOptions, Readers

TOPICS = [b"", b"src/", topic_key("src/frm"), b"view/", topic_key("view/a/win")]


@given(st.lists(st.tuples(st.booleans(), st.sampled_from(TOPICS))))
def test_readers_are_counted_as_if_all_were_looked_at_each_time(events: list[tuple[bool, bytes]]) -> None:
    counted, there = Readers(), Counter[bytes]()
    for comes, topic in events:
        counted.count(bytes([comes]) + topic)
        there[topic] = max(0, there[topic] + (1 if comes else -1))
    previews = {topic: count for topic, count in there.items() if topic_key("src/frm").startswith(topic)}
    every = sum(previews.values())
    watchers = there.total() - every + previews.get(b"", 0)
    assert counted.now == (there.total(), watchers, every)


def test_who_takes_back_what_nobody_asked_for_makes_no_reader_disappear(tmp_path: Path) -> None:
    options = PublisherOptions(data=f"ipc://{tmp_path}/data", status=None, linger_ms=0)
    with Publisher(options) as publisher, ViewSubscriber(publisher.endpoint, "top"):
        until(lambda: publisher.stats.subscribers == 1)
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
            link.connect(f"{tmp_path}/data")
            link.sendall(GREETING)
            link.recv(len(GREETING), socket.MSG_WAITALL)
            link.sendall(ready("SUB"))
            link.sendall(3 * message(b"\0never") + message(b"\1once") + message(b"\1then"))
            until(lambda: publisher.stats.subscribers == 3)
        until(lambda: publisher.stats.subscribers == 1)
