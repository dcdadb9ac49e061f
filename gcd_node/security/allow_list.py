"""Who may connect with which role: the allow-list of a launch file (TOML).

[client.desk]
key = "40 characters, as `gcd-node keys show` prints"
role = "operator"
"""

import logging
import stat
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, TypeAlias

import msgspec
from msgspec import Meta

from gcd_node.config import SecurityConfig
from gcd_node.errors import ConfigError
from gcd_node.security.gate import EventSink, ServerSecurity, check_pair
from gcd_node.security.keys import Client, Role, check_key, read_key_pair

_LOG = logging.getLogger(__name__)
_LOOK_S = 0.5

ClientName: TypeAlias = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,32}$(?!\n)")]


class AllowedClient(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """key: the client's public key. role: "viewer" may look, "operator" may also command."""

    key: str
    role: Role = "viewer"


class AllowList(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole allow-list, by name; to let nobody in any more, leave an empty [client]."""

    client: dict[ClientName, AllowedClient]


def load_server_security(config: SecurityConfig, on_event: EventSink | None = None) -> ServerSecurity | None:
    """Keys and clients of a launch file; None if it states neither. on_event: told of later changes of the list, see
    WatchedList.

    Raises:
        ConfigError: files missing, readable or writable by others, damaged; a key that two clients share.
    """
    if config.keys is None or config.allow is None:
        return None
    pair = read_key_pair(Path(config.keys))
    check_pair(pair)
    watched = WatchedList(Path(config.allow), on_event)
    return ServerSecurity(keys=pair, clients=watched.clients, refresh=watched.refresh)


class WatchedList:
    """A list of clients that may be edited while the node runs. `refresh` may be called from any thread.

    A change counts once the file has stayed the same for half a second, so that nothing is read that is only half
    written. on_event gets ALLOW_CHANGED with the names that were `added` and `removed`, one whose key or role is
    another being in both; or ALLOW_REFUSED with a `message`, and the list stays as it was.

    Raises:
        ConfigError: as load_server_security().
    """

    def __init__(
        self, path: Path, on_event: EventSink | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """clock: monotonic seconds."""
        self._path, self._on_event, self._clock = path, on_event, clock
        self._seen = self._pending = self._state()
        self.clients: Mapping[str, Client] = load_clients(path)
        if not self.clients:
            raise ConfigError(f"{path} names no client, so nobody could connect; add one, see docs/control.md")
        self._look_s = clock() + _LOOK_S
        self._lock = threading.Lock()

    def refresh(self) -> Mapping[str, Client]:
        """The clients now; the same object as long as they have not changed."""
        with self._lock:
            now_s = self._clock()
            if now_s >= self._look_s:
                self._look_s = now_s + _LOOK_S
                self._look()
            return self.clients

    def _look(self) -> None:
        state, was = self._state(), self._pending
        self._pending = state
        if state == self._seen or state != was:
            return
        self._seen = state
        try:
            before, self.clients = self.clients, load_clients(self._path)
        except ConfigError as error:
            _LOG.error("ALLOW_REFUSED: the list of clients stays as it was: %s", error)
            self._tell("ALLOW_REFUSED", {"level": 2, "message": str(error)})
            return
        added, removed = _names(self.clients, before), _names(before, self.clients)
        _LOG.warning("ALLOW_CHANGED: added %s; removed %s", ", ".join(added) or "none", ", ".join(removed) or "none")
        self._tell("ALLOW_CHANGED", {"level": 0, "added": added, "removed": removed})

    def _state(self) -> tuple[int, int, int] | None:
        """Differs as soon as anything about the file has changed; None without one."""
        try:
            found = self._path.stat()
        except OSError:
            return None
        return found.st_ctime_ns, found.st_ino, found.st_size

    def _tell(self, code: str, fields: dict[str, object]) -> None:
        if self._on_event is not None:
            self._on_event(code, fields)


def _names(clients: Mapping[str, Client], others: Mapping[str, Client]) -> list[str]:
    """Of those that are not the same among the others."""
    return sorted(client.name for key, client in clients.items() if others.get(key) != client)


def load_clients(path: Path) -> dict[str, Client]:
    """Clients by public key; may be none. Raises ConfigError as load_server_security()."""
    clients: dict[str, Client] = {}
    for name, entry in _read(path).client.items():
        check_key(entry.key, f"{path}: the key of {name}")
        if entry.key in clients:
            raise ConfigError(f"{path}: {name} and {clients[entry.key].name} have the same key; give each its own")
        clients[entry.key] = Client(name=name, role=entry.role)
    return clients


def _read(path: Path) -> AllowList:
    try:
        text = path.read_bytes()
        mode = stat.S_IMODE(path.stat().st_mode)
    except OSError as error:
        raise ConfigError(f"cannot read the list of clients {path}: {error.strerror}; see docs/control.md") from error
    if mode & stat.S_IWOTH:
        raise ConfigError(f"{path} can be written by everybody, mode {mode:04o}; run chmod o-w on it")
    try:
        return msgspec.toml.decode(text, type=AllowList)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path}: {str(error).replace('`$.', '`')}; see docs/control.md") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from error
