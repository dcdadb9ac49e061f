"""One browser: two threads, one that reads what it says and one that sends what waits for it."""

import logging
import threading
import time

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection

from gcd_node.errors import MessageError
from gcd_node.security.keys import Role
from gcd_node.viewer.access import Access
from gcd_node.viewer.desk import Desk
from gcd_node.viewer.hub import Hub, NodeEndpoints
from gcd_node.viewer.mailbox import Mailbox
from gcd_node.viewer.messages import Ask, Got, Hello, Note, Request, Watch, note, parse_request

_LOG = logging.getLogger(__name__)
_BEAT_S = 0.5
_JOIN_S = 10.0
_GOING_AWAY, _POLICY = 1001, 1008


class Allowance:
    """So many messages at once, and so many a second after that."""

    def __init__(self, burst: int = 100, per_s: float = 50.0) -> None:
        self._burst, self._per_s = burst, per_s
        self._left, self._at_s = float(burst), 0.0

    def take(self, now_s: float) -> bool:
        """Whether one more is in order. now_s: monotonic seconds."""
        self._left = min(self._burst, self._left + self._per_s * (now_s - self._at_s))
        self._at_s = now_s
        self._left -= 1
        return self._left >= 0


class Browser:
    """Serves one connection until either side ends it."""

    def __init__(self, connection: ServerConnection, hub: Hub, node: NodeEndpoints, access: Access) -> None:
        self._connection, self._hub, self._access = connection, hub, access
        self._desk = Desk(node)
        self._box = Mailbox()
        self._role: Role = "viewer"
        self._takes_commands = node.control is not None

    def serve(self) -> None:
        """Returns when the browser has gone, was sent away, or `close` was called."""
        sender = threading.Thread(target=self._send, name="viewer sender", daemon=True)
        sender.start()
        try:
            self._box.put("welcome", note("welcome", {"commands": self._takes_commands}))
            self._hub.join(self._box)
            self._read()
        except ConnectionClosed:
            pass
        finally:
            self._hub.leave(self._box)
            self._box.close()
            self._desk.close()
            sender.join(_JOIN_S)

    def close(self) -> None:
        """Say good-bye, soon; from any thread, does not wait."""
        self._box.close()

    def _read(self) -> None:
        allowance = Allowance()
        while not self._box.closed:
            text = self._connection.recv()
            if not allowance.take(time.monotonic()):
                self._connection.close(_POLICY, "too many messages")
                return
            try:
                self._hear(parse_request(text))
            except MessageError as error:
                _LOG.debug("a page is sent away: %s", error)
                self._connection.close(_POLICY, "this is no request of the page")
                return

    def _hear(self, request: Request) -> None:
        match request:
            case Hello(token=token):
                self._role = self._access.role(token)
                refused = token is not None and self._role == "viewer"
                self._box.put("role", note("role", {"role": self._role, "refused": refused}))
            case Watch(view=view):
                self._hub.look(self._box, view)
            case Ask():
                self._box.put(f"reply/{request.id}", self._desk.carry_out(request, self._role))
            case Got(number=number):
                self._box.shown(number)

    def _send(self) -> None:
        """Send what waits, and a beat twice a second: a page that hears none knows that nobody lives here."""
        beat_s = 0.0
        try:
            while not self._box.closed:
                taken = self._box.take(max(0.0, beat_s - time.monotonic()))
                if taken is not None:
                    number, parcel = taken
                    told = parcel.text if isinstance(parcel, Note) else parcel.part(number, time.monotonic())
                    self._connection.send(told)
                if time.monotonic() >= beat_s and not self._box.closed:
                    beat_s = time.monotonic() + _BEAT_S
                    self._connection.send(self._beat().text)
            self._connection.close(_GOING_AWAY, "the node has ended")
        except ConnectionClosed:
            pass
        finally:
            self._box.close()

    def _beat(self) -> Note:
        silent_s = self._hub.watch.silent_s
        return note("beat", {"silent_ms": None if silent_s is None else round(1000 * silent_s)})
