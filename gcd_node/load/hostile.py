"""A client in a process of its own that sends everything it should not. Says what it did: one JSON object a line.

python -m gcd_node.load.hostile DATA STATUS CONTROL SEED

It speaks through bare sockets, so that it can leave in the middle of a frame or claim one of a terabyte, which no
ZeroMQ library would do for it. Ends when its stdin does.
"""

import json
import random
import socket
import sys
import time
from collections import Counter
from collections.abc import Callable

from gcd_node.load.parent import end_with_parent
from gcd_node.load.zmtp import GREETING, announced, message, ready

_PAUSE_S = 0.05
_SEND_S = 2.0
_TOLD_S = 0.5
_TERABYTE = 2**40
_REQUEST = b'{"proto":"gcd/1.0","id":"%d","verb":"%s","args":{}}'
_VERBS = (b"stats", b"describe", b"get_config", b"views", b"set_view", b"fly")


class Attacker:
    """Attacks a node's three sockets, one connection after another.

    data, status, control: ipc endpoints. done: attacks by kind. refused: connections that were not accepted.
    """

    def __init__(self, data: str, status: str, control: str, seed: int) -> None:
        self._control = control
        self._publishing = (data, status)
        self._everything = (data, status, control)
        self._chance = random.Random(seed)  # noqa: S311  which attack comes next is no secret
        self.done: Counter[str] = Counter()
        self.refused = 0
        self._kinds: tuple[Callable[[], None], ...] = (
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
        """One of them, drawn."""
        kind = self._chance.choice(self._kinds)
        try:
            kind()
        except OSError:
            self.refused += 1  # or thrown out, as it should be
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
        """A frame that never ends, and one that claims more memory than there is."""
        with self._greeted(self._control, "DEALER") as link:
            link.sendall(announced(self._chance.choice((1000, 60_000, _TERABYTE))) + self._bytes(500))

    def _wrong_socket(self) -> None:
        with self._greeted(self._any(), self._chance.choice(("REQ", "PUB", "ROUTER", "PAIR", "\0" * 9))) as link:
            link.sendall(message(self._bytes(100)))

    def _malformed_flood(self) -> None:
        with self._greeted(self._control, "DEALER") as link:
            for _ in range(40):
                link.sendall(message(self._mutated(self._request())))

    def _oversize_request(self) -> None:
        with self._greeted(self._control, "DEALER") as link:
            link.sendall(message(b" " * self._chance.randint(64 * 1024 + 1, 1024 * 1024)))

    def _deaf_questions(self) -> None:
        """Ask for long answers, and never listen."""
        with self._greeted(self._control, "DEALER") as link:
            for _ in range(100):
                link.sendall(message(self._request()))

    def _odd_subscriptions(self) -> None:
        """To what does not exist, to everything, and none is taken back, others are. Each once: who asks twice is
        counted twice for good, as ZeroMQ does not say who it is."""
        with self._greeted(self._chance.choice(self._publishing), "SUB") as link:
            topics = [self._bytes(40) for _ in range(20)]
            for topic in {*topics, b"", b"view/"}:
                link.sendall(message(b"\1" + topic) + message(b"\0" + self._bytes(8)))

    def _oversize_subscription(self) -> None:
        with self._greeted(self._chance.choice(self._publishing), "SUB") as link:
            link.sendall(message(b"\1" + b"x" * self._chance.randint(4096, 100_000)))

    def _any(self) -> str:
        return self._chance.choice(self._everything)

    def _request(self) -> bytes:
        return _REQUEST % (self._chance.randrange(10**9), self._chance.choice(_VERBS))

    def _bytes(self, most: int) -> bytes:
        return self._chance.randbytes(self._chance.randint(1, most))

    def _mutated(self, part: bytes) -> bytes:
        at = self._chance.randrange(len(part))
        return part[:at] + self._bytes(4) + part[at + self._chance.randint(0, 8) :]

    def _connected(self, endpoint: str) -> socket.socket:
        link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        link.settimeout(_SEND_S)
        try:
            link.connect(endpoint.removeprefix("ipc://"))
        except BaseException:
            link.close()
            raise
        return link

    def _greeted(self, endpoint: str, socket_type: str) -> socket.socket:
        """Connected, and past the handshake; what the other side says is only read as far as that takes."""
        link = self._connected(endpoint)
        try:
            link.sendall(GREETING)
            link.recv(len(GREETING), socket.MSG_WAITALL)
            link.sendall(ready(socket_type))
            link.recv(256)
        except BaseException:
            link.close()
            raise
        return link


def main() -> None:
    """Attack until the parent ends this process."""
    data, status, control, seed = sys.argv[1:]
    end_with_parent()
    attacker = Attacker(data, status, control, int(seed))
    told_s = 0.0
    while True:
        attacker.attack()
        time.sleep(_PAUSE_S)
        if time.monotonic() - told_s > _TOLD_S:
            told_s = time.monotonic()
            sys.stdout.write(json.dumps({"done": dict(attacker.done), "refused": attacker.refused}) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
