"""Who may connect: endpoints that only this machine reaches, and over tcp CURVE keys, an allow-list and roles.

The allow-list is a TOML file:

    [client.desk]
    key = "40 characters, as `gcd-node keys show` prints"
    role = "operator"

Encryption alone lets everybody in, so every secured socket also asks the allow-list. ipc sockets ask for no keys: the
mode of their folder guards them.
"""

import ipaddress
import logging
import os
import socket
import stat
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

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

_CHANNELS: tuple[Channel, ...] = ("data", "status", "control", "frames")
_MOST_EVENTS = 64  # of one socket at once: a flood of failing clients must not hold up the others
_FAILED = zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
_DENIAL_SPAN_S, _MOST_DENIALS = 10.0, 8


# Endpoints.


def own_endpoint(endpoint: str, channel: Channel) -> str:
    """resolve_endpoint() for who binds: the runtime folder is made, with mode 0700, if it is needed.

    Raises:
        SetupError: see resolve_endpoint(). EndpointError: the folder cannot be made, or belongs to another user.
    """
    if endpoint != "ipc":
        return resolve_endpoint(endpoint, channel)
    folder = runtime_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat(follow_symlinks=False)
    except OSError as error:
        raise EndpointError(f"cannot create the runtime folder {folder}: {error.strerror}") from error
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & stat.S_IWOTH:
        raise EndpointError(f"the runtime folder {folder} must be ours alone; remove it or set RUNTIME_DIRECTORY")
    return resolve_endpoint(endpoint, channel)


def is_loopback(endpoint: str) -> bool:
    """Whether a tcp endpoint stays on this machine; a name other than localhost counts as outside."""
    host = endpoint.removeprefix("tcp://").rpartition(":")[0].strip("[]")
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _free_ipc_path(path: Path) -> None:
    """Remove the file that a dead process left; ZeroMQ itself would take a live endpoint away without a word.

    Raises:
        EndpointError: a process answers there, it is no socket, or its folder is missing.
    """
    if not path.parent.is_dir():
        raise EndpointError(f"ipc://{path} needs the folder {path.parent}, which does not exist")
    if not os.path.lexists(path):
        return
    if not path.is_socket():
        raise EndpointError(f"ipc://{path} is taken by something that is no socket; choose another name")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(0.5)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
            return
        except OSError as error:
            raise EndpointError(f"ipc://{path} is in use or not ours: {error}") from error
    raise EndpointError(f"ipc://{path} is in use by a running process; stop it or choose another endpoint")


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
    """Write a new key folder, mode 0700, with its secret file of mode 0600.

    Raises:
        OutputError: there are keys already, which are never overwritten, or the folder cannot be written.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for name, text, mode in ((SECRET_FILE, pair.secret, 0o600), (PUBLIC_FILE, pair.public, 0o644)):
            with os.fdopen(os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "w") as file:
                file.write(text + "\n")
    except FileExistsError as error:
        raise OutputError(f"{folder} holds keys already; choose another folder, or move the old keys away") from error
    except OSError as error:
        raise OutputError(f"cannot write keys to {folder}: {error.strerror}; choose another folder") from error


def load_server_security(config: SecurityConfig, on_event: EventSink | None = None) -> ServerSecurity | None:
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

    Raises:
        ConfigError: as load_server_security(); or nobody is on the list.
    """

    def __init__(self, path: Path, on_event: EventSink | None = None) -> None:
        self._path, self._on_event = path, on_event
        self._lock = threading.Lock()
        self._version = _version(path)
        self._clients = load_clients(path)
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
            _report(self._on_event, "ALLOW_REFUSED", Level.ERROR, {"message": str(error)})
            return
        before, self._clients = set(self._clients.items()), clients
        added = sorted(client.name for _, client in clients.items() - before)
        removed = sorted(client.name for _, client in before - clients.items())
        if added or removed:
            _report(self._on_event, "ALLOW_CHANGED", Level.OK, {"added": added, "removed": removed})


def load_clients(path: Path) -> dict[str, Client]:
    """Clients by public key; may be none. Raises ConfigError as load_server_security()."""
    from gcd_model import FileError, decode_toml, read_small  # only now: it brings torch, and clients need none

    try:
        text, mode = read_small(path), stat.S_IMODE(path.stat().st_mode)
        if mode & stat.S_IWOTH:
            raise ConfigError(f"{path} can be written by everybody, mode {mode:04o}; run chmod o-w on it")
        entries = msgspec.convert(decode_toml(text), AllowFile).client
        for name, entry in entries.items():
            check_key(entry.key, f"{path}: the key of {name}")
    except FileError as error:
        raise ConfigError(f"cannot read the allow-list {path}: it {error}; see docs/node.md") from error
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path}: {str(error).replace('`$.', '`')}; see docs/node.md") from error
    except SetupError as error:
        raise ConfigError(str(error)) from error
    clients: dict[str, Client] = {}
    for name, entry in entries.items():
        if entry.key in clients:
            raise ConfigError(f"{path}: {name} and {clients[entry.key].name} have the same key; give each its own")
        clients[entry.key] = Client(name=name, role=entry.role)
    return clients


