"""Where the sockets live: the runtime folder and endpoint names (wire protocol, section 1).

Standard library only, Python 3.10 syntax: planners import this.
"""

import ipaddress
import os
import socket
import stat
from pathlib import Path
from typing import Literal, TypeAlias

from gcd_node.errors import ConfigError, EndpointError

Channel: TypeAlias = Literal["data", "status", "control"]

_EXAMPLES = '"ipc", "ipc:///some/path" or "tcp://127.0.0.1:5580"'


def runtime_folder() -> Path:
    """$RUNTIME_DIRECTORY, else $XDG_RUNTIME_DIR/gcd, else /tmp/gcd-$UID. Not created here."""
    if given := os.environ.get("RUNTIME_DIRECTORY"):
        return Path(given.split(":")[0])  # systemd lists several, the first is the unit's own
    if session := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(session) / "gcd"
    return Path(f"/tmp/gcd-{os.getuid()}")  # noqa: S108  make_runtime_folder() checks who owns it


def make_runtime_folder() -> Path:
    """The runtime folder, created with mode 0700 if missing.

    Raises:
        EndpointError: it cannot be created, or belongs to somebody else.
    """
    folder = runtime_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.stat(follow_symlinks=False)
    except OSError as error:
        raise EndpointError(f"cannot create the runtime folder {folder}: {error.strerror}") from error
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & stat.S_IWOTH:
        raise EndpointError(f"the runtime folder {folder} must be ours alone; remove it or set RUNTIME_DIRECTORY")
    return folder


def resolve_endpoint(endpoint: str, channel: Channel) -> str:
    """An endpoint as ZeroMQ takes it: "ipc" becomes the channel's file in the runtime folder.

    Raises:
        ConfigError: neither ipc nor tcp.
    """
    if endpoint == "ipc":
        return f"ipc://{runtime_folder()}/{channel}"
    if endpoint.startswith("ipc://") and len(endpoint) > len("ipc://"):
        return endpoint
    if endpoint.startswith("tcp://") and endpoint.rpartition(":")[2].isdecimal():
        return endpoint
    raise ConfigError(f"an endpoint is {_EXAMPLES}, got {endpoint!r}")


def own_endpoint(endpoint: str, channel: Channel) -> str:
    """resolve_endpoint() for who binds: the runtime folder is made if it is needed.

    Raises:
        ConfigError, EndpointError: as resolve_endpoint() and make_runtime_folder().
    """
    if endpoint == "ipc":
        make_runtime_folder()
    return resolve_endpoint(endpoint, channel)


def check_bindable(endpoint: str, *, secured: bool = False) -> None:
    """Refuse a resolved endpoint that others could reach: without keys, only this machine may connect.

    secured: the socket asks for CURVE keys and has a list of allowed clients.

    Raises:
        ConfigError: tcp beyond loopback, not secured.
    """
    if secured or endpoint.startswith("ipc://") or is_loopback(endpoint):
        return
    raise ConfigError(
        f"{endpoint} can be reached from other machines, which needs CURVE keys and a list of allowed clients: state "
        "both [security] keys and [security] allow, see `gcd-node keys`; or bind tcp://127.0.0.1:PORT, or ipc"
    )


def is_loopback(endpoint: str) -> bool:
    """Whether a tcp endpoint stays on this machine; a name other than localhost counts as outside."""
    host = endpoint.removeprefix("tcp://").rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_ipv6(endpoint: str) -> bool:
    """Whether the endpoint's host is an IPv6 address in brackets."""
    return endpoint.startswith("tcp://[")


def free_ipc_path(path: Path) -> None:
    """Make way for a new ipc endpoint: a file that a dead process left is removed, a live one is not.

    Raises:
        EndpointError: somebody answers there, it is no socket, or its folder is missing.
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
