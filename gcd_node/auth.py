"""Who may connect: endpoints that only this machine reaches, and over tcp CURVE keys, an allow-list and roles.

The allow-list is a TOML file:

    [client.desk]
    key = "40 characters, as `gcd-node keys show` prints"
    role = "operator"

Encryption alone lets everybody in, so every secured socket also asks the allow-list. ipc sockets ask for no keys: the
mode of their folder guards them.
"""

import contextlib
import ipaddress
import logging
import os
import socket
import stat
import threading
import time
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeAlias, get_args

import msgspec
import zmq
from msgspec import Meta
from zmq.auth.thread import ThreadAuthenticator
from zmq.utils.monitor import parse_monitor_message

from gcd_client.endpoints import (
    PUBLIC_FILE,
    SECRET_FILE,
    Channel,
    KeyPair,
    SetupError,
    check_key,
    fingerprint,
    read_key_pair,
    resolve_endpoint,
    runtime_folder,
)
from gcd_node.config import SecurityConfig
from gcd_node.errors import ConfigError, EndpointError, OutputError
from gcd_node.health import Level

_LOG = logging.getLogger(__name__)

Socket: TypeAlias = "zmq.Socket[bytes]"
Context: TypeAlias = "zmq.Context[zmq.Socket[bytes]]"
EventSink: TypeAlias = Callable[[str, Level, Mapping[str, object]], None]
"""Takes an event: its code, how bad it is, its fields. Called from threads of sockets, so it must not wait."""
Role: TypeAlias = Literal["viewer", "operator"]
"""What a client may do: look, or also command. A viewer's verbs change nothing."""
ClientName: TypeAlias = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,32}$(?!\n)")]

_MOST_EVENTS = 64  # of one socket at once: a flood of failing clients must not hold up the others
_FAILED = zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
_DENIAL_SPAN_S, _MOST_DENIALS = 10.0, 8


def log_event(code: str, _: Level, fields: Mapping[str, object]) -> None:
    """An EventSink where there is no node yet that publishes and logs them."""
    _LOG.warning("%s: %s", code, fields)


# Endpoints.


def _make_runtime_folder() -> None:
    """With mode 0700. Raises EndpointError: it cannot be made, or belongs to another user."""
    folder = runtime_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat(follow_symlinks=False)
    except OSError as error:
        raise EndpointError(f"cannot create the runtime folder {folder}: {error.strerror}") from error
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & stat.S_IWOTH:
        raise EndpointError(f"the runtime folder {folder} must be ours alone; remove it or set RUNTIME_DIRECTORY")


def is_loopback(endpoint: str) -> bool:
    """Whether a tcp endpoint stays on this machine; a name other than localhost counts as outside."""
    host = endpoint.removeprefix("tcp://").rpartition(":")[0].strip("[]")
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _free_ipc_path(path: Path) -> None:
    """Remove the file that a dead process left; ZeroMQ itself would take a live endpoint away without a word. Raises
    EndpointError: a process answers there, or it is no socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(0.5)
        try:
            probe.connect(str(path))
            reason = "a running process"
        except FileNotFoundError:
            return
        except ConnectionRefusedError:
            if path.is_socket():
                path.unlink(missing_ok=True)
                return
            reason = "something that is no socket"
        except OSError as error:
            reason = str(error)
    raise EndpointError(f"ipc://{path} is in use: {reason}; stop it or choose another endpoint")


def unbind(bound: Socket, endpoint: str, linger_ms: int) -> None:
    """Close; an ipc file goes first, while it is still ours: ZeroMQ leaves it behind."""
    if endpoint.startswith("ipc://"):
        Path(endpoint.removeprefix("ipc://")).unlink(missing_ok=True)
    bound.close(linger_ms)


# Keys and clients.


@dataclass(frozen=True, kw_only=True, slots=True)
class Client:
    """Whose key it is, and what it may do."""

    name: str
    role: Role


class AllowedClient(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """key: the client's public key. role: "viewer" may look, "operator" may also command."""

    key: str
    role: Role = "viewer"


class AllowFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole allow-list, by name; to let nobody in any more, leave an empty [client]."""

    client: dict[ClientName, AllowedClient]


@dataclass(frozen=True, kw_only=True, slots=True)
class ServerSecurity:
    """A node's own keys, and its clients. find_client: by public key (Z85), None for a stranger; from any thread."""

    keys: KeyPair
    find_client: Callable[[str], Client | None]


def new_key_pair() -> KeyPair:
    """Fresh CURVE keys."""
    public, secret = zmq.curve_keypair()
    return KeyPair(public=public.decode(), secret=secret.decode())


