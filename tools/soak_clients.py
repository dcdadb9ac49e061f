"""The clients of a soak, each in a process of its own, one JSON object a line; they end when their stdin does.

    python tools/soak_clients.py read ENDPOINT VIEW [--newest] [--pause SECONDS] [--stall SECONDS]
    python tools/soak_clients.py attack DATA STATUS CONTROL SEED

The attacker speaks ZMTP 3.0 (ZeroMQ RFC 23) through bare sockets, so that it can leave in the middle of a frame or
announce one of a terabyte, which no ZeroMQ library would do for it.
"""

import argparse
import json
import os
import random
import socket
import sys
import threading
import time
from collections import Counter

from gcd_client.subscriber import ViewSubscriber

GREETING = b"\xff" + bytes(8) + b"\x7f" + b"\3\0" + b"NULL".ljust(20, b"\0") + bytes(32)
_LONG, _COMMAND = 2, 4
_REQUEST = b'{"proto":"gcd/1.0","id":"%d","verb":"%s","args":{}}'
_VERBS = (b"stats", b"describe", b"get_config", b"views", b"set_view", b"fly")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = parser.add_subparsers(required=True)
    reader = kinds.add_parser("read")
    reader.add_argument("endpoint")
    reader.add_argument("view")
    reader.add_argument("--newest", action="store_true", help="keep only the newest view")
    reader.add_argument("--pause", type=float, default=0.0, help="seconds after each view")
    reader.add_argument("--stall", type=float, default=0.0, help="read for a second, then nothing for so long")
    reader.set_defaults(run=read)
    attacker = kinds.add_parser("attack")
    for name in ("data", "status", "control"):
        attacker.add_argument(name)
    attacker.add_argument("seed", type=int)
    attacker.set_defaults(run=attack)
    options = parser.parse_args()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    options.run(options)


def _end_with_parent() -> None:
    sys.stdin.buffer.read()
    os._exit(0)


def _say(**fields: object) -> None:
    print(json.dumps(fields), flush=True)


def read(options: argparse.Namespace) -> None:
    with ViewSubscriber(options.endpoint, options.view, conflate=options.newest) as views:
        asleep_s = time.monotonic() + 1.0
        while True:
            view = views.receive(1000.0)
            if view is not None:
                _say(arrived_ns=time.monotonic_ns(), last_seq=view.header.src.seq[-1], skipped=view.skipped)
                time.sleep(options.pause)
            if options.stall and time.monotonic() > asleep_s:
                time.sleep(options.stall)
                asleep_s = time.monotonic() + 1.0


def attack(options: argparse.Namespace) -> None:
    attacker = Attacker(options.data, options.status, options.control, options.seed)
    said_s = 0.0
    while True:
        attacker.attack()
        time.sleep(0.05)
        if time.monotonic() - said_s > 0.5:
            said_s = time.monotonic()
            _say(done=dict(attacker.done), refused=attacker.refused)


class Attacker:
    """Attacks a node's three ipc sockets, one connection after another. refused: attacks that were cut short."""

    def __init__(self, data: str, status: str, control: str, seed: int) -> None:
        self._control, self._publishing = control, (data, status)
        self._chance = random.Random(seed)
        self.done: Counter[str] = Counter()
        self.refused = 0
        self._kinds = (
            self._silence,
            self._noise,
            self._noise_after_greeting,
            self._torn_frame,
            self._wrong_socket,
            self._malformed_flood,
            self._oversize_request,
            self._deaf_questions,
            self._odd_subscriptions,
            self._oversize_subscription,
        )

    def attack(self) -> None:
        kind = self._chance.choice(self._kinds)
        try:
            kind()
        except OSError:
            self.refused += 1
        self.done[kind.__name__.strip("_")] += 1

    def _silence(self) -> None:
        with self._connected(self._any()):
            time.sleep(self._chance.uniform(0.0, 0.5))

    def _noise(self) -> None:
        with self._connected(self._any()) as link:
            link.sendall(self._bytes(4000))

    def _noise_after_greeting(self) -> None:
        with self._connected(self._any()) as link:
            link.sendall(GREETING + self._bytes(4000))

    def _torn_frame(self) -> None:
        with self._greeted(self._control, "DEALER") as link:
            link.sendall(_announced(self._chance.choice((1000, 60_000, 2**40))) + self._bytes(500))

    def _wrong_socket(self) -> None:
        with self._greeted(self._any(), self._chance.choice(("REQ", "PUB", "ROUTER", "PAIR", "\0" * 9))) as link:
            link.sendall(_message(self._bytes(100)))

    def _malformed_flood(self) -> None:
        with self._greeted(self._control, "DEALER") as link:
            for _ in range(40):
                part = self._request()
                at = self._chance.randrange(len(part))
                link.sendall(_message(part[:at] + self._bytes(4) + part[at + self._chance.randint(0, 8) :]))

    def _oversize_request(self) -> None:
        with self._greeted(self._control, "DEALER") as link:
            link.sendall(_message(b" " * self._chance.randint(64 * 1024 + 1, 1024 * 1024)))

    def _deaf_questions(self) -> None:
        """Long answers are asked for and never read."""
        with self._greeted(self._control, "DEALER") as link:
            for _ in range(100):
                link.sendall(_message(self._request()))

    def _odd_subscriptions(self) -> None:
        """To what does not exist and to everything; some are taken back that were never made. Each once: ZeroMQ does
        not say who subscribes, so a second one of the same client counts for good."""
        with self._greeted(self._chance.choice(self._publishing), "SUB") as link:
            for topic in {*(self._bytes(40) for _ in range(20)), b"", b"view/"}:
                link.sendall(_message(b"\1" + topic) + _message(b"\0" + self._bytes(8)))

    def _oversize_subscription(self) -> None:
        with self._greeted(self._chance.choice(self._publishing), "SUB") as link:
            link.sendall(_message(b"\1" + b"x" * self._chance.randint(4096, 100_000)))

    def _any(self) -> str:
        return self._chance.choice((*self._publishing, self._control))

    def _request(self) -> bytes:
        return _REQUEST % (self._chance.randrange(10**9), self._chance.choice(_VERBS))

    def _bytes(self, most: int) -> bytes:
        return self._chance.randbytes(self._chance.randint(1, most))

    def _connected(self, endpoint: str) -> socket.socket:
        link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        link.settimeout(2.0)
        try:
            link.connect(endpoint.removeprefix("ipc://"))
        except BaseException:
            link.close()
            raise
        return link

    def _greeted(self, endpoint: str, socket_type: str) -> socket.socket:
        """Connected, and past the handshake."""
        link = self._connected(endpoint)
        try:
            link.sendall(GREETING)
            link.recv(len(GREETING), socket.MSG_WAITALL)
            link.sendall(_ready(socket_type))
            link.recv(256)
        except BaseException:
            link.close()
            raise
        return link


def _ready(socket_type: str) -> bytes:
    """The READY command that names our socket's type."""
    name, value = b"Socket-Type", socket_type.encode()
    body = b"\x05READY" + bytes([len(name)]) + name + len(value).to_bytes(4, "big") + value
    return bytes([_COMMAND, len(body)]) + body


def _message(body: bytes) -> bytes:
    return bytes([0, len(body)]) + body if len(body) < 256 else _announced(len(body)) + body


def _announced(size: int) -> bytes:
    """The head of a frame that claims so many bytes."""
    return bytes([_LONG]) + size.to_bytes(8, "big")


if __name__ == "__main__":
    main()
