"""Where a node's sockets are and how a client reaches them: endpoints, CURVE keys, and why a connection is refused."""

import hashlib
import os
import re
import sys
import time
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar

import zmq

from gcd_client.protocol import ClientError

Channel: TypeAlias = Literal["data", "status", "control", "frames"]
Result = TypeVar("Result")
Own = TypeVar("Own", bound="Client")
Steps: TypeAlias = Generator[int | None, list[tuple[Any, int]], Result]
"""Yields how long to poll, milliseconds or None, is sent what was ready, and returns its result."""

PUBLIC_FILE, SECRET_FILE = "public.key", "secret.key"
_Z85 = re.compile(r"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")
_REFUSED = zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
_DRAIN_S = 0.1  # how long after its deadline a call may still throw messages away


class SetupError(ClientError):
    """An endpoint, a key or an option of ours is wrong, or a library is missing."""

    exit_code = 78


class AuthError(ClientError):
    """The node refuses the connection: it asks for a key, or does not know ours."""

    exit_code = 77


@dataclass(frozen=True, kw_only=True)
class KeyPair:
    """Both halves of a CURVE key, 40 characters (Z85) each. The secret one shows in no repr. Raises SetupError."""

    public: str
    secret: str = field(repr=False)

    def __post_init__(self) -> None:
        check_key(self.public, "the public key")
        if not _Z85.fullmatch(self.secret):  # never shown, not even in an error
            raise SetupError(f"the secret key must be 40 Z85 characters, got {len(self.secret)} characters")
        if zmq.curve_public(self.secret.encode()) != self.public.encode():
            raise SetupError(f"{PUBLIC_FILE} and {SECRET_FILE} do not belong together; make new ones")


@dataclass(frozen=True, kw_only=True)
class ClientKeys:
    """For a node that asks for keys: our own pair, and the node's public key. Raises SetupError."""

    own: KeyPair
    server: str

    def __post_init__(self) -> None:
        check_key(self.server, "the node's public key")


def check_key(text: str, name: str) -> None:
    """Raises SetupError unless the text is a CURVE key in Z85."""
    if not _Z85.fullmatch(text):
        raise SetupError(f"{name} must be 40 Z85 characters as `gcd-node keys show` prints, got {ascii(text)[:48]}")


def fingerprint(public: str) -> str:
    """A public key's name in logs: the first 16 hex digits of the SHA-256 of its Z85 text."""
    return hashlib.sha256(public.encode()).hexdigest()[:16]


def read_key_pair(folder: Path) -> KeyPair:
    """Read a key folder. Raises SetupError: no key in a file, or others than its owner may read the secret."""
    path, public = folder / SECRET_FILE, folder / PUBLIC_FILE
    secret, text = _read_key(path), _read_key(public)
    if os.name == "posix" and path.stat().st_mode & 0o077:
        raise SetupError(f"{path} must be readable by its owner alone; run chmod 600 on it")
    check_key(text, f"the key in {public}")
    return KeyPair(public=text, secret=secret)


def read_public_key(text: str) -> str:
    """A public key given as itself, as its file, or as a key folder. Raises SetupError."""
    if not _Z85.fullmatch(text):
        path = Path(text) / PUBLIC_FILE if Path(text).is_dir() else Path(text)
        check_key(text := _read_key(path), f"the key in {path}")
    return text


def runtime_folder() -> Path:
    """$RUNTIME_DIRECTORY, else $XDG_RUNTIME_DIR/gcd, else /tmp/gcd-$UID. Not created here."""
    if folders := os.environ.get("RUNTIME_DIRECTORY"):
        return Path(folders.split(":")[0])  # systemd lists several, the first is the unit's own
    if session := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(session) / "gcd"
    if sys.platform == "win32":
        raise SetupError("Windows has no ipc endpoints; state tcp://HOST:PORT")
    return Path(f"/tmp/gcd-{os.getuid()}")  # noqa: S108  who binds there checks its owner