def write_key_pair(folder: Path, pair: KeyPair) -> None:
    """Write a new key folder, mode 0700, with its secret file of mode 0600. Raises OutputError: there are keys already,
    which are never overwritten, or the folder cannot be written."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for name, text, mode in ((SECRET_FILE, pair.secret, 0o600), (PUBLIC_FILE, pair.public, 0o644)):
            with os.fdopen(os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "w") as file:
                file.write(text + "\n")
    except OSError as error:
        raise OutputError(f"cannot write keys to {folder}: {error.strerror}; choose another folder") from error


def load_server_security(config: SecurityConfig, on_event: EventSink = log_event) -> ServerSecurity | None:
    """Keys and clients of a launch file; None if it states neither. on_event: see AllowList.

    Raises:
        ConfigError, SetupError: files missing, readable or writable by others, damaged; a key that two clients share.
    """
    if config.keys is None or config.allow is None:
        return None
    pair = read_key_pair(Path(config.keys))
    return ServerSecurity(keys=pair, find_client=AllowList(Path(config.allow), on_event).find)


class AllowList:
    """Clients by public key. The file is read again when it has changed and a client connects or sends a request.

    on_event gets ALLOW_CHANGED with the names that were `added` and `removed` (a new key or role is both), or
    ALLOW_REFUSED with a `message`, once for each broken file; then the list stays as it was.
    Raises ConfigError: as load_server_security(); or nobody is on the list.
    """

    def __init__(self, path: Path, on_event: EventSink = log_event) -> None:
        self._path, self._on_event, self._lock = path, on_event, threading.Lock()
        self._version, self._clients = _version(path), load_clients(path)
        if not self._clients:
            raise ConfigError(f"{path} names no client, so nobody could connect; add one, see docs/node.md")

    def find(self, key: str) -> Client | None:
        """Whose key this is; None for a stranger. From any thread."""
        with self._lock:
            version = _version(self._path)
            if version != self._version:
                self._version = version  # before the file is read: what changes meanwhile is read next time
                self._reload()
            return self._clients.get(key)

    def _reload(self) -> None:
        try:
            clients = load_clients(self._path)
        except ConfigError as error:
            self._on_event("ALLOW_REFUSED", Level.ERROR, {"message": str(error)})
            return
        before, self._clients = set(self._clients.items()), clients
        added = sorted(client.name for _, client in clients.items() - before)
        removed = sorted(client.name for _, client in before - clients.items())
        if added or removed:
            self._on_event("ALLOW_CHANGED", Level.OK, {"added": added, "removed": removed})


def load_clients(path: Path) -> dict[str, Client]:
    """Clients by public key; may be none. Raises ConfigError as load_server_security()."""
    from gcd_model import FileError, decode_toml, read_small  # only now: it brings torch, and clients need none

    clients: dict[str, Client] = {}
    try:
        if path.stat().st_mode & stat.S_IWOTH:
            raise ConfigError(f"{path} can be written by everybody; run chmod o-w on it")
        for name, entry in msgspec.convert(decode_toml(read_small(path)), AllowFile).client.items():
            check_key(entry.key, f"the key of {name}")
            if entry.key in clients:
                raise ConfigError(f"{path}: {name} and {clients[entry.key].name} have the same key")
            clients[entry.key] = Client(name=name, role=entry.role)
    except (OSError, FileError, msgspec.ValidationError, SetupError) as error:
        raise ConfigError(f"the allow-list {path}: {error}; see docs/node.md") from error
    return clients


def _version(path: Path) -> tuple[int, int, int] | None:
    """Differs as soon as anything about the file has changed; None without one."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ctime_ns, status.st_ino, status.st_size


# Sockets.


