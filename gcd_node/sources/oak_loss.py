"""Why an OAK stream is gone, and how Python code survives on DepthAI's threads."""

import threading
from collections.abc import Callable
from typing import Protocol, TypeAlias

from gcd_node.errors import SourceLostError

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
