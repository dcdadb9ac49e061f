"""How a run is asked to stop."""

from typing import Protocol


class StopSignal(Protocol):
    """Whatever can be asked to stop: a threading.Event."""

    def is_set(self) -> bool:
        """True once the work should stop."""
        ...
