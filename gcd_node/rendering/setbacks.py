"""What becomes of a model whose windows fail: less is asked of a full device, and three bad windows are enough."""

import logging
from collections.abc import Mapping

from gcd_model import DeviceMemoryError
from gcd_node.errors import ModelFailedError
from gcd_node.health.announcer import Announcer
from gcd_node.health.monitor import Health
from gcd_node.health.report import Level
from gcd_node.rendering.degrade import WHOLE, Ladder, Rung

_LOG = logging.getLogger(__name__)
_BAD_WINDOWS_IN_A_ROW = 3


class Setbacks:
    """Counts what went wrong, tells it, and says when to give up. Belongs to the model thread."""

    def __init__(self, health: Health, announcer: Announcer) -> None:
        self._health, self._announcer = health, announcer
        self._ladder: Ladder | None = None
        self._bad_in_a_row = 0

    @property
    def rung(self) -> Rung:
        """How much to ask of the device."""
        return WHOLE if self._ladder is None else self._ladder.rung

    def none(self) -> None:
        """A window came out well."""
        self._bad_in_a_row = 0

    def out_of_memory(self, window_id: int, error: DeviceMemoryError, way: tuple[Rung, ...]) -> None:
        """The device was full: from here on less is asked of it. way: down from what is asked now; see rungs().

        Raises:
            ModelFailedError: nothing is left to give up.
        """
        self._health.out_of_memory()
        if self._ladder is None:
            self._ladder = Ladder(way)
        goes_on = self._ladder.step_down()
        _LOG.warning("window %d: %s; from here on: %s", window_id, error, self.rung.name)
        fields = {"window_id": window_id, "rung": self.rung.name, "message": str(error)}
        self._announcer.event("GPU_OOM", Level.ERROR, fields)
        if not goes_on:
            raise ModelFailedError(
                f"the device had no memory three times within a minute although little is asked ({self.rung.name}): "
                f"{error} Free memory, or use a smaller model"
            )

    def not_a_number(self, fields: Mapping[str, object]) -> None:
        """A window came out with NaN or Inf, and so did its retry. fields: what it takes to render it again.

        Raises:
            ModelFailedError: the third in a row.
        """
        self._bad_in_a_row += 1
        self._health.nan_window()
        self._announcer.event("MODEL_NAN", Level.ERROR, fields)
        if self._bad_in_a_row >= _BAD_WINDOWS_IN_A_ROW:
            raise ModelFailedError(
                f"{self._bad_in_a_row} windows in a row came out with NaN; none was published. "
                'Try dtype = "float32", and look at them with `gcd-node weights inspect`'
            )
