"""Which OAK is meant, of those there are."""

import ipaddress
from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

from gcd_node.errors import SourceAbsentError


class Listed(Protocol):
    """A device as DepthAI lists it. deviceId: its serial number. name: its address or USB port."""

    deviceId: str  # noqa: N815 - DepthAI's own name for it
    name: str


Device = TypeVar("Device", bound=Listed)


def find_device(
    wanted: str | None, available: Callable[[], Sequence[Device]], connected: Callable[[], Sequence[Device]]
) -> Device | None:
    """The one camera that is meant.

    Args:
        wanted: id, name or address; None if there is just one.
        available: lists the devices that can be opened. connected: lists those in use too; asked for messages only.
    Returns:
        None for an address that the search, which ends at routers, has not found: try it.
    Raises:
        SourceAbsentError: none, or several; the message lists what there is.
    """
    free = available()
    matching = [each for each in free if wanted is None or wanted in (each.deviceId, each.name)]
    if len(matching) == 1:
        return matching[0]
    if len(matching) > 1:
        raise SourceAbsentError(
            f"wanted one OAK camera, found {', '.join(map(_named, free))}; say which with device in [source]"
        )
    if wanted is not None and _is_address(wanted):
        return None
    raise SourceAbsentError(
        f"wanted {'an OAK camera' if wanted is None else f'OAK {wanted}'}, found {_list(free, connected())}; "
        "plug it in, or correct device in [source]; on Linux its udev rule must be there too"
    )


def _list(free: Sequence[Listed], connected: Sequence[Listed]) -> str:
    ids = {each.deviceId for each in free}
    busy = [f"{_named(each)} in use by another process" for each in connected if each.deviceId not in ids]
    return ", ".join([*map(_named, free), *busy]) or "none"


def _named(device: Listed) -> str:
    return f"{device.deviceId} (at {device.name})"


def _is_address(text: str) -> bool:
    try:
        ipaddress.IPv4Address(text)
    except ValueError:
        return False
    return True
