"""Items mapped on a Ray cluster that somebody runs; see `map_items`."""

import logging
import signal
import socket
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from itertools import islice
from typing import Any

from gcd_train.errors import RunError
from gcd_train.map_items import Outcome, done, one_thread_each

_TASKS_AT_ONCE = 2  # for each that can be worked on: one is done, one waits
_LOOK_AGAIN_S = 5.0
_ANSWER_S = 10.0


def map_on_ray(
    function: Callable[[Any], Any], items: Iterable[Any], *, address: str, retries: int, gpus: float = 0.0
) -> Generator[Outcome[Any, Any]]:
    """Outcomes in the order in which they are finished; twice as many items are out as the cluster can work on.

    Ray gives an item to another worker when its own is killed or its node lost. Stops a connection that it made.

    Raises:
        RunError: there is no cluster, or the extra `cluster` is not installed.
    """
    ray = _import_ray()
    ours = not ray.is_initialized()
    if ours:
        _connect(ray, address)
    try:
        share = gpus if ray.cluster_resources().get("GPU", 0.0) else 0.0
        yield from _mapped(ray, function, iter(items), retries, share)
    finally:
        if ours:
            ray.shutdown()


def _import_ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise RunError("--ray needs the extra `cluster`: pip install 'gcd-node[cluster]'") from error
    return ray


def _connect(ray: Any, address: str) -> None:
    _require_somebody(address)
    on_stop = signal.getsignal(signal.SIGTERM)  # Ray sets one of its own
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, ValueError, RuntimeError, ray.exceptions.RayError) as error:
        raise _unanswered(address, error) from error
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, on_stop)


def _require_somebody(address: str) -> None:
    """Ray itself would try a wrong address for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (host and port.isdecimal()):
        return  # `auto`: Ray looks for a cluster on this machine
    try:
        socket.create_connection((host, int(port)), _ANSWER_S).close()
    except (OSError, OverflowError) as error:
        raise _unanswered(address, error) from error


def _unanswered(address: str, error: Exception) -> RunError:
    return RunError(f"no Ray cluster answers at {address} ({error}); start one with `ray start --head`")


def _mapped(
    ray: Any, function: Callable[[Any], Any], items: Iterator[Any], retries: int, gpus: float
) -> Generator[Outcome[Any, Any]]:
    task = ray.remote(_on_a_node).options(num_cpus=1, num_gpus=gpus, max_retries=retries)
    shared = ray.put(function)
    out: dict[Any, Any] = {}
    try:
        while True:
            for item in islice(items, max(0, _wanted(ray, gpus) - len(out))):
                out[task.remote(shared, item)] = item
            if not out:
                return
            ready, _ = ray.wait(list(out), num_returns=1, timeout=_LOOK_AGAIN_S)
            for reference in ready:
                yield _outcome(ray, reference, out.pop(reference))
    finally:
        for reference in out:
            ray.cancel(reference)


def _wanted(ray: Any, gpus: float) -> int:
    """Nodes come and go."""
    there = ray.cluster_resources()
    at_once = min(there.get("CPU", 1.0), there.get("GPU", 0.0) / gpus if gpus else float("inf"))
    return max(_TASKS_AT_ONCE, int(_TASKS_AT_ONCE * at_once))


def _on_a_node(function: Callable[[Any], Any], item: Any) -> tuple[Any, str | None, str | None]:
    one_thread_each()
    outcome = done(function, item)
    return outcome.value, outcome.error, outcome.kind


def _outcome(ray: Any, reference: Any, item: Any) -> Outcome[Any, Any]:
    try:
        value, error, kind = ray.get(reference)
    except ray.exceptions.RayError as lost:
        first = str(lost).strip().splitlines()[0]
        return Outcome(item=item, error=f"its Ray worker was lost again and again ({first})", kind="WorkerLost")
    return Outcome(item=item, value=value, error=error, kind=kind)
