"""The node: lives from configure to shutdown, does what it is asked, and says how it is."""

import contextlib
import logging
import queue
import threading
import time
import uuid
from collections.abc import Callable, Mapping

from gcd_client.control import Code
from gcd_model import ModelError, Traits
from gcd_node.commands import NodeCommands
from gcd_node.config import NodeConfig
from gcd_node.errors import NodeError, RemoteError, SourceAbsentError, SourceError, SourceLostError
from gcd_node.health import THREAD_DIED, Health, Level
from gcd_node.lifecycle import PATHS, Lifecycle, Parts, State, Transitions, Verb
from gcd_node.messages import MessageSink
from gcd_node.pipeline import Summary
from gcd_node.recorder import Recorder
from gcd_node.service import ServiceManager
from gcd_node.sources import LIVE_KINDS
from gcd_node.sources.live import backoff_s
from gcd_node.status import Announcer
from gcd_node.verbs import Outcome
from gcd_node.views import LiveConfig
from gcd_node.work import WindowReport

_LOG = logging.getLogger(__name__)
_TICK_S = 0.1
_PATIENCE_S = 3.0  # of the 5 s an end may take; the rest is for what is still to be sent
_LEAST_PATIENCE_S = 0.1
_LEAST_RECORD_S = 0.5
_CLOCK_STEP_NS = 100_000_000