def resolve_endpoint(endpoint: str, channel: Channel) -> str:
    """An endpoint as ZeroMQ takes it: "ipc" becomes the channel's file in the runtime folder. Raises SetupError."""
    if endpoint == "ipc":
        return f"ipc://{runtime_folder()}/{channel}"
    if (match := re.fullmatch(r"ipc://.+|tcp://.*:([0-9]{1,5})", endpoint)) and int(match[1] or 0) < 65536:
        return endpoint
    raise SetupError(f'an endpoint is "ipc", "ipc:///a/path" or "tcp://127.0.0.1:5580" (to 65535), got {endpoint!r}')


class Connection:
    """A client's socket and its monitor: ZeroMQ says nothing of a refused handshake, and tries no more."""

    def __init__(self, endpoint: str, kind: int, keys: ClientKeys | None, options: Mapping[int, int]) -> None:
        self.endpoint, self._keys, self._events = endpoint, keys, 0
        self._context = zmq.Context()
        self.socket = self._context.socket(kind)
        for option, value in {zmq.LINGER: 0, zmq.IPV6: int(endpoint.startswith("tcp://[")), **options}.items():
            self.socket.set(option, value)
        if keys is not None:
            self.socket.set(zmq.CURVE_SERVERKEY, keys.server.encode())
            self.socket.set(zmq.CURVE_PUBLICKEY, keys.own.public.encode())
            self.socket.set(zmq.CURVE_SECRETKEY, keys.own.secret.encode())
        self._monitor = self.socket.get_monitor_socket(_REFUSED)
        try:
            self.socket.connect(endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise SetupError(f"cannot connect to {endpoint}: {error.strerror}") from error

    def wait(self, deadline_s: float | None) -> Steps[bool]:
        """Whether a message comes before the deadline (monotonic). Raises AuthError."""
        while deadline_s is None or time.monotonic() < deadline_s + _DRAIN_S:
            self.check()
            left_ms = None if deadline_s is None else max(0, round(1000 * (deadline_s - time.monotonic())))
            ready = [each for each, _ in (yield left_ms)]
            if self.socket in ready or not ready:
                return bool(ready)
        return False

    def check(self, wait_ms: int = 0) -> None:
        """Raises AuthError if the connection was refused, now or before, or within wait_ms."""
        while self._monitor.poll(0 if self._events else wait_ms):
            self._events |= int.from_bytes(self._monitor.recv_multipart()[0][:2], sys.byteorder)
        if not self._events:
            return
        reason = "it uses no keys here; leave ours out"
        if self._keys is None:
            reason = "it asks for keys, none were given; make some with `gcd-node keys new` and have them allowed there"
        elif self._events & zmq.EVENT_HANDSHAKE_FAILED_AUTH:
            reason = f"our key, fingerprint {fingerprint(self._keys.own.public)}, is not on its list"
        raise AuthError(f"{self.endpoint} does not let us in: {reason}")

    def run(self, steps: Steps[Result]) -> Result:
        """Take the steps, waiting here."""
        poller, ready = self._registered(zmq.Poller()), None
        try:
            while True:
                ready = poller.poll(steps.send(ready))  # pyright: ignore[reportArgumentType]  begins with None
        except StopIteration as end:
            return end.value

    async def run_async(self, steps: Steps[Result]) -> Result:
        """Take the steps while other tasks run."""
        import zmq.asyncio  # loads asyncio, which others do without

        poller, ready = self._registered(zmq.asyncio.Poller()), None
        try:
            while True:
                ready = await poller.poll(steps.send(ready))  # pyright: ignore[reportArgumentType]
        except StopIteration as end:
            return end.value

    def close(self) -> None:
        """A second call does nothing."""
        self._context.destroy(linger=0)

    def _registered(self, poller: Any) -> Any:
        for each in (self.socket, self._monitor):
            poller.register(each, zmq.POLLIN)
        return poller


class Client:
    """What owns a connection. Use it as a context manager."""

    _connection: Connection

    def close(self) -> None:
        """Close the socket; a second call does nothing."""
        self._connection.close()

    def __enter__(self: Own) -> Own:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _read_key(path: Path) -> str:
    try:
        if path.stat().st_size > 256 or not path.is_file():  # a pipe would be waited for
            raise ValueError("not a text file")
        return path.read_text(encoding="ascii").strip()
    except (OSError, ValueError) as error:
        raise SetupError(f"cannot read the key {path}: {error.args[-1]}; run `gcd-node keys new FOLDER`") from error
