"""Endpoints that the node binds: the runtime folder, stale ipc files, and who could reach a tcp port."""

import ipaddress
import os
import socket
import stat
from pathlib import Path

from gcd_client.endpoints import Channel, resolve_endpoint, runtime_folder
from gcd_node.errors import ConfigError, EndpointError


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


def own_endpoint(endpoint: str, channel: Channel) -> str:
    """resolve_endpoint() for who binds: the runtime folder is made if it is needed.

    Raises:
        SetupError, EndpointError: as resolve_endpoint() and make_runtime_folder().
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
