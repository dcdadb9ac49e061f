"""Who may connect with which role: the allow-list of a launch file (TOML).

[client.desk]
key = "40 characters, as `gcd-node keys show` prints"
role = "operator"
"""

import stat
from pathlib import Path
from typing import Annotated, TypeAlias

import msgspec
from msgspec import Meta

from gcd_node.config import SecurityConfig
from gcd_node.errors import ConfigError
from gcd_node.security.gate import ServerSecurity, check_pair
from gcd_node.security.keys import Client, Role, check_key, read_key_pair

ClientName: TypeAlias = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,32}$(?!\n)")]


class AllowedClient(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """key: the client's public key. role: "viewer" may look, "operator" may also command."""

    key: str
    role: Role = "viewer"


class AllowList(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole allow-list; at least one client, by name."""

    client: Annotated[dict[ClientName, AllowedClient], Meta(min_length=1)]


def load_server_security(config: SecurityConfig) -> ServerSecurity | None:
    """Keys and clients of a launch file; None if it states neither.

    Raises:
        ConfigError: files missing, readable or writable by others, damaged; a key that two clients share.
    """
    if config.keys is None or config.allow is None:
        return None
    pair = read_key_pair(Path(config.keys))
    check_pair(pair)
    return ServerSecurity(keys=pair, clients=load_clients(Path(config.allow)))


def load_clients(path: Path) -> dict[str, Client]:
    """Clients by public key. Raises ConfigError as load_server_security()."""
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
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from error