class SocketGuard:
    """Has the ZeroMQ context of a thread's sockets, binds them, waits for them, and answers who may connect to those
    that are secured. `bind`, `wait` and `close` belong to that thread, or to whoever makes and ends it.

    on_event gets AUTH_DENIED: once for each key and socket in 10 s and at most 8 in all in that time, so that a hostile
    client cannot flood with it.
    """

    def __init__(self, security: ServerSecurity | None, on_event: EventSink | None = None) -> None:
        self.context: Context = zmq.Context()
        self._monitors: dict[Socket, Channel] = {}
        self._wake_fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        weakref.finalize(self, os.close, self._wake_fd)  # no sooner: then it may mean another file to who wakes late
        self._poller = zmq.Poller()
        self._poller.register(self._wake_fd, zmq.POLLIN)
        self._security, self._on_event, self._lock = security, on_event or log_event, threading.Lock()
        self._reported_s: dict[tuple[str | None, str], float] = {}
        self._suppressed = 0
        self._authenticator: _Authenticator | None = None
        self.threads: list[threading.Thread] = []
        """What lets clients in; nobody comes in without them."""
        if security is not None:
            self._authenticator = _Authenticator(self, security)
            self._authenticator.start()
            self._authenticator.thread.name = "authentication"
            self.threads = [self._authenticator.thread]

    def bind(self, unbound: Socket, endpoint: str, channel: Channel) -> str:
        """Bind a socket: tcp with keys if there are any, ipc for this user, and his group if the umask lets it. Gives
        its endpoint, with the port that was chosen if 0 was asked for.

        Raises:
            SetupError: no endpoint. ConfigError: others than this machine could reach it without keys. EndpointError:
                in use, or impossible.
        """
        if endpoint == "ipc":
            _make_runtime_folder()
        endpoint = resolve_endpoint(endpoint, channel)
        if endpoint.startswith("ipc://"):
            _free_ipc_path(Path(endpoint.removeprefix("ipc://")))
        elif self._security is not None:
            unbound.set(zmq.CURVE_SERVER, 1)
            unbound.set(zmq.CURVE_SECRETKEY, self._security.keys.secret.encode())
            unbound.set(zmq.ZAP_DOMAIN, f"gcd.{channel}".encode())
            unbound.set(zmq.ZAP_ENFORCE_DOMAIN, 1)  # without an authenticator: closed to all, not open to all
            monitor = unbound.get_monitor_socket(_FAILED)
            self._monitors[monitor] = channel
            self._poller.register(monitor, zmq.POLLIN)
        elif not is_loopback(endpoint):
            raise ConfigError(
                f"{endpoint} can be reached from other machines, which needs CURVE keys and a list of allowed clients: "
                "state both [security] keys and [security] allow, see `gcd-node keys`; or bind tcp://127.0.0.1:PORT, "
                "or ipc"
            )
        unbound.set(zmq.IPV6, int(endpoint.startswith("tcp://[")))
        try:
            unbound.bind(endpoint)
        except zmq.ZMQError as error:
            raise EndpointError(f"cannot bind {endpoint}: {error.strerror}; choose another") from error
        self._poller.register(unbound, zmq.POLLIN)
        bound = unbound.getsockopt_string(zmq.LAST_ENDPOINT)
        if bound.startswith("ipc://"):
            path = Path(bound.removeprefix("ipc://"))
            path.chmod(path.stat().st_mode & 0o770)  # whatever folder and umask say: not for everybody
        return bound

    def wake(self) -> None:
        """End the wait() under way, or the next one; from any thread."""
        os.eventfd_write(self._wake_fd, 1)

    def wait(self, timeout_ms: int | None = None) -> None:
        """Until one of the sockets can be read, or wake(). Reports handshakes that failed before there was a key to
        judge."""
        self._poller.poll(timeout_ms)
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._wake_fd)
        for monitor, channel in self._monitors.items():
            for _ in range(_MOST_EVENTS):
                if not monitor.poll(0):
                    break
                if int(parse_monitor_message(monitor.recv_multipart())["event"]) & _FAILED:
                    self.deny(None, f"gcd.{channel}", "")

    def close(self) -> None:
        """Let nobody in any more, close what is still open, and wait until what was sent has left. A second call does
        nothing."""
        for monitor in self._monitors:
            monitor.close(0)
        self._monitors.clear()
        if self._authenticator is not None:
            if self._authenticator.pipe and not self._authenticator.is_alive():  # stop() would wait for it for ever
                self._authenticator.pipe.close(0)
                self._authenticator.pipe = None  # pyright: ignore[reportAttributeAccessIssue]  as pyzmq itself does
            self._authenticator.stop()
        self.context.destroy()

    def deny(self, key: str | None, domain: str, address: str) -> None:
        """Report a refusal, or count it; key: None if the handshake came to none. From any thread."""
        with self._lock:
            now_s = time.monotonic()
            self._reported_s = {each: at for each, at in self._reported_s.items() if now_s - at < _DENIAL_SPAN_S}
            if (key, domain) in self._reported_s or len(self._reported_s) >= _MOST_DENIALS:
                self._suppressed += 1
                return
            self._reported_s[key, domain] = now_s
            suppressed, self._suppressed = self._suppressed, 0
        who = {"fingerprint": None if key is None else fingerprint(key), "domain": domain, "address": address}
        try:
            self._on_event("AUTH_DENIED", Level.WARN, {**who, "suppressed": suppressed})
        except Exception as error:  # of who hears of it, such as a publisher that is closing: no thread ends by that
            _LOG.warning("a refused client cannot be reported: %s", error)


class _Authenticator(ThreadAuthenticator):
    """Lets clients of the allow-list in; their messages carry the public key as `User-Id`."""

    def __init__(self, guard: SocketGuard, security: ServerSecurity) -> None:
        super().__init__(guard.context)
        self._find_client, self._deny, self._address = security.find_client, guard.deny, ""
        for channel in get_args(Channel):  # exactly these: a provider for "*" does not apply to a socket with a domain
            self.configure_curve_callback(f"gcd.{channel}", self)

    def callback(self, domain: str, key: bytes) -> bool:
        """Whether a key may connect: it is on the allow-list, to push frames as an operator's; called by zmq.auth.
        Whatever breaks on the way lets nobody in, and does not end the thread."""
        try:
            client = self._find_client(key.decode())
        except Exception:
            _LOG.exception("a client could not be judged, and is not let in")
            client = None
        if client is not None and (client.role == "operator" or domain != "gcd.frames"):
            return True
        self._deny(key.decode(), domain, self._address)
        return False

    async def handle_zap_message(self, msg: list[bytes]) -> None:
        self._address = msg[3].decode("ascii", "backslashreplace")[:64] if len(msg) > 3 else ""
        await super().handle_zap_message(msg)
