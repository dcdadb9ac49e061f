"""What an OAK is, without DepthAI: which one is meant, its lens, why its stream is gone."""

import ipaddress
import logging
import threading
from collections.abc import Callable, Sequence
from typing import Protocol, TypeAlias, TypeVar

from gcd_node.calibration import Distortion, LensModel
from gcd_node.errors import ConfigError, SourceAbsentError, SourceLostError

_LOG = logging.getLogger(__name__)
_LENSES_DIFFER = 0.02
_RATIONAL_FULL, _RATIONAL, _FISHEYE = 14, 8, 4

Body: TypeAlias = Callable[[], None]
Guard: TypeAlias = Callable[[Body], Body]
"""Makes a function safe to run on a thread of DepthAI's: what it raises ends the stream with a SourceLostError that
says so, instead of ending the process."""


class DeviceState(Protocol):
    """A state of a device as DepthAI names it: RUNNING, DISCONNECTED, RECONNECTING or FAILED."""

    @property
    def name(self) -> str:
        """In capitals."""
        ...


class Loss:
    """The reason a stream is gone, as any thread tells it. The first reason stays."""

    def __init__(self, name: str = "camera") -> None:
        """Nothing is lost yet. name: of the device, for messages; may be set once it is known."""
        self.name = name
        self._lock = threading.Lock()
        self._told = threading.Event()
        self._reason = ""

    def tell(self, reason: str) -> None:
        """The stream is gone, because of this."""
        with self._lock:
            self._reason = self._reason or reason
        self._told.set()

    def wait(self, timeout_s: float) -> bool:
        """Give other threads a moment to tell; whether one has."""
        return self._told.wait(timeout_s)

    @property
    def told(self) -> bool:
        """Whether the stream is gone."""
        return self._told.is_set()

    def error(self) -> SourceLostError:
        """The reason as an error."""
        return SourceLostError(
            f"OAK {self.name} is lost: {self._reason}; check its cable and power, then open it again"
        )

    def guard(self, body: Body) -> Body:
        """See Guard."""

        def guarded() -> None:
            try:
                body()
            except BaseException as error:  # of any kind: one level up it would end the process
                self.tell(f"a node of its pipeline failed with {type(error).__name__}: {error}")

        return guarded

    def on_state(self, _: object, state: DeviceState) -> None:
        """For DepthAI's state callback: what does not run is lost; to reconnect is the node's affair."""
        if state.name != "RUNNING":
            self.tell(f"device {state.name.lower()}")


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


def to_lens(
    matrix: Sequence[Sequence[float]], coefficients: Sequence[float], model: str, size: tuple[int, int]
) -> LensModel | None:
    """A lens as DepthAI describes it.

    Args:
        matrix: 3 x 3 intrinsics, pixels.
        coefficients: 14 of OpenCV's rational model with prism and tilt, or 4 of its fisheye model; 0 is no distortion.
        model: DepthAI's name of it, "Perspective" or "Fisheye".
        size: width and height the matrix is for.
    Returns:
        None, and says so in the log, for another model or numbers that no camera has.
    """
    if (known := _distortion(model, coefficients)) is None:
        _LOG.warning("an OAK's lens is of model %s, which is not known here; it counts as uncalibrated", model)
        return None
    (fx, _, cx), (_, fy, cy), _ = matrix
    width, height = size
    try:
        return LensModel(
            width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, distortion=known[0], coefficients=known[1]
        )
    except ConfigError as error:
        _LOG.warning("an OAK's calibration makes no sense, it counts as uncalibrated: %s", error)
        return None


def _distortion(model: str, coefficients: Sequence[float]) -> tuple[Distortion, tuple[float, ...]] | None:
    """Our name of a model, and as many coefficients as it has; DepthAI pads them with zeros, or leaves zeros out."""
    if model not in ("Perspective", "Fisheye"):
        return None
    if not any(coefficients):
        return "none", ()
    full = (*coefficients, *[0.0] * _RATIONAL_FULL)[:_RATIONAL_FULL]
    if model == "Fisheye":
        return "equidistant", full[:_FISHEYE]
    return "rational_polynomial", full if any(full[_RATIONAL:]) else full[:_RATIONAL]


def better_lens(own: LensModel | None, stored: LensModel | None) -> LensModel | None:
    """What a picture itself says, which knows what the sensor's mode cuts off; else what the memory says."""
    if own is None:
        return stored
    if stored is not None and abs(own.fx / stored.fx - 1) > _LENSES_DIFFER:
        _LOG.warning(
            "the OAK's focal length is %.1f pixels by its pictures, %.1f by its memory: the sensor's mode cuts edges "
            "off; the former is used",
            own.fx,
            stored.fx,
        )
    return own
