"""What a model gives up, level by level, when its device has no memory left (wire protocol, section 7, F11), and when
it counts as failed."""

import logging
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from gcd_model import DeviceMemoryError
from gcd_node.errors import ModelFailedError
from gcd_node.health import Health, Level
from gcd_node.status import Announcer

_LOG = logging.getLogger(__name__)
_TRIES, _SPAN_S = 3, 60.0
_BAD_WINDOWS_IN_A_ROW = 3


@dataclass(frozen=True, kw_only=True, slots=True)
class OomLevel:
    """How much less is asked of the device. Each level keeps what the ones before it gave up.

    name: as events and logs say it.
    one_by_one: views are rendered after each other, so that only one is in memory.
    half: weights in bfloat16, loaded anew.
    steps_divisor: so many times fewer steps.
    single: the first view alone, with one sample.
    """

    name: str
    one_by_one: bool = False
    half: bool = False
    steps_divisor: int = 1
    single: bool = False


FULL = OomLevel(name="as asked")
"""Nothing is given up."""


def oom_levels(*, views: int, samples: int, steps: int, can_halve: bool, can_part: bool = True) -> tuple[OomLevel, ...]:
    """The way down from what was asked; levels that would change nothing are left out.

    views, samples, steps: as asked. can_halve: the weights are wider than bfloat16, on a device that gains by it.
    can_part: views may be rendered one by one.
    """
    levels, divisor = [FULL], 2 if steps > 1 else 1
    if views > 1 and can_part:
        levels.append(OomLevel(name="views one by one", one_by_one=True))
    if can_halve:
        levels.append(OomLevel(name="bfloat16", one_by_one=can_part, half=True))
    if steps > 1:
        levels.append(OomLevel(name="half the steps", one_by_one=can_part, half=can_halve, steps_divisor=2))
    if views > 1 or samples > 1:
        levels.append(
            OomLevel(name="a single view", one_by_one=can_part, half=can_halve, steps_divisor=divisor, single=True)
        )
    return tuple(levels)


class FailureCounter:
    """Counts what went wrong, tells it, and says when to give up. Belongs to the model thread.

    Of the device's memory it only ever asks less, until the next activation.
    """

    def __init__(self, health: Health, announcer: Announcer, clock: Callable[[], float] = time.monotonic) -> None:
        """clock: monotonic seconds."""
        self._health, self._announcer, self._clock = health, announcer, clock
        self._levels: list[OomLevel] = []  # this one, and those still to come
        self._full_s: deque[float] = deque(maxlen=_TRIES)
        self._bad_in_a_row = 0

    @property
    def level(self) -> OomLevel:
        """How much to ask of the device."""
        return self._levels[0] if self._levels else FULL

    def success(self) -> None:
        """A window came out well."""
        self._bad_in_a_row = 0

    def out_of_memory(self, window_id: int, error: DeviceMemoryError, levels: tuple[OomLevel, ...]) -> None:
        """The device was full: from here on less is asked of it. levels: down from what is asked; see oom_levels().

        Raises:
            ModelFailedError: nothing is left to give up, and it was full three times within a minute.
        """
        self._health.count("oom_count")
        self._levels = self._levels or list(levels)
        if len(self._levels) > 1:
            del self._levels[0]
        else:
            self._full_s.append(self._clock())
        _LOG.warning("window %d: %s; from here on: %s", window_id, error, self.level.name)
        fields = {"window_id": window_id, "rung": self.level.name, "message": str(error)}
        self._announcer.event("GPU_OOM", Level.ERROR, fields)
        if len(self._full_s) == _TRIES and self._full_s[-1] - self._full_s[0] <= _SPAN_S:
            raise ModelFailedError(
                f"the device had no memory three times within a minute although little is asked ({self.level.name}): "
                f"{error} Free memory, or use a smaller model"
            )

    def not_a_number(self, fields: Mapping[str, object]) -> None:
        """A window came out with NaN or Inf, and so did its retry. fields: what it takes to render it again.

        Raises:
            ModelFailedError: the third in a row.
        """
        self._bad_in_a_row += 1
        self._health.count("nan_windows")
        self._announcer.event("MODEL_NAN", Level.ERROR, fields)
        if self._bad_in_a_row >= _BAD_WINDOWS_IN_A_ROW:
            raise ModelFailedError(
                f"{self._bad_in_a_row} windows in a row came out with NaN; none was published. "
                'Try dtype = "float32", and look at them with `gcd-node weights inspect`'
            )


class Condition:
    """A reason in the node's health while something is wrong with what comes in; announced once each time it begins.

    hold_s: how long it must be right again: frames, unlike windows, may be wrong every second time.
    """

    def __init__(self, code: str, health: Health, announcer: Announcer, *, hold_s: float) -> None:
        self._code, self._health, self._announcer, self._hold_s = code, health, announcer, hold_s
        self._wrong_s: float | None = None

    def update(self, problem: Mapping[str, object] | None) -> None:
        """Of the newest input. problem: fields of the event that announces its begin; None if all is right."""
        now_s = time.monotonic()
        if problem is not None:
            if self._wrong_s is None:
                self._health.raise_reason(self._code, Level.WARN)
                self._announcer.event(self._code, Level.WARN, problem)
            self._wrong_s = now_s
        elif self._wrong_s is not None and now_s - self._wrong_s >= self._hold_s:
            self._health.clear_reason(self._code)
            self._wrong_s = None