class Node:
    """A camera, a model and the views between them. `run` blocks; all else may be called from other threads, `stop` in
    a signal handler too. Each transition is worked through in a thread of its own, so that status and commands go on.

    needed: threads that the node is not ready without.
    """

    def __init__(
        self,
        config: NodeConfig,
        parts: Parts,
        sink: MessageSink,
        *,
        once: bool = True,
        on_configured: Callable[[Traits], None] | None = None,
        on_window: Callable[[WindowReport], None] | None = None,
        service: ServiceManager | None = None,
    ) -> None:
        """Nothing is opened or loaded before `run`.

        once: end with the first source that ends, and with whatever fails; else stay and wait for commands.
        on_configured, on_window: called with the model once it is loaded, and with every window.
        service: the service manager to notify, if there is one.
        """
        self._config, self._once, self._on_configured = config, once, on_configured
        self.health, live, boot_id = Health(), LiveConfig(config), uuid.uuid4().hex
        self.recorder = Recorder(config, boot_id, lambda: live.config, self.event, sink)
        self._announcer = Announcer(config.node_id, boot_id, self.recorder, self.health)
        self._transitions = Transitions(live, self._announcer, parts, self.recorder, on_window)
        self.commands = NodeCommands(live, self._announcer, self._transitions, self.recorder, self._request)
        self.needed: list[threading.Thread] = []
        self._life = Lifecycle()
        self._work: threading.Thread | None = None
        self._service = service or ServiceManager({})
        self._failures = 0  # of attempts to become active, in a row
        self._ends: queue.SimpleQueue[None] = queue.SimpleQueue()  # something in it: the life loop is to end
        self._stop_s: float | None = None
        self._retry_s: float | None = None
        self._on_its_own = config.life.autostart
        self._failure: Exception | None = None
        self._dead: set[str] = set()
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    @property
    def state(self) -> State:
        """Where its life stands."""
        return self._life.state

    @property
    def left_behind(self) -> bool:
        """After `run`: whether a thread hangs that Python would wait for in vain."""
        return self._transitions.left_behind or (self._work is not None and self._work.is_alive())

    def stop(self) -> None:
        """End in order, soon: no new window begins, the one in work is abandoned at its next layer."""
        self.recorder.stop_waiting()
        self._ends.put(None)

    def event(self, code: str, level: Level, fields: Mapping[str, object]) -> None:
        """Publish what any part of the process has noticed; see EventSink."""
        self._announcer.event(code, level, fields)

    def run(self) -> Summary:
        """Live until shutdown.

        Raises:
            what made it end: SourceLostError if a camera was given up; with `once` whatever a transition or the stream
            failed with.
        """
        try:
            if self._config.record.autostart:
                self.recorder.start()
            self._publish_state()
            if self._on_its_own:
                self._begin("configure")
            else:
                self._service.ready()
            while self.state is not State.FINALIZED and self._left_s(0.0) > 0:
                with contextlib.suppress(queue.Empty):
                    self._ends.get(timeout=_TICK_S)
                    self._prepare_stop()
                self._tick()
        finally:
            self._on_its_own = False
            self._transitions.interrupt()
            if self._work is not None:
                self._work.join(self._left_s(_LEAST_PATIENCE_S))
            self._transitions.close(self._left_s(_LEAST_PATIENCE_S))
            self.recorder.close(self._left_s(_LEAST_RECORD_S))
        if self._failure is not None:
            raise self._failure
        return self._transitions.summary

    # Life loop.

    def _tick(self) -> None:
        state, stream = self.state, self._transitions.stream
        if stream is not None:
            stream.tick()
        self._look_after(0.0 if stream is None else stream.renderer.pulse.silent_s)
        self.health.recording = self.recorder.report()
        if self._stop_s is not None:
            self._begin("shutdown")
        elif state is State.ACTIVE and stream is not None and stream.over:
            self._begin("deactivate")
        elif self._retry_s is not None and time.monotonic() >= self._retry_s and state <= State.INACTIVE:
            self._retry_s = None
            self._begin("activate" if state is State.INACTIVE else "configure")
        self._announcer.status_if_due()

    def _look_after(self, silent_s: float) -> None:
        """Feed the service manager's watchdog, unless the model hangs or a thread has died; notice that a clock was set
        (docs/node.md, F24). silent_s: how long the model has been at one step."""
        is_hung = silent_s > self._config.life.hang_s
        if not is_hung:
            self.health.clear_reason("MODEL_HUNG")
        elif self.health.raise_reason("MODEL_HUNG", Level.ERROR):
            self._announcer.event("MODEL_HUNG", Level.ERROR, {"silent_s": round(silent_s, 1)})
        was_dead, self._dead = self._dead, {each.name for each in self.needed if not each.is_alive()}
        for name in self._dead - was_dead:
            self._announcer.event(THREAD_DIED, Level.ERROR, {"thread": name, "message": "restart the node"})
            self.health.raise_reason(THREAD_DIED, Level.ERROR)
        if not is_hung and not self._dead:
            self._service.alive()
        before_ns, utc_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after_ns - before_ns < _CLOCK_STEP_NS // 20:  # else interrupted between the two clocks
            last_ns, self._offset_ns = self._offset_ns, utc_ns - before_ns
            step_ns = self._offset_ns - last_ns  # much where somebody set UTC, next to nothing where it is slewed
            if abs(step_ns) >= _CLOCK_STEP_NS:
                fields = {"clock": "utc", "step_ms": round(step_ns / 1e6)}
                self._announcer.event("CLOCK_STEP", Level.WARN, fields)

    def _prepare_stop(self) -> None:
        if self._stop_s is None:
            self._stop_s = time.monotonic()
            self._service.stopping()
        self._transitions.interrupt()

    def _left_s(self, least_s: float) -> float:
        """How long the end may still wait for a thread or the disk, so that all of it fits into the 5 s of F23."""
        since_s = 0.0 if self._stop_s is None else time.monotonic() - self._stop_s
        return max(least_s, _PATIENCE_S - since_s)

    def _publish_state(self) -> None:
        self.health.state = self.state.label
        self._announcer.status()

    # Transitions.

    def _request(self, verb: Verb, dry_run: bool) -> Outcome:
        """Begin a transition; an event tells how it ends."""
        if verb == "activate" and self._transitions.model_failed:
            return Outcome(code=Code.NOT_READY, message="the model has failed; cleanup and configure load it anew")
        if verb == "activate" and self._transitions.left_behind:
            return Outcome(code=Code.NOT_READY, message="a thread of the last activation hangs; restart the process")
        is_busy = not self.state.settled
        if verb == "shutdown":
            refusal = None if is_busy else self._life.refusal(verb)
        else:
            refusal = self._life.refusal(verb) if dry_run else self._begin(verb, requested=True)
        if refusal is not None:
            return Outcome(code=Code.BUSY if is_busy else Code.WRONG_STATE, message=refusal)
        if dry_run:
            return Outcome(message=f"{verb} would begin")
        if verb == "shutdown":
            self.stop()
            return Outcome(code=Code.ACCEPTED, message="ending in order")
        self._on_its_own &= verb not in ("deactivate", "cleanup")
        return Outcome(code=Code.ACCEPTED, message=f"{verb} has begun; an event tells how it ends")

    def _begin(self, verb: Verb, *, requested: bool = False) -> str | None:
        """Begin a transition, or say why that cannot be. requested: by a command, rather than by the node itself."""
        refusal = self._life.begin(verb)
        if refusal is None:
            self._publish_state()
            self._work = threading.Thread(target=self._perform, args=(verb, requested), name=verb, daemon=True)
            self._work.start()
        return refusal

    def _perform(self, verb: Verb, requested: bool) -> None:
        """A transition's work, in a thread of its own, and what follows."""
        work = self._transitions.deactivate if verb == "shutdown" else getattr(self._transitions, verb)
        try:
            try:
                work()
            except Exception as error:
                self._fail(verb, error)
            else:
                self._succeed(verb, requested)
        except Exception as error:  # what happens cannot be announced any more
            self._give_up(error)

    def _fail(self, verb: Verb, error: Exception) -> None:
        if verb in ("configure", "activate") and isinstance(error, NodeError | ModelError):
            (self._life.state,) = PATHS[verb][0]  # nothing has changed
        else:
            self._life.state = State.ERRORPROCESSING
            _LOG.error("%s broke", verb, exc_info=error)
            self._transitions.close(_PATIENCE_S)  # what still stands is unknown: everything is let go
            self.health.model = "absent"
            self._life.state = State.FINALIZED if verb == "shutdown" else State.UNCONFIGURED
        self._publish_state()
        is_raised = self._once and self._stop_s is None
        fields = {"verb": verb, "message": str(error)}
        self._announcer.event(_code(error).value, Level.ERROR, fields, is_logged=not is_raised)
        self._after_failure(error, verb)

    def _succeed(self, verb: Verb, requested: bool) -> None:
        """And what follows by itself."""
        self._life.state = PATHS[verb][2]
        self._publish_state()
        if requested:
            self._announcer.event("STATE", Level.OK, {"verb": verb, "state": self.state.label})
        if verb == "configure":
            traits = self._transitions.traits
            if traits is not None and self._on_configured is not None:
                self._on_configured(traits)
            if self._on_its_own and not requested:
                self._begin("activate")
        elif verb == "activate":
            self._failures = 0
            self._service.ready()
        elif verb == "deactivate" and not requested and self._stop_s is None:
            failure = self._transitions.failure  # the stream has ended by itself
            if failure is not None:
                self._after_failure(failure, "activate")
            elif self._once:
                self._ends.put(None)

    def _after_failure(self, error: Exception, verb: Verb) -> None:
        """Give up, try again later, or wait for a command."""
        self._service.ready()
        is_camera_lost = verb == "activate" and isinstance(error, SourceError)
        may_come = is_camera_lost and self._config.source.kind in LIVE_KINDS
        if self._stop_s is not None and verb != "shutdown":
            return
        if self._once or isinstance(error, SourceLostError):
            self._give_up(error)
        elif self._on_its_own and (may_come or isinstance(error, RemoteError)):
            self._retry_s = time.monotonic() + (wait_s := backoff_s(self._config.source.kind, self._failures))
            _LOG.log(logging.INFO if self._failures else logging.WARNING, "trying again in %.1f s", wait_s)
            self._failures += 1

    def _give_up(self, error: Exception) -> None:
        self._failure = error
        self._ends.put(None)


def _code(error: Exception) -> Code:
    """What the event of a failed transition says."""
    if isinstance(error, SourceAbsentError | SourceLostError | RemoteError):
        return Code.NOT_READY
    return Code.BAD_ARG if isinstance(error, NodeError | ModelError) else Code.INTERNAL
