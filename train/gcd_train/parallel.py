"""One function over many items, in processes of this machine or on a Ray cluster: each item has exactly one outcome.

Work that takes minutes an item meets killed workers, full disks and bad files. None of these ends a run: what a worker
was doing when it was killed is done again, and what raises is told in its outcome.
"""

import logging
import os
import pickle
import signal
import socket
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from itertools import islice
from multiprocessing import get_context, parent_process
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
    return _map_in_processes(function, iter(items), workers, retries, environments)


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


def _map_in_processes(
    function: Callable[[Any], Any],
    items: Iterator[Any],
    workers: int,
    retries: int,
    environments: Sequence[Mapping[str, str]],
) -> Generator[Outcome[Any, Any]]:
    """Each worker is a pool of one process, so that it is known which item a killed one had."""
    free, pools = list(range(workers)), dict[int, ProcessPoolExecutor]()
    at_work: dict[Future[Any], tuple[int, Any, int]] = {}
    again = deque[tuple[Any, int]]()
    try:
        while True:
            while free and (given := again.popleft() if again else next(((item, 0) for item in items), None)):
                number = free.pop(0)
                if number not in pools:
                    environment = dict(environments[number % len(environments)]) if environments else {}
                    context = get_context("spawn")  # a fork would share OpenGL's and torch's state
                    pools[number] = ProcessPoolExecutor(1, context, _settle, (pickle.dumps(function), environment))
                at_work[pools[number].submit(_done, given[0])] = number, *given
            if not at_work:
                return
            for future in wait(at_work, return_when=FIRST_COMPLETED).done:
                number, item, killed = at_work.pop(future)
                free.append(number)
                try:
                    value, error = future.result()
                except BrokenProcessPool:
                    pools.pop(number).shutdown()
                    killed += 1
                    if killed <= retries:
                        _LOG.warning("a worker ended; its item is done again")
                        again.append((item, killed))
                        continue
                    why = f"its worker was killed {killed} times, most likely for want of memory"
                    value, error = None, ItemError(f"{why}; give fewer --workers")
                except Exception as fault:  # whatever pickle raises for what it cannot take
                    value, error = None, ItemError(f"its result cannot be sent to the parent ({fault})")
                yield Outcome(item=item, value=value, error=error)
    finally:
        busy = {number for number, _, _ in at_work.values()}
        processes = [(number, p) for number, pool in pools.items() for p in list((pool._processes or {}).values())]  # pyright: ignore[reportPrivateUsage]
        for number, process in processes:
            if number in busy:
                process.terminate()
        for pool in pools.values():
            pool.shutdown(wait=False, cancel_futures=True)
        for _, process in processes:
            process.join(_STOP_S)
            if process.is_alive():
                process.kill()


_FUNCTION: list[Callable[[Any], Any]] = []
"""What this process, a worker, does with each item."""


def _settle(function: bytes, environment: Mapping[str, str]) -> None:
    """At the start of a worker, which ends with its parent. function: pickled, as libraries read the environment."""
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process of a terminal: the parent decides
    signal.signal(signal.SIGTERM, _leave)
    one_thread_each()
    try:
        _FUNCTION[:] = [pickle.loads(function)]
    except Exception as error:
        _FUNCTION[:] = [partial(_refuse, f"a worker cannot import its work ({type(error).__name__}: {error})")]
    threading.Thread(target=_end_with_the_parent, daemon=True).start()


def _refuse(why: str, item: object) -> None:
    raise RunError(why)


def _end_with_the_parent() -> None:
    parent = parent_process()
    assert parent is not None, "a worker has one"
    parent.join()
    os._exit(1)


def _leave(number: int, frame: object) -> None:
    raise SystemExit(0)


def _done(item: Any) -> tuple[Any, TrainError | None]:
    outcome = _outcome(_FUNCTION[0], item)
    return outcome.value, outcome.error


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
