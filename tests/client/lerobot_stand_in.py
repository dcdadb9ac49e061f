"""LeRobot as far as gcd_client.lerobot knows it, where it is not installed: its abstract camera, as of 0.4.4."""

import abc
import sys
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from types import ModuleType
from typing import Any, ClassVar


class ColorMode(StrEnum):
    RGB = "rgb"
    BGR = "bgr"


@dataclass(kw_only=True)
class CameraConfig:
    fps: int | None = None
    width: int | None = None
    height: int | None = None
    known: ClassVar[dict[str, type]] = {}

    @classmethod
    def register_subclass(cls, name: str) -> Callable[[type], type]:
        return lambda config: cls.known.setdefault(name, config)

    @property
    def type(self) -> str:
        return next(name for name, config in self.known.items() if config is self.__class__)


class Camera(abc.ABC):
    def __init__(self, config: CameraConfig) -> None:
        self.fps, self.width, self.height = config.fps, config.width, config.height

    def __enter__(self) -> "Camera":
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.disconnect()

    @property
    @abc.abstractmethod
    def is_connected(self) -> bool: ...

    @staticmethod
    @abc.abstractmethod
    def find_cameras() -> list[dict[str, Any]]: ...

    @abc.abstractmethod
    def connect(self, warmup: bool = True) -> None: ...

    @abc.abstractmethod
    def read(self) -> Any: ...

    @abc.abstractmethod
    def async_read(self, timeout_ms: float = ...) -> Any: ...

    @abc.abstractmethod
    def disconnect(self) -> None: ...


def stand_in() -> None:
    """Put it where lerobot would be."""
    for name in ("lerobot", "lerobot.cameras", "lerobot.utils", "lerobot.utils.errors"):
        sys.modules[name] = ModuleType(name)
    for kind in (Camera, CameraConfig, ColorMode):
        setattr(sys.modules["lerobot.cameras"], kind.__name__, kind)
    for name in ("DeviceNotConnectedError", "DeviceAlreadyConnectedError"):
        setattr(sys.modules["lerobot.utils.errors"], name, type(name, (ConnectionError,), {}))
