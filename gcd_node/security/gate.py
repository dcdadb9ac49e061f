"""CURVE on sockets, and the gate in front of bound ones: who may connect, and who was turned away.

Encryption alone lets everybody in; so every secured socket also asks this gate, over ZeroMQ's authentication protocol
(ZAP), in a domain of its own. What ZeroMQ does without a word, the gate hears from the sockets' monitors.
Standard library and pyzmq only, Python 3.10 syntax: planners import this.

Longer than most files: all of it waits in one thread for the same sockets.
"""

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import zmq
from zmq.utils import z85
from zmq.utils.monitor import parse_monitor_message

from gcd_node.errors import AuthError, ConfigError, EndpointError
from gcd_node.security.connections import Allowance, Connections
from gcd_node.security.keys import Client, ClientKeys, KeyPair, fingerprint
from gcd_node.wire.endpoints import Channel, check_bindable, free_ipc_path, is_ipv6

_LOG = logging.getLogger(__name__)

EventSink: TypeAlias = Callable[[str, dict[str, object]], None]
"""Takes an event's code and its fields; called from threads of sockets, so it must not wait."""

Socket: TypeAlias = "zmq.Socket[bytes]"
Context: TypeAlias = "zmq.Context[zmq.Socket[bytes]]"

_ZAP_ENDPOINT = "inproc://zeromq.zap.01"
_TICK_MS = 100
_MOST_AT_ONCE = 64  # events of one socket, before others get their turn
_RECEIVE_BUFFER = 256 * 1024
_REQUESTS = Allowance(burst=2 * 2**20)  # more than may wait whole: 16 requests of 64 KiB
_SUBSCRIPTIONS = Allowance(burst=256 * 1024, per_s=1024.0)  # a reader says little, and nobody tells when it has ended
_FAILED = zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
_HEARD = zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED | _FAILED
_REFUSED = zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL


@dataclass(frozen=True, kw_only=True, slots=True)
class ServerSecurity:
    """A node's own keys, and its clients by their public keys (Z85).

    refresh: asked often, gives the clients as they are now; None if they never change.
    """

    keys: KeyPair
    clients: Mapping[str, Client]
    refresh: Callable[[], Mapping[str, Client]] | None = field(default=None, compare=False)


def new_key_pair() -> KeyPair:
    """Fresh CURVE keys."""
    public, secret = zmq.curve_keypair()
    return KeyPair(public=public.decode(), secret=secret.decode())


def check_pair(pair: KeyPair) -> None:
    """Raises ConfigError if the public key is not that of the secret one."""
    if zmq.curve_public(pair.secret.encode()) != pair.public.encode():
        raise ConfigError("public.key and secret.key do not belong together; make new ones with `gcd-node keys new`")


def use_client_keys(socket: Socket, keys: ClientKeys) -> None:
    """Encrypt a client's socket; before it connects."""
    check_pair(keys.own)
    socket.set(zmq.CURVE_SERVERKEY, keys.server.encode())
    socket.set(zmq.CURVE_PUBLICKEY, keys.own.public.encode())
    socket.set(zmq.CURVE_SECRETKEY, keys.own.secret.encode())


def unbind(socket: Socket, endpoint: str, linger_ms: int) -> None:
    """Close; an ipc file goes first, while it is still ours: ZeroMQ leaves it behind."""
    if endpoint.startswith("ipc://"):
        Path(endpoint.removeprefix("ipc://")).unlink(missing_ok=True)
    socket.close(linger_ms)