def _version(path: Path) -> tuple[int, int, int] | None:
    """Differs as soon as anything about the file has changed; None without one."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ctime_ns, status.st_ino, status.st_size


def _report(on_event: EventSink | None, code: str, level: Level, fields: Mapping[str, object]) -> None:
    if on_event is None:
        _LOG.warning("%s: %s", code, fields)
    else:  # who publishes it logs it
        on_event(code, level, fields)


# Sockets.


class SocketGuard:
    """Binds the sockets of one context, and answers who may connect to those that are secured.

    on_event gets AUTH_DENIED, limited so that a hostile client cannot flood with it. Close after the sockets.
    """

    def __init__(self, context: Context, security: ServerSecurity | None, on_event: EventSink | None) -> None:
        self._security, self._denials = security, _Denials(on_event)
        self._monitors: dict[Socket, Channel] = {}
        self._authenticator = None if security is None else _Authenticator(context, security, self._denials)
        if self._authenticator is not None:
            self._authenticator.start()

    def bind(self, unbound: Socket, endpoint: str, channel: Channel) -> str:
        """Bind a socket: tcp with keys if there are any, ipc for this user, and for his group if the umask lets it.

        Returns:
            The endpoint, with the port that was chosen if 0 was asked for.
        Raises:
            ConfigError: others than this machine could reach it without keys. EndpointError: in use, or impossible.
        """
        if endpoint.startswith("ipc://"):
            _free_ipc_path(Path(endpoint.removeprefix("ipc://")))
        elif self._security is not None:
            unbound.set(zmq.CURVE_SERVER, 1)
            unbound.set(zmq.CURVE_SECRETKEY, self._security.keys.secret.encode())
            unbound.set(zmq.ZAP_DOMAIN, f"gcd.{channel}".encode())
            unbound.set(zmq.ZAP_ENFORCE_DOMAIN, 1)  # without an authenticator: closed to all, not open to all
            self._monitors[unbound.get_monitor_socket(_FAILED)] = channel
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
            message = f"cannot bind {endpoint}: {error.strerror}; stop who uses it or choose another"
            raise EndpointError(message) from error
        bound = unbound.getsockopt_string(zmq.LAST_ENDPOINT)
        if bound.startswith("ipc://"):
            path = Path(bound.removeprefix("ipc://"))
            path.chmod(path.stat().st_mode & 0o770)  # whatever folder and umask say: not for everybody
        return bound

    def report_failures(self) -> None:
        """Report handshakes that failed before there was a key to judge; call it often, in the sockets' own thread."""
        for monitor, channel in self._monitors.items():
            for _ in range(_MOST_EVENTS):
                if not monitor.poll(0):
                    break
                if int(parse_monitor_message(monitor.recv_multipart())["event"]) & _FAILED:
                    self._denials.add(None, f"gcd.{channel}", "")

    @property
    def monitors(self) -> list[Socket]:
        """Readable once there is something for report_failures()."""
        return list(self._monitors)

    @property
    def alive(self) -> bool:
        """Whether clients are let in: False once the authenticator's thread has died."""
        return self._authenticator is None or self._authenticator.is_alive()

    def close(self) -> None:
        """Stop; a second call does nothing."""
        for monitor in self._monitors:
            monitor.close(0)
        self._monitors.clear()
        if self._authenticator is not None:
            self._authenticator.close()


class _Authenticator(ThreadAuthenticator):
    """Lets clients of the allow-list in; their messages carry the public key as `User-Id`."""

    def __init__(self, context: Context, security: ServerSecurity, denials: "_Denials") -> None:
        super().__init__(context)
        self._find_client, self._denials, self._address = security.find_client, denials, ""
        for channel in _CHANNELS:  # exactly these: a provider for "*" does not apply to a socket with a domain
            self.configure_curve_callback(f"gcd.{channel}", self)

    def callback(self, domain: str, key: bytes) -> bool:
        """Whether a key may connect: it is on the allow-list, to push frames as an operator's; called by zmq.auth."""
        client = self._find_client(key.decode())
        if client is not None and (client.role == "operator" or domain != "gcd.frames"):
            return True
        self._denials.add(key.decode(), domain, self._address)
        return False

    async def handle_zap_message(self, msg: list[bytes]) -> None:
        self._address = msg[3].decode("ascii", "backslashreplace")[:64] if len(msg) > 3 else ""
        await super().handle_zap_message(msg)

    def close(self) -> None:
        """Stop; a second call does nothing."""
        if self.pipe and not self.is_alive():  # stop() would wait for ever for a thread that has died
            self.pipe.close(0)
            self.pipe = None  # pyright: ignore[reportAttributeAccessIssue]  as pyzmq itself does
        self.stop()


class _Denials:
    """AUTH_DENIED events, limited: one for each key and socket in 10 s, and at most 8 in all in that time."""

    def __init__(self, on_event: EventSink | None) -> None:
        self._on_event, self._lock = on_event, threading.Lock()
        self._reported_s: dict[tuple[str | None, str], float] = {}
        self._suppressed = 0

    def add(self, key: str | None, domain: str, address: str) -> None:
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
        _report(self._on_event, "AUTH_DENIED", Level.WARN, {**who, "suppressed": suppressed})
