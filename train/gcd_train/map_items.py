"""One function over many items, in processes of this machine or on a Ray cluster: each item has exactly one outcome.

Work that takes minutes an item meets killed workers, full disks and bad files. None of these ends a run: what a worker
was doing when it was killed is done again, and what raises is told in its outcome.
"""

import logging
import os
import signal
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Generic, TypeVar

from gcd_train.errors import DataError, RecipeError, RenderError, RunError, TrainError

Item = TypeVar("Item")
Value = TypeVar("Value")

_LOG = logging.getLogger(__name__)
_ONE_THREAD = ("LP_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
_STOP_S = 30.0
_KINDS: dict[str, type[TrainError]] = {kind.__name__: kind for kind in (DataError, RecipeError, RenderError, RunError)}


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome(Generic[Item, Value]):
    """What became of an item: its value, or the error that it ended in. kind: name of the error's class."""

    item: Item
    value: Value | None = None
    error: str | None = None
    kind: str | None = None

    def unwrap(self) -> Value:
        """The value. Raises: the error, as the TrainError it was or as a RunError."""
        if self.error is not None:
            raise _KINDS.get(self.kind or "", RunError)(self.error)
        return self.value  # pyright: ignore[reportReturnType]


def map_items(
    function: Callable[[Item], Value],
    items: Iterable[Item],
    *,
    workers: int = 1,
    ray_address: str | None = None,
    retries: int = 2,
    gpus: float = 0.0,
    environments: Sequence[Mapping[str, str]] = (),
) -> Iterator[Outcome[Item, Value]]:
    """Outcomes in the order in which they are finished. Items are taken as workers come free.

    Leaving the iteration early stops the workers: what they were doing is broken off, as by Ctrl-C.

    Args:
        function: of a module that workers can import. It may meet an item again that was already done in part or
            whole, after its worker was killed, so its results must not depend on how often it runs.
        workers: processes; 1 without Ray is this process, which nobody replaces.
        ray_address: of a running cluster (`auto`, or HOST:PORT); None for this machine alone. The same version of
            this package, and the folders that `function` uses, must be on every node.
        retries: how often an item is given to another worker after one was killed.
        gpus: GPUs, or share of one, that an item is given on a cluster that has any: Ray hides them from what asks for
            none.
        environments: variables that processes of this machine are given before they work, in turn: worker k has the
            k-th, and who takes the place of a killed one has that one's. Empty for nothing.
    Raises:
        RunError: there is no such cluster, or the extra `cluster` is not installed.
    """
    if ray_address is not None:
        from gcd_train.map_on_ray import map_on_ray  # it stands on this module

        return map_on_ray(function, items, address=ray_address, retries=retries, gpus=gpus)
    if workers == 1:
        return (done(function, item) for item in items)
    return _Pool(function, workers, retries, environments).run(iter(items))


def done(function: Callable[[Item], Value], item: Item) -> Outcome[Item, Value]:
    """Apply a function; an error becomes an outcome, only being stopped is none."""
    try:
        return Outcome(item=item, value=function(item))
    except Exception as error:
        if not isinstance(error, TrainError | OSError):
            _LOG.exception("item %r", item)
        return Outcome(item=item, error=_told(error), kind=type(error).__name__)


def one_thread_each() -> None:
    """Keep libraries that are loaded after this call to one core, software OpenGL included."""
    for name in _ONE_THREAD:
        os.environ.setdefault(name, "1")


def _told(error: Exception) -> str:
    """One line; what nobody expected is told with its place."""
    if isinstance(error, TrainError | OSError):
        return str(error)
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({os.path.basename(place.filename)}, line {place.lineno})"


@dataclass(slots=True, eq=False)
class _Worker:
    process: BaseProcess
    pipe: Connection
    seat: int
    attempt: "_Attempt | None" = None


@dataclass(slots=True, eq=False)
class _Attempt:
    item: Any
    killed: int = 0


class _Pool:
    """Processes with a pipe each, so that it is known which item a killed one had."""

    def __init__(
        self, function: Callable[[Any], Any], workers: int, retries: int, environments: Sequence[Mapping[str, str]]
    ) -> None:
        self._function, self._size, self._retries = function, workers, retries
        self._environments = environments or ({},)
        self._workers: list[_Worker] = []
        self._again: deque[_Attempt] = deque()

    def run(self, items: Iterator[Any]) -> Generator[Outcome[Any, Any]]:
        try:
            while self._feed(items):
                ready = wait([worker.pipe for worker in self._workers if worker.attempt is not None])
                for worker in [worker for worker in self._workers if worker.pipe in ready]:
                    outcome = self._collect(worker)
                    if outcome is not None:
                        yield outcome
        finally:
            self._stop()

    def _feed(self, items: Iterator[Any]) -> bool:
        """Give every idle worker an item, starting workers as needed. False once nothing is under way."""
        while len([worker for worker in self._workers if worker.attempt is not None]) < self._size:
            attempt = self._again.popleft() if self._again else _next_attempt(items)
            if attempt is None:
                break
            idle = next((worker for worker in self._workers if worker.attempt is None), None) or self._start()
            idle.attempt = attempt
            try:
                idle.pipe.send(attempt.item)
            except OSError:
                continue  # it was killed while idle: its pipe is closed, and reading will tell
        return any(worker.attempt is not None for worker in self._workers)

    def _collect(self, worker: _Worker) -> Outcome[Any, Any] | None:
        attempt = worker.attempt
        assert attempt is not None, "only busy workers are waited for"
        try:
            value, error, kind = worker.pipe.recv()
        except (EOFError, OSError):
            return self._after_death(worker, attempt)
        worker.attempt = None
        return Outcome(item=attempt.item, value=value, error=error, kind=kind)

    def _after_death(self, worker: _Worker, attempt: _Attempt) -> Outcome[Any, Any] | None:
        """Put its item back, or give it up."""
        worker.process.join(_STOP_S)
        code = worker.process.exitcode
        self._workers.remove(worker)
        worker.pipe.close()
        attempt.killed += 1
        if attempt.killed <= self._retries:
            _LOG.warning("a worker ended (exit code %s); its item is done again", code)
            self._again.append(attempt)
            return None
        why = f"its worker was killed {attempt.killed} times (exit code {code}), most likely for want of memory"
        return Outcome(item=attempt.item, error=f"{why}; give fewer --workers", kind="WorkerLost")

    def _start(self) -> _Worker:
        context = get_context("spawn")  # a fork would share OpenGL's and torch's state
        ours, theirs = context.Pipe()
        seat = min(set(range(self._size)) - {worker.seat for worker in self._workers})
        environment = dict(self._environments[seat % len(self._environments)])
        process = context.Process(target=_serve, args=(theirs, environment), daemon=True)
        process.start()
        theirs.close()
        worker = _Worker(process, ours, seat)
        self._workers.append(worker)
        with suppress(OSError):  # it is gone already: the item's turn will tell
            ours.send(self._function)
        return worker

    def _stop(self) -> None:
        for worker in self._workers:
            worker.pipe.close()
            if worker.attempt is not None:
                worker.process.terminate()
        for worker in self._workers:
            worker.process.join(_STOP_S)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()


def _next_attempt(items: Iterator[Any]) -> _Attempt | None:
    for item in items:
        return _Attempt(item)
    return None


def _serve(pipe: Connection, environment: Mapping[str, str]) -> None:
    """A worker's life: the function first, then items until the pipe is closed."""
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process of a terminal: the parent decides
    signal.signal(signal.SIGTERM, _leave)
    one_thread_each()
    with suppress(EOFError, OSError):  # the parent is done, or gone
        function = _received(pipe)
        while True:
            _send(pipe, done(function, pipe.recv()))


def _received(pipe: Connection) -> Callable[[Any], Any]:
    try:
        return pipe.recv()
    except (EOFError, OSError):
        raise
    except Exception as error:
        return partial(_refuse, f"a worker cannot import its work ({type(error).__name__}: {error})")


def _refuse(why: str, item: object) -> None:
    raise RunError(why)


def _send(pipe: Connection, outcome: Outcome[Any, Any]) -> None:
    try:
        pipe.send((outcome.value, outcome.error, outcome.kind))
    except (TypeError, AttributeError, ValueError) as error:  # what pickle raises for what it cannot take
        pipe.send((None, f"its result cannot be sent to the parent ({error})", type(error).__name__))


def _leave(number: int, frame: object) -> None:
    raise SystemExit(0)