class HandshakeWatch:
    """Tells a client why nothing comes: of a refused connection ZeroMQ itself says nothing, and it tries no more."""

    def __init__(self, socket: Socket, endpoint: str, keys: ClientKeys | None) -> None:
        self.monitor: Socket = socket.get_monitor_socket(_REFUSED)
        self._endpoint, self._keys = endpoint, keys
        self._heard = 0

    def check(self, wait_ms: int = 0) -> None:
        """Raises AuthError if the connection was refused, now or before, or within wait_ms if nothing came yet."""
        while self.monitor.poll(0 if self._heard else wait_ms):
            self._heard |= int(parse_monitor_message(self.monitor.recv_multipart())["event"])
        if self._heard & _REFUSED:
            raise AuthError(f"{self._endpoint} does not let us in: {self._reason()}")

    def _reason(self) -> str:
        if self._keys is None:
            return "it asks for keys, none were given; make some with `gcd-node keys new` and have them allowed there"
        if self._heard & zmq.EVENT_HANDSHAKE_FAILED_AUTH:
            mark = fingerprint(self._keys.own.public)
            return f"our key, fingerprint {mark}, is not on its list; have it allowed there (`gcd-node keys show`)"
        return "it uses no keys here; leave ours out"


class Gate:
    """In front of the bound sockets of one context. Bind through it, then `start`; `close` it after the sockets.

    Until started, who connects to a secured socket waits. When a client is taken off the list, or may do less, all
    connections are cut: who is still on it connects again within a second. on_event gets AUTH_DENIED, AUTH_UNCUT and
    TOO_LARGE; rare by themselves or limited here, so that a hostile client cannot flood with them.
    """

    def __init__(self, context: Context, security: ServerSecurity | None, on_event: EventSink | None) -> None:
        self._security = security
        self._clients: Mapping[str, Client] = {} if security is None else security.clients
        self._denials = _Denials(on_event or _unheard)
        self._on_event = on_event or _unheard
        self._monitors: dict[Socket, _Monitored] = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="gate", daemon=True)
        self._next_look_s = 0.0
        self._zap: Socket | None = None
        if security is not None:
            self._zap = context.socket(zmq.REP)
            self._zap.set(zmq.LINGER, 0)
            self._zap.bind(_ZAP_ENDPOINT)

    def bind(self, socket: Socket, endpoint: str, channel: Channel) -> str:
        """Bind a socket: tcp with keys if there are any, ipc for this user, and for his group if the umask lets it.

        Returns:
            The endpoint, with the port that was chosen if 0 was asked for.
        Raises:
            ConfigError: others than this machine could reach it without keys. EndpointError: in use, or impossible.
        """
        secured = self._security is not None and endpoint.startswith("tcp://")
        check_bindable(endpoint, secured=secured)
        if endpoint.startswith("ipc://"):  # ZeroMQ itself would take a live endpoint away without a word
            free_ipc_path(Path(endpoint.removeprefix("ipc://")))
        if secured:
            self._secure(socket, channel)
        monitored: _Monitored | None = None
        if channel == "control" or endpoint.startswith("tcp://"):
            socket.set(zmq.RCVBUF, _RECEIVE_BUFFER)  # what is under way when somebody is cut off is still taken in
            monitored = self._monitors[socket.get_monitor_socket(_HEARD)] = _Monitored(channel=channel, secured=secured)
        socket.set(zmq.IPV6, int(is_ipv6(endpoint)))
        try:
            socket.bind(endpoint)
        except zmq.ZMQError as error:
            message = f"cannot bind {endpoint}: {error.strerror}; stop who uses it or choose another"
            raise EndpointError(message) from error
        bound = socket.getsockopt_string(zmq.LAST_ENDPOINT)
        if bound.startswith("ipc://"):
            path = Path(bound.removeprefix("ipc://"))
            path.chmod(path.stat().st_mode & 0o770)  # whatever folder and umask say: not for everybody
        if bound.startswith("tcp://") and monitored is not None:
            monitored.port = int(bound.rpartition(":")[2])
        return bound

    def client(self, user: str) -> Client | None:
        """Who a message's ZeroMQ user id, his key, belongs to; None if he is not, or no longer, on the list."""
        return self._clients.get(user)

    def whole(self, handle: int) -> None:
        """A request has arrived whole over this connection; from the thread that took it."""
        for each in self._monitors.values():
            if each.channel == "control":
                each.connections.whole(handle)

    def start(self) -> None:
        """Begin to let clients in."""
        if self._zap is not None or self._monitors:
            self._thread.start()

    def close(self) -> None:
        """Stop; a second call does nothing."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()

    def _secure(self, socket: Socket, channel: Channel) -> None:
        if self._security is None:
            return
        socket.set(zmq.CURVE_SERVER, 1)
        socket.set(zmq.CURVE_SECRETKEY, self._security.keys.secret.encode())
        socket.set(zmq.ZAP_DOMAIN, f"gcd.{channel}".encode())
        socket.set(zmq.ZAP_ENFORCE_DOMAIN, 1)  # closed to all, not open to all, should the gate ever be gone

    # What follows runs in the gate's thread alone.

    def _serve(self) -> None:
        poller = zmq.Poller()
        for each in (*self._monitors, *([self._zap] if self._zap else [])):
            poller.register(each, zmq.POLLIN)
        try:
            while not self._closing.is_set():
                ready = {each for each, _ in poller.poll(0 if self._ahead() else _TICK_MS)}
                for each in (*ready, *(self._ahead() - ready)):
                    self._hear(each, poller)
                self._look_at_list()
                self._cut_endless()
        finally:
            for each, monitored in self._monitors.items():
                monitored.connections.forget()
                each.close(0)
            if self._zap is not None:
                self._zap.close(0)

    def _ahead(self) -> set[object]:
        """The monitors with events that were taken and not looked at."""
        return {monitor for monitor, monitored in self._monitors.items() if monitored.ahead}

    def _hear(self, ready: object, poller: zmq.Poller) -> None:
        try:
            if self._zap is not None and ready is self._zap:
                self._judge(self._zap)
                return
            for monitor, monitored in self._monitors.items():
                if monitor is ready and not self._notice(monitor, monitored):
                    poller.unregister(monitor)
        except Exception:
            _LOG.exception("the gate goes on after an error of its own")

    def _judge(self, zap: Socket) -> None:
        """Answer one ZAP request: version, id, domain, address, identity, mechanism, key."""
        request = zap.recv_multipart()
        known = self._known(request)
        user = (_key_of(request) or "").encode()
        verdict = (b"400", b"not allowed", b"", b"") if known is None else (b"200", b"OK", user, b"")
        zap.send_multipart((b"1.0", request[1] if len(request) > 1 else b"", *verdict))
        if known is None:
            self._denials.tell(_key_of(request), _text(request, 2), _text(request, 3))

    def _known(self, request: list[bytes]) -> Client | None:
        key = _key_of(request)
        return None if key is None else self._clients.get(key)

    def _look_at_list(self) -> None:
        """Follow the list of clients; nobody who was let in by an older one stays connected to more than he may."""
        if self._security is None or self._security.refresh is None:
            return
        before, now = self._clients, self._security.refresh()
        if now is before:
            return
        self._clients = now
        if all(now.get(key) == client for key, client in before.items()):
            return
        left = sum(each.connections.cut_all(each.port) for each in self._monitors.values() if each.secured)
        if left:
            message = f"{left} connections could not be cut after a change of the list of clients; restart the node"
            _LOG.error("AUTH_UNCUT: %s", message)
            self._on_event("AUTH_UNCUT", {"level": 2, "message": message})

    def _cut_endless(self) -> None:
        """Ten times a second: hang up on clients whose message does not end."""
        now_s = time.monotonic()
        if now_s < self._next_look_s:
            return
        self._next_look_s = now_s + _TICK_MS / 1000
        for each in self._monitors.values():
            allowance = _REQUESTS if each.channel == "control" else _SUBSCRIPTIONS
            for _ in range(each.connections.cut_endless(each.port, allowance, now_s) if each.port else 0):
                self._tell_too_large(each.channel)

    def _tell_too_large(self, channel: Channel) -> None:
        _LOG.warning("TOO_LARGE: dropped a client of %s that sent more than it may", channel)
        self._on_event("TOO_LARGE", {"level": 1, "channel": channel})

    def _notice(self, monitor: Socket, monitored: "_Monitored") -> bool:
        """What a bound socket's monitor has by now; False once the socket is closed."""
        monitored.take(monitor)
        for _ in range(min(len(monitored.ahead), _MOST_AT_ONCE)):  # others wait for the gate, too
            event, handle = monitored.next()
            if event == zmq.EVENT_MONITOR_STOPPED:
                return False
            self._look_at(event, handle, monitor, monitored)
        return True

    def _look_at(self, event: int, handle: int, monitor: Socket, monitored: "_Monitored") -> None:
        connections = monitored.connections
        if event & _FAILED:
            connections.failed()
        if event & _FAILED and monitored.secured:  # no keys, or the wrong one for this node
            self._denials.tell(None, f"gcd.{monitored.channel}", "")
        if event == zmq.EVENT_ACCEPTED:
            connections.accepted(handle)
            monitored.take(monitor)
            if monitored.ends[handle]:  # its number may be another connection's by now
                connections.missed(handle)
        if event == zmq.EVENT_DISCONNECTED and connections.cut_off(handle) and monitored.channel == "control":
            self._tell_too_large(monitored.channel)


