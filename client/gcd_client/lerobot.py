"""A LeRobot camera that shows a view of a node, such as the picture of the camera that a policy was trained with.

    cameras = {"front": GcdCameraConfig(view="policy", width=224, height=224, fps=10)}   # not OpenCVCameraConfig(...)

A robot of LeRobot needs all three. Importing this registers the camera as type "gcd": on LeRobot's command lines with
--robot.discover_packages_path=gcd_client. Needs the package lerobot (0.4.4 was tried).
"""

import logging
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.cameras import Camera, CameraConfig, ColorMode  # pyright: ignore[reportMissingImports]
from lerobot.utils.errors import (  # pyright: ignore[reportMissingImports]
    DeviceAlreadyConnectedError,
    DeviceNotConnectedError,
)
from numpy.typing import NDArray

from gcd_client.endpoints import ClientKeys, read_key_pair, read_public_key
from gcd_client.protocol import ClientError
from gcd_client.subscriber import ReceivedView, StatusSubscriber, ViewSubscriber

_LOG = logging.getLogger(__name__)
_JOIN_S = 2.0
_FIND_MS = 1500.0  # the node repeats what it is made of to whoever subscribes


@CameraConfig.register_subclass("gcd")  # pyright: ignore[reportUntypedClassDecorator]
@dataclass(kw_only=True)
class GcdCameraConfig(CameraConfig):  # pyright: ignore[reportUntypedBaseClass]
    """view: the view's id. endpoint: of the node's views. timeout_ms: until the first view, and of each `read`.

    width, height: left out, the view's; others are an error. fps: for LeRobot alone. keys, node_key: folder of this
    client's key pair and file of the node's public key, for a node that asks for them.
    """

    view: str
    endpoint: str = "ipc"
    timeout_ms: float = 5000.0
    color_mode: ColorMode = ColorMode.RGB
    keys: str | None = None
    node_key: str | None = None

    def __post_init__(self) -> None:
        self.color_mode = ColorMode(self.color_mode)
        if self.timeout_ms <= 0 or (self.keys is None) != (self.node_key is None):
            raise ValueError("timeout_ms must be positive, and keys go with node_key")


class GcdCamera(Camera):  # pyright: ignore[reportUntypedBaseClass]
    """Pictures u8 [H, W, 3]. A view that the node no longer vouches for (`valid_for_ms`) is never given: it is waited
    for a newer one, until TimeoutError. Nor is one of another size: RuntimeError. A thread receives; `read` and its
    kind may be called from any."""

    def __init__(self, config: GcdCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        self._changed, self._stop = threading.Condition(), threading.Event()
        self._thread: threading.Thread | None = None
        self._newest: ReceivedView | None = None
        self._is_new = self._was_moved = False
        self._error: ClientError | None = None

    def __str__(self) -> str:
        return f"GcdCamera({self.config.view} at {self.config.endpoint})"

    @property
    def is_connected(self) -> bool:
        """Between `connect` and `disconnect`."""
        return self._thread is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """The views of the node on this machine; none without one."""
        status = StatusSubscriber(topics=("meta",))
        try:
            message = status.receive(_FIND_MS)
        finally:
            status.close()
        views = [] if message is None else message.fields["views"]
        return [{"name": f"view {each} of a gcd-node", "type": "gcd", "id": each} for each in views]

    def connect(self, warmup: bool = True) -> None:
        """Subscribe. warmup: wait for the first view; without it `width` and `height` must be stated.

        Raises: ConnectionError: there is no view, or the node does not let this client in; RuntimeError: the view has
            another size than was stated; ClientError: no such endpoint, view id or key.
        """
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is connected already")
        config = self.config
        keys = None
        if config.keys is not None and config.node_key is not None:
            own, server = read_key_pair(Path(config.keys).expanduser()), read_public_key(config.node_key)
            keys = ClientKeys(own=own, server=server)
        views = ViewSubscriber(config.endpoint, config.view, "frm", keys=keys)
        self._newest, self._error, self._is_new, self._was_moved = None, None, False, False
        self.width, self.height = config.width, config.height
        self._stop.clear()
        self._thread = threading.Thread(target=self._receive, args=(views,), name=str(self), daemon=True)
        self._thread.start()
        if not warmup and self.width is not None and self.height is not None:
            return
        try:
            self.height, self.width = self.read().shape[:2]
        except TimeoutError as error:
            self.disconnect()
            raise ConnectionError(f"{error}; is the node active, and is there such a view? gcd-node status") from error
        except BaseException:
            self.disconnect()
            raise

    def read(self) -> NDArray[Any]:
        """The next view that comes. Raises TimeoutError after `timeout_ms`, ConnectionError, RuntimeError."""
        with self._changed:
            self._is_new = False
        return self.async_read(self.config.timeout_ms)

    def async_read(self, timeout_ms: float = 200.0) -> NDArray[Any]:
        """The newest view, unless it was given before: then the next. Raises as `read`."""
        with self._changed:
            fresh = lambda: self._error is not None or (self._is_new and self._is_valid())  # noqa: E731
            done = self.is_connected and self._changed.wait_for(fresh, timeout_ms / 1000)
            view = self._taken()
            if not done or view is None:
                raise TimeoutError(f"{self}: no fresh view in {timeout_ms:g} ms")
            self._is_new = False
        return self._picture(view)

    def read_latest(self, max_age_ms: int = 500) -> NDArray[Any]:
        """The newest view, given before or not. Raises TimeoutError: its input is older, or it no longer holds;
        RuntimeError: there was none yet, or it has another size; ConnectionError."""
        with self._changed:
            view = self._taken()
            if view is None:
                raise RuntimeError(f"{self}: there was no view yet")
            age_ms = view.header.age_ms + _since_ms(view)
            if age_ms > max_age_ms or not self._is_valid():
                raise TimeoutError(f"{self}: the newest view is {age_ms:.0f} ms old")
        return self._picture(view)

    def disconnect(self) -> None:
        """Unsubscribe."""
        thread, self._thread = self._thread, None
        if thread is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        self._stop.set()
        thread.join(_JOIN_S)

    def _receive(self, views: ViewSubscriber) -> None:
        try:
            while not self._stop.is_set():  # a stream that ended may begin again
                views.run(self._keep, self._stop)
        except ClientError as error:
            with self._changed:
                self._error = error
                self._changed.notify_all()
        finally:
            views.close()

    def _keep(self, view: ReceivedView) -> None:
        with self._changed:
            self._newest, self._is_new = view, True
            self._changed.notify_all()
        is_moved = "moved" in view.header.quality.ood
        if is_moved and not self._was_moved:
            _LOG.warning("%s: the camera has moved; `gcd-node ctl align_view view=%s`", self, self.config.view)
        self._was_moved = is_moved

    def _taken(self) -> ReceivedView | None:
        """With the lock held."""
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected")
        if self._error is not None:
            raise ConnectionError(f"{self}: {self._error}") from self._error
        return self._newest

    def _is_valid(self) -> bool:
        return self._newest is not None and _since_ms(self._newest) <= self._newest.header.valid_for_ms

    def _picture(self, view: ReceivedView) -> NDArray[Any]:
        picture = view.images[0]
        height, width = picture.shape[:2]
        if (self.width or width, self.height or height) != (width, height):
            raise RuntimeError(f"{self} gives {width} x {height}, not {self.width} x {self.height}: see [view.*] size")
        return np.array(picture if self.config.color_mode == ColorMode.RGB else picture[..., ::-1])


def _since_ms(view: ReceivedView) -> float:
    return max(0.0, (time.time_ns() - view.header.t_publish_ns) / 1e6)
