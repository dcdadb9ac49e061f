"""How many read what, counted from what ZeroMQ says of subscriptions."""

import socket
from functools import partial
from pathlib import Path

from cameras import until
from zmtp import GREETING, message, ready

from gcd_client.subscriber import ViewSubscriber
from gcd_node.config import PublishConfig
from gcd_node.publisher import Publisher


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