@dataclass(kw_only=True, slots=True)
class _Monitored:
    """A bound socket that is listened to. port: of tcp. ahead: events taken from its monitor, not yet looked at.

    ends: how many of these tell of a connection's end, by its number.
    """

    channel: Channel
    secured: bool
    port: int = 0
    connections: Connections = field(default_factory=Connections)
    ahead: deque[tuple[int, int]] = field(default_factory=deque[tuple[int, int]])
    ends: Counter[int] = field(default_factory=Counter[int])

    def take(self, monitor: Socket) -> None:
        """All events that wait. ZeroMQ tells of an end before it gives the connection's number away."""
        while monitor.poll(0):
            heard = parse_monitor_message(monitor.recv_multipart())
            event, handle = int(heard["event"]), int(heard["value"])
            self.ahead.append((event, handle))
            if event == zmq.EVENT_DISCONNECTED:
                self.ends[handle] += 1

    def next(self) -> tuple[int, int]:
        """The oldest event, and its connection's number."""
        event, handle = self.ahead.popleft()
        if event == zmq.EVENT_DISCONNECTED:
            self.ends[handle] -= 1
            if not self.ends[handle]:
                del self.ends[handle]
        return event, handle


class _Denials:
    """AUTH_DENIED events, limited: one for each key and socket in 10 s, and at most 8 in all in that time."""

    SPAN_S = 10.0
    MOST = 8

    def __init__(self, on_event: EventSink) -> None:
        self._on_event = on_event
        self._told_s: dict[tuple[str | None, str], float] = {}
        self._suppressed = 0

    def tell(self, key: str | None, domain: str, address: str) -> None:
        now_s = time.monotonic()
        self._told_s = {each: told for each, told in self._told_s.items() if now_s - told < self.SPAN_S}
        if (key, domain) in self._told_s or len(self._told_s) >= self.MOST:
            self._suppressed += 1
            return
        self._told_s[key, domain] = now_s
        mark = None if key is None else fingerprint(key)
        _LOG.warning("AUTH_DENIED on %s: %s", domain, "no valid handshake" if mark is None else f"key {mark}")
        fields: dict[str, object] = {"level": 1, "fingerprint": mark, "domain": domain, "address": address}
        self._on_event("AUTH_DENIED", fields | {"suppressed": self._suppressed})
        self._suppressed = 0


def _key_of(request: list[bytes]) -> str | None:
    """The client's public key of a ZAP request in Z85; None if it speaks of anything else than CURVE."""
    if len(request) != 7 or request[5] != b"CURVE" or len(request[6]) != 32:
        return None
    return z85.encode(request[6]).decode()


def _text(request: list[bytes], index: int) -> str:
    return request[index].decode("ascii", "backslashreplace")[:64] if len(request) > index else ""


def _unheard(code: str, fields: dict[str, object]) -> None:
    """Nobody wants to hear of events; the log has them."""
