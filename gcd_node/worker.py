"""The model's threads: they take windows, and have every view of each rendered and sent. They own the device.

A model that works frame by frame has three of them beside a live source, at work on consecutive frames: one sees depth
and motion, one places what was seen in the views, one paints the views and sends them. On two cores two are at work.
"""

import logging
import os
import queue
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, nullcontext
from typing import TypeVar

from gcd_model import Cancelled, DeviceMemoryError, NonFiniteError
from gcd_node.health import IDLE, Level
from gcd_node.inference import Renderer
from gcd_node.model import IdleTimer, ModelSlot, interruptible, model_errors
from gcd_node.status import Announcer
from gcd_node.views import LiveConfig
from gcd_node.window import PartialWindow, WindowSlot
from gcd_node.work import Job, Placed, Seen

Given = TypeVar("Given")
Made = TypeVar("Made")

_LOG = logging.getLogger(__name__)


class ModelWorker:
    """Renders windows until there are no more, it is cancelled, or the model has failed."""

    def __init__(self, live: LiveConfig, announcer: Announcer, model: ModelSlot, renderer: Renderer) -> None:
        self.warm = threading.Event()  # the first window may come
        self._model, self._renderer, self._pulse = model, renderer, renderer.pulse
        self._sink, self._health = announcer.sink, announcer.health
        self._realtime = live.config.source.pace == "realtime"
        self._idle = IdleTimer(live.config.life.idle_s if self._realtime else 0.0)
        self._threads: set[int] = set()
        self._may_encode_ahead = True

    def work(self, newest: WindowSlot) -> None:
        """Take windows and publish their views; while there is none, encode what has arrived of the next.

        Raises:
            ModelFailedError: three windows in a row could not be used, or there is no memory however little is asked.
            whatever the source failed with, once its last window is done.
        """
        self._threads.add(threading.get_ident())
        try:
            on_cpu = self._model.traits.device == "cpu"  # elsewhere a step is short, and compiled code knows no hooks
            with interruptible(self._renderer.cancel, self._threads) if on_cpu else nullcontext():
                self._work(newest)
        except Cancelled:
            _LOG.info("the window in work was abandoned")
        finally:
            self._pulse.rest()
            self.warm.set()

    def _work(self, newest: WindowSlot) -> None:
        if self._realtime:
            self._warm_up()
        self._pulse.rest()
        self.warm.set()
        with self._steps(newest) as go_on:
            while (window := newest.take(lambda: self._encode_ahead(newest.filling))) is not None:
                self._may_encode_ahead = True
                taken = None
                if not self._is_idle():
                    self._health.stage("window", (time.monotonic_ns() - window.arrival_ns) / 1e9)
                    taken = self._renderer.take(window)
                self._pulse.rest()
                go_on(taken)
        self._renderer.announce_removed()

    @contextmanager
    def _steps(self, newest: WindowSlot) -> Generator[Callable[[tuple[Job, Seen] | None], None]]:
        """What is to be done with a window that was taken, here or in threads that end with the block."""
        if not (self._realtime and self._model.streams):
            yield lambda taken: self._render(self._place(taken))
            return

        failures: list[Exception] = []
        # for windows in work beside the one that is seen: on two cores a third would make all older and no more of them
        room = threading.Semaphore(1 if len(os.sched_getaffinity(0)) < 3 else 2)

        def guarded(step: Callable[[Given], Made], given: Given) -> Made | None:
            """A step, unless one has failed: that closes `newest`, and is raised at the end."""
            try:
                return None if failures else step(given)
            except Exception as error:  # the end of a thread's work
                failures.append(error)
                newest.close()
                return None
            finally:
                self._pulse.rest()

        def place(taken: tuple[Job, Seen] | None) -> None:
            placed = guarded(self._place, taken)
            to_painter(lambda: paint(placed))

        def paint(placed: tuple[Job, Placed | None] | None) -> None:
            guarded(self._render, placed)
            room.release()

        def go_on(taken: tuple[Job, Seen] | None) -> None:
            to_placer(lambda: place(taken))
            room.acquire()

        with self._thread("painter") as to_painter, self._thread("placer") as to_placer:
            yield go_on
        if failures:
            raise failures[0]

    @contextmanager
    def _thread(self, name: str) -> Generator[Callable[[Callable[[], None]], None]]:
        """A thread that makes the calls it is given. A daemon: a network that hangs must not hold up the end of the
        process, as an executor of the library would."""
        calls: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()

        def work() -> None:
            self._threads.add(threading.get_ident())
            for call in iter(calls.get, None):
                call()

        thread = threading.Thread(target=work, name=name, daemon=True)
        thread.start()
        try:
            yield calls.put
        finally:
            calls.put(None)
            thread.join()

    def _place(self, taken: tuple[Job, Seen] | None) -> tuple[Job, Placed | None] | None:
        return None if taken is None else (taken[0], self._renderer.place(*taken))

    def _render(self, placed: tuple[Job, Placed | None] | None) -> None:
        """The views of a window. placed: None if it is not to be rendered."""
        self._renderer.announce_removed()
        if placed is not None:
            self._pulse.beat()
            self._renderer.render(*placed)
        self._pulse.rest()

    def _is_idle(self) -> bool:
        """Whether no subscriber would see this window."""
        is_idle = self._idle.is_idle(self._sink.stats.watchers)
        if is_idle:
            self._health.raise_reason(IDLE, Level.OK)
        else:
            self._health.clear_reason(IDLE)
        return is_idle

    def _warm_up(self) -> None:
        """Render a grey clip in one step, so that the first window does not pay for what happens only once."""
        self._pulse.load("warming")  # code may be compiled: minutes, in which the engine beats
        try:
            with model_errors():
                self._renderer.warm_up()
        except (NonFiniteError, DeviceMemoryError) as error:
            _LOG.warning("the warm-up came to nothing: %s", error)  # windows are dealt with one by one

    def _encode_ahead(self, filling: PartialWindow | None) -> bool:
        """Encode one frame of the window that fills; False if there is nothing to do."""
        if filling is None or not self._may_encode_ahead or self._idle.is_idle(self._sink.stats.watchers):
            return False
        try:
            return self._renderer.encode_ahead(filling)
        except DeviceMemoryError as error:
            _LOG.warning("nothing is encoded before the next window is there: %s", error)
            self._may_encode_ahead = False
            return False
        finally:
            self._pulse.rest()
