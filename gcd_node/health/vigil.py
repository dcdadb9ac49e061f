"""Looks after a running node: a model that hangs, a clock that was set, and who started the process."""

from gcd_node.health.announcer import Announcer
from gcd_node.health.monitor import Health
from gcd_node.health.report import Level
from gcd_node.health.systemd import ServiceManager
from gcd_node.health.wall_clock import WallClock

MODEL_HUNG = "MODEL_HUNG"
"""Reason while a step of the model takes longer than it may."""

_LOADING_S = 300.0


class Vigil:
    """Called by the node's life loop alone."""

    def __init__(self, announcer: Announcer, health: Health, hang_s: float, service: ServiceManager | None) -> None:
        """hang_s: how long a step of the model may take. service: who is told, if anybody started us."""
        self._announcer, self._health, self._hang_s, self._service = announcer, health, hang_s, service
        self._wall = WallClock()
        self._hung = self._told_ready = False

    def look(self, silent_s: float) -> None:
        """Call it often. silent_s: how long the model has been at one step."""
        self._look_for_hang(silent_s)
        step_ms = self._wall.step_ms()
        if step_ms is not None:
            self._announcer.event("CLOCK_STEP", Level.WARN, {"clock": "utc", "step_ms": round(step_ms)})
        if self._service is not None and not self._hung:
            self._service.alive()

    def loading(self) -> None:
        """The model is about to be loaded, which may take long."""
        if self._service is not None:
            self._service.extend_start(_LOADING_S)

    def ready(self) -> None:
        """The start is over: views come, or the node waits for something that is not its to bring about."""
        if self._service is not None and not self._told_ready:
            self._service.ready()
            self._told_ready = True

    def stopping(self) -> None:
        """The end has begun."""
        if self._service is not None:
            self._service.stopping()

    def _look_for_hang(self, silent_s: float) -> None:
        hung = silent_s > self._hang_s
        if hung and not self._hung:
            self._health.raise_reason(MODEL_HUNG, Level.ERROR)
            self._announcer.event(MODEL_HUNG, Level.ERROR, {"silent_s": round(silent_s, 1)})
        elif self._hung and not hung:
            self._health.clear_reason(MODEL_HUNG)
        self._hung = hung
