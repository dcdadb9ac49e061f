"""One function over many items, in processes of this machine or on a Ray cluster: each item has exactly one outcome.

Work that takes minutes an item meets killed workers, full disks and bad files. None of these ends a run: what a worker
was doing when it was killed is done again, and what raises is told in its outcome.
"""

import logging
import os
import signal
import socket
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import islice
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Generic, TypeVar

from gcd_train.errors import RunError, TrainError

Item = TypeVar("Item")
Value = TypeVar("Value")

_LOG = logging.getLogger(__name__)
_ONE_THREAD = ("LP_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
_STOP_S = 30.0
_TASKS_AT_ONCE = 2  # on Ray, for each that can be worked on: one is done, one waits
_LOOK_AGAIN_S = 5.0
_ANSWER_S = 10.0


class ItemError(RunError):
    """An item failed for want of disk or memory, or by a fault of ours."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome(Generic[Item, Value]):
    """What became of an item: its value, or the error that it ended in."""

    item: Item
    value: Value | None = None
    error: TrainError | None = None

    def unwrap(self) -> Value:
        """The value. Raises: the error, as the TrainError it was or as an ItemError."""
        if self.error is not None:
            raise self.error
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
        return _map_on_ray(function, iter(items), ray_address, retries, gpus)
    if workers == 1:
        return (_outcome(function, item) for item in items)
    return _Pool(function, workers, retries, environments).run(iter(items))


def one_thread_each() -> None:
    """Keep libraries that are loaded after this call to one core, software OpenGL included."""
    for name in _ONE_THREAD:
        os.environ.setdefault(name, "1")


def _outcome(function: Callable[[Item], Value], item: Item) -> Outcome[Item, Value]:
    """Apply a function; an error becomes an outcome, only being stopped is none."""
    try:
        return Outcome(item=item, value=function(item))
    except TrainError as error:
        return Outcome(item=item, error=error)
    except OSError as error:
        return Outcome(item=item, error=ItemError(str(error)))
    except Exception as error:  # a fault of ours: told with its place
        _LOG.exception("item %r", item)
        place = traceback.extract_tb(error.__traceback__)[-1]
        told = f"{type(error).__name__}: {error} ({os.path.basename(place.filename)}, line {place.lineno})"
        return Outcome(item=item, error=ItemError(told))


@dataclass(slots=True, eq=False)
class _Attempt:
    item: Any
    killed: int = 0


@dataclass(slots=True, eq=False)
class _Worker:
    process: BaseProcess
    pipe: Connection
    number: int
    attempt: _Attempt | None = None


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
            while busy := self._feed(items):
                ready = wait([worker.pipe for worker in busy])
                for worker in [worker for worker in busy if worker.pipe in ready]:
                    outcome = self._collect(worker)
                    if outcome is not None:
                        yield outcome
        finally:
            self._stop()

    def _feed(self, items: Iterator[Any]) -> list[_Worker]:
        """Give every idle worker an item, starting workers as needed; those that have one."""
        while len(busy := [worker for worker in self._workers if worker.attempt is not None]) < self._size:
            attempt = self._again.popleft() if self._again else next(map(_Attempt, items), None)
            if attempt is None:
                break
            idle = next((worker for worker in self._workers if worker.attempt is None), None) or self._start()
            idle.attempt = attempt
            with suppress(OSError):  # it was killed while idle: its pipe is closed, and reading will tell
                idle.pipe.send(attempt.item)
        return busy

    def _collect(self, worker: _Worker) -> Outcome[Any, Any] | None:
        """What a worker that is ready has made; None where it was killed and its item is put back."""
        attempt = worker.attempt
        assert attempt is not None, "only busy workers are waited for"
        try:
            value, error = worker.pipe.recv()
        except (EOFError, OSError):
            return self._after_death(worker, attempt)
        worker.attempt = None
        return Outcome(item=attempt.item, value=value, error=error)

    def _after_death(self, worker: _Worker, attempt: _Attempt) -> Outcome[Any, Any] | None:
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
        return Outcome(item=attempt.item, error=ItemError(f"{why}; give fewer --workers"))

    def _start(self) -> _Worker:
        context = get_context("spawn")  # a fork would share OpenGL's and torch's state
        ours, theirs = context.Pipe()
        number = min(set(range(self._size)) - {worker.number for worker in self._workers})
        environment = dict(self._environments[number % len(self._environments)])
        process = context.Process(target=_serve, args=(theirs, environment), daemon=True)
        process.start()
        theirs.close()
        worker = _Worker(process, ours, number)
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


def _serve(pipe: Connection, environment: Mapping[str, str]) -> None:
    """A worker's life: the function first, then items until the pipe is closed."""
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process of a terminal: the parent decides
    signal.signal(signal.SIGTERM, _leave)
    one_thread_each()
    with suppress(EOFError, OSError):  # the parent is done, or gone
        try:
            function = pipe.recv()
        except (EOFError, OSError):
            return
        except Exception as error:
            function = partial(_refuse, f"a worker cannot import its work ({type(error).__name__}: {error})")
        while True:
            outcome = _outcome(function, pipe.recv())
            try:
                pipe.send((outcome.value, outcome.error))
            except (TypeError, AttributeError, ValueError) as error:  # what pickle raises for what it cannot take
                pipe.send((None, ItemError(f"its result cannot be sent to the parent ({error})")))


def _refuse(why: str, item: object) -> None:
    raise RunError(why)


def _leave(number: int, frame: object) -> None:
    raise SystemExit(0)


def _map_on_ray(
    function: Callable[[Any], Any], items: Iterator[Any], address: str, retries: int, gpus: float
) -> Generator[Outcome[Any, Any]]:
    """Twice as many items are out as the cluster can work on, whose nodes come and go.

    Ray gives an item to another worker when its own is killed or its node lost. Stops a connection that it made.
    """
    ray = _import_ray()
    ours = not ray.is_initialized()
    if ours:
        _connect(ray, address)
    out: dict[Any, Any] = {}
    try:
        share = gpus if ray.cluster_resources().get("GPU", 0.0) else 0.0
        task = ray.remote(_on_a_node).options(num_cpus=1, num_gpus=share, max_retries=retries)
        shared = ray.put(function)
        while True:
            there = ray.cluster_resources()
            at_once = min(there.get("CPU", 1.0), there.get("GPU", 0.0) / share if share else float("inf"))
            wanted = max(_TASKS_AT_ONCE, int(_TASKS_AT_ONCE * at_once))
            for item in islice(items, max(0, wanted - len(out))):
                out[task.remote(shared, item)] = item
            if not out:
                return
            ready, _ = ray.wait(list(out), num_returns=1, timeout=_LOOK_AGAIN_S)
            for reference in ready:
                yield _ray_outcome(ray, reference, out.pop(reference))
    finally:
        for reference in out:
            ray.cancel(reference)
        if ours:
            ray.shutdown()


def _import_ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise RunError("--ray needs the extra `cluster`: pip install 'gcd-node[cluster]'") from error
    return ray


def _connect(ray: Any, address: str) -> None:
    """Raises RunError if no cluster answers."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    on_stop = signal.getsignal(signal.SIGTERM)  # Ray sets one of its own
    try:
        if host and port.isdecimal():  # Ray itself would try a wrong address for minutes
            socket.create_connection((host, int(port)), _ANSWER_S).close()
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, OverflowError, ValueError, RuntimeError, ray.exceptions.RayError) as error:
        raise RunError(f"no Ray cluster answers at {address} ({error}); start one with `ray start --head`") from error
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, on_stop)


def _on_a_node(function: Callable[[Any], Any], item: Any) -> tuple[Any, TrainError | None]:
    one_thread_each()
    outcome = _outcome(function, item)
    return outcome.value, outcome.error


def _ray_outcome(ray: Any, reference: Any, item: Any) -> Outcome[Any, Any]:
    try:
        value, error = ray.get(reference)
    except ray.exceptions.RayError as lost:
        first = str(lost).strip().splitlines()[0]
        return Outcome(item=item, error=ItemError(f"its Ray worker was lost again and again ({first})"))
    return Outcome(item=item, value=value, error=error)
