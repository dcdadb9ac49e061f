"""What a model gives up, rung by rung, when its device has no memory left (wire protocol, section 7, F11)."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

_TRIES = 3
_SPAN_S = 60.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Rung:
    """How much less is asked of the device. Each rung keeps what the ones before it gave up.

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


WHOLE = Rung(name="as asked")
"""Nothing is given up."""


def rungs(*, views: int, samples: int, steps: int, can_halve: bool) -> tuple[Rung, ...]:
    """The way down from what was asked; rungs that would change nothing are left out.

    views, samples, steps: as asked. can_halve: the weights are wider than bfloat16, on a device that gains by it.
    """
    several = views > 1 or samples > 1
    found = [WHOLE]
    if views > 1:
        found.append(Rung(name="views one by one", one_by_one=True))
    if can_halve:
        found.append(Rung(name="bfloat16", one_by_one=True, half=True))
    if steps > 1:
        found.append(Rung(name="half the steps", one_by_one=True, half=can_halve, steps_divisor=2))
    if several:
        divisor = 2 if steps > 1 else 1
        found.append(Rung(name="a single view", one_by_one=True, half=can_halve, steps_divisor=divisor, single=True))
    return tuple(found)


class Ladder:
    """Where a model stands on its way down. It only ever goes down: whoever wants everything back activates anew."""

    def __init__(self, way: Sequence[Rung], clock: Callable[[], float] = time.monotonic) -> None:
        """Begin at the top. way: see rungs(), at least one. clock: monotonic seconds."""
        self._way, self._clock = tuple(way), clock
        self._at = 0
        self._failures_s: deque[float] = deque(maxlen=_TRIES)

    @property
    def rung(self) -> Rung:
        """What to render with now."""
        return self._way[self._at]

    @property
    def degraded(self) -> bool:
        """Whether anything was given up."""
        return self._at > 0

    def step_down(self) -> bool:
        """The device was full: give up more. False once there is nothing left to give up and it was full three times
        within a minute; then the model has failed."""
        if self._at + 1 < len(self._way):
            self._at += 1
            return True
        self._failures_s.append(self._clock())
        return len(self._failures_s) < _TRIES or self._failures_s[-1] - self._failures_s[0] > _SPAN_S
