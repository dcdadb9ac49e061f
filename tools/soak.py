"""A node under load for hours, and whether it holds more of anything at the end than at the beginning.

    python tools/soak.py --hours 1 --json soak.json

The camera drops, stalls, reverses, changes size, dies and comes back; readers are slow or stall, a client attacks every
socket, an operator changes views and restarts the stream. The model is a stand-in. Ends with 1, and a sentence for each
limit that is broken; Ctrl-C ends it early, with the figures so far.
"""

import argparse
import gc
import json
import os
import random
import subprocess
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np
import psutil
import zmq
from soak_node import ACTS, HEIGHT, VIEW, WIDTH, CameraScript, Rig, StandInModel, running_node

from gcd_client.control import Code, ControlClient, ControlError, Reply
from gcd_node.errors import NodeError

CLIENTS = Path(__file__).with_name("soak_clients.py")
LIMITS = {"memory_mb": 20.0, "threads": 2.0, "files": 4.0, "subscriptions": 0.0, "median_age_ms": 250.0}
"""How much each may grow from the first to the last quarter, once the first fifth (10 min at most) has passed."""

_MEBIBYTE = 2**20
_EXTRA_VIEW = "extra"
_STATE_BEFORE = {"deactivate": "active", "cleanup": "inactive", "configure": "unconfigured"}
_ALLOCATOR = {"MALLOC_ARENA_MAX": "1"}  # as in the unit file: a heap for each thread would pass for a leak


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--json", type=Path, help="a file for the figures")
    parser.add_argument("--seed", type=int, default=0, help="of camera, operator and attacker")
    options = parser.parse_args()
    if options.json is not None:
        options.json.write_text("{}\n")  # to know before hours have passed whether it can be written
    if not _ALLOCATOR.items() <= os.environ.items():
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | _ALLOCATOR)
    soak = Soak(3600 * options.hours, options.seed)
    try:
        soak.run()
    except NodeError as error:
        soak.failures.append(str(error))
    report = soak.report()
    report["findings"] = found = findings(report)
    if options.json is not None:
        options.json.write_text(json.dumps(report, indent=1) + "\n")
    for name, value in report.items():
        print(f"{name}: {json.dumps(value)}")
    sys.exit(1 if found else 0)


class Soak:
    """One run."""

    def __init__(self, seconds: float, seed: int) -> None:
        self._seconds, self._seed = seconds, seed
        self._model = StandInModel()
        self._script = CameraScript(_acts(seed), (5 * WIDTH // 4, 5 * HEIGHT // 4))
        self._started_s = self._lasted_s = 0.0
        self._samples: list[tuple[float, ...]] = []
        self._ages: list[tuple[float, float]] = []
        self._operator: Operator | None = None
        self._left: tuple[str, ...] = ()
        self._attacks: dict = {"done": {}, "refused": 0}
        self._windows = self._skipped = self._backlog = 0
        self._silent_s = 0.0
        self.failures: list[str] = []

    def run(self) -> None:
        zmq.Frame(bytes(zmq.COPY_THRESHOLD), copy=False)  # what pyzmq holds for zero-copy messages stays for good
        held = _held()
        with running_node(self._script, self._model, self._window) as rig:
            try:
                self._load(rig)
            finally:
                if rig.failure is not None:
                    self.failures.append(f"the node ended with {type(rig.failure).__name__}: {rig.failure}")
        del rig
        gc.collect()  # the publisher closes its wake-up with its last reference
        until_s = time.monotonic() + 10.0
        while (left := _held() - held) and time.monotonic() < until_s:
            time.sleep(0.1)
        self._left = tuple(sorted(left))

    def _load(self, rig: Rig) -> None:
        data, status = rig.publisher.endpoint, rig.publisher.status_endpoint
        with ExitStack() as stack:
            reader = stack.enter_context(Client("read", data, VIEW))
            slow = stack.enter_context(Client("read", data, VIEW, "--newest", "--pause", "1"))
            stalled = stack.enter_context(Client("read", data, VIEW, "--stall", "20"))
            rig.wait_for(lambda: rig.publisher.stats.subscribers >= 3, "three subscriptions")
            attacker = stack.enter_context(Client("attack", data, status, rig.control, str(self._seed)))
            self._operator = stack.enter_context(Operator(rig, min(60.0, self._seconds / 4), self._seed))
            rig.wait_for(lambda: bool(reader.said), "a first view")
            self._started_s = time.monotonic()
            with suppress(KeyboardInterrupt):
                self._watch(rig, reader, (slow, stalled, attacker))
            self._lasted_s = time.monotonic() - self._started_s
            self._silence(self._lasted_s)
            self._attacks = attacker.said[-1] if attacker.said else self._attacks

    def _watch(self, rig: Rig, reader: "Client", others: Sequence["Client"]) -> None:
        every_s, sampled_s = max(0.2, self._seconds / 2000), 0.0
        process = psutil.Process()
        while (at_s := time.monotonic() - self._started_s) < self._seconds:
            self._operator.step()
            while reader.said:
                self._arrived(reader.said.popleft())
            for other in others[:-1]:
                other.said.clear()
            if at_s - sampled_s >= every_s:
                sampled_s = at_s
                memory_mb = process.memory_info().rss / _MEBIBYTE
                held = (memory_mb, process.num_threads(), process.num_fds(), rig.publisher.stats.subscribers)
                self._samples.append((at_s, *held))
            if not rig.running or not all(each.alive for each in (reader, *others)):
                self.failures.append("the node or a client ended early; its last words are above")
                return
            time.sleep(0.1)

    def _window(self, report) -> None:
        self._windows += 1
        waited_s = (self._model.taken_ns - report.window.arrival_ns) / 1e9
        self._backlog = max(self._backlog, int(waited_s * report.window.fps / len(report.window.seqs)))

    def _arrived(self, view: dict) -> None:
        at_s, taken_ns = view["arrived_ns"] / 1e9 - self._started_s, self._script.taken_ns(view["last_seq"])
        if taken_ns is not None and at_s >= 0:
            self._silence(at_s)
            self._ages.append((at_s, (view["arrived_ns"] - taken_ns) / 1e6))
            self._skipped += view["skipped"]

    def _silence(self, until_s: float) -> None:
        self._silent_s = max(self._silent_s, until_s - (self._ages[-1][0] if self._ages else 0.0))

    def report(self) -> dict:
        samples = np.array(self._samples or [(0.0,) * 5])
        ages = np.array(self._ages or [(0.0, 0.0)])
        at_s = samples[:, 0]
        replies = self._operator.reply_ms if self._operator else []
        return {
            "seconds": self._lasted_s,
            "memory_mb": growth(at_s, samples[:, 1], 50),
            "threads": growth(at_s, samples[:, 2], 0),
            "files": growth(at_s, samples[:, 3], 0),
            "subscriptions": growth(at_s, samples[:, 4], 0),
            "median_age_ms": growth(ages[:, 0], ages[:, 1], 50),
            "age_ms": _spread(ages[:, 1]),
            "reply_ms": _spread(replies),
            "backlog_windows": self._backlog,
            "windows": self._windows,
            "arrived": len(self._ages),
            "skipped": self._skipped,
            "silent_s": self._silent_s,
            "openings": self._script.openings,
            "acts": dict(self._script.done),
            "restarts": self._operator.restarts if self._operator else 0,
            "unanswered": self._operator.unanswered if self._operator else 0,
            "codes": dict(self._operator.codes) if self._operator else {},
            "attacks": self._attacks,
            "left": self._left,
            "failures": self.failures,
        }


def findings(report: dict) -> list[str]:
    """What is not as it should be, a sentence each."""
    found = []
    for name, most in LIMITS.items():
        grown = report[name]["last"] - report[name]["first"]
        if not grown <= most:
            found.append(f"{name} grew by {grown:.1f}, at most {most:g} is allowed")
    if report["subscriptions"]["last"] < report["subscriptions"]["first"]:
        found.append("subscriptions fell: the node counts readers that are gone")
    if report["backlog_windows"] > 1:
        found.append(f"a window waited for {report['backlog_windows']} windows' time, at most 1 is allowed")
    if report["silent_s"] > 60:
        found.append(f"no view for {report['silent_s']:.0f} s, at most 60 are allowed")
    if report["unanswered"]:
        found.append(f"{report['unanswered']} requests stayed without a reply")
    if broken := report["codes"].get("INTERNAL"):
        found.append(f"{broken} requests ended as INTERNAL")
    if report["left"]:
        found.append(f"left after the end: {', '.join(report['left'])}")
    return [*found, *report["failures"]]


def growth(at_s: np.ndarray, values: np.ndarray, share: float) -> dict:
    """The level in the first and in the last quarter, settling left out. share: per cent of a quarter's values that lie
    below its level: 50 is their median, 0 what is there at all times."""
    begin_s = min(at_s[-1] / 5, 600.0)
    edge_s = (at_s[-1] - begin_s) / 4
    first = values[(at_s >= begin_s) & (at_s <= begin_s + edge_s)]
    last = values[at_s >= at_s[-1] - edge_s]
    levels = (np.percentile(each if len(each) else values[-1:], share) for each in (first, last))
    return {**dict(zip(("first", "last"), map(float, levels), strict=True)), "peak": float(values.max())}


def _spread(values: Sequence[float]) -> dict:
    p50, p99, most = np.percentile(values, (50, 99, 100)) if len(values) else (0.0, 0.0, 0.0)
    return {"count": len(values), "p50": float(p50), "p99": float(p99), "most": float(most)}


def _acts(seed: int) -> Iterator[str]:
    """All acts, in another order each time round."""
    chance = random.Random(seed)
    while True:
        yield from chance.sample(ACTS, len(ACTS))


def _held() -> set[str]:
    """Threads and sockets of this process."""
    held = {f"thread {each.name} {each.ident}" for each in threading.enumerate()}
    for name in os.listdir("/proc/self/fd"):
        try:
            kind = os.readlink(f"/proc/self/fd/{name}")
        except OSError:
            continue  # the one that listed the folder, or closed meanwhile
        if kind.startswith(("socket:", "anon_inode:")):
            held.add(f"{kind} as {name}")
    return held


class Client:
    """A process of soak_clients.py. said: what it has said and nobody has taken."""

    def __init__(self, *arguments: str) -> None:
        self.said: deque[dict] = deque(maxlen=100_000)
        command = [sys.executable, str(CLIENTS), *arguments]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    def _listen(self) -> None:
        with self._process.stdout as output:
            self.said.extend(map(json.loads, iter(output.readline, b"")))

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.stdin.close()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._thread.join()


class Operator:
    """Asks twice a second when `step` is called often: moves views, changes parameters, restarts the stream, and every
    fifth time the model too."""

    def __init__(self, rig: Rig, restart_s: float, seed: int) -> None:
        self._rig, self._restart_s, self._chance = rig, restart_s, random.Random(seed)
        self._client = ControlClient(rig.control, timeout_s=5.0, attempts=1)
        self._plan: deque[str] = deque()
        self._next_s = self._restarted_s = time.monotonic()
        self.reply_ms: list[float] = []
        self.codes: Counter[str] = Counter()
        self.unanswered = self.restarts = 0

    def step(self) -> None:
        if (now_s := time.monotonic()) < self._next_s:
            return
        self._next_s = now_s + 0.5
        if now_s - self._restarted_s > self._restart_s and not self._plan:
            self._restarted_s = now_s
            self.restarts += 1
            deep = self.restarts % 5 == 0
            self._plan.extend(("deactivate", "cleanup", "configure") if deep else ("deactivate",))
        self._go_on()
        self._ask("stats")
        self._change()

    def _go_on(self) -> None:
        """With the restart, as far as the state allows; and never leave the node inactive."""
        state = self._rig.node.state.label
        if self._plan:
            reply = self._ask(self._plan[0]) if state == _STATE_BEFORE[self._plan[0]] else None
            if reply is not None and reply.code is Code.ACCEPTED:
                self._plan.popleft()
        elif state == "inactive":
            self._ask("activate")

    def _change(self) -> None:
        azimuth_deg = self._chance.uniform(-60.0, 60.0)
        orbit = {"kind": "orbit", "rate_deg_s": 5.0, "amplitude_deg": 30.0}
        wrong = {"azimuth_deg": 10 * azimuth_deg, "elevation_deg": 85.0}
        verb, arguments = self._chance.choice(
            (
                ("set_view", {"view": VIEW, "azimuth_deg": azimuth_deg}),
                ("set_view", {"view": _EXTRA_VIEW, **orbit}),
                ("set_view", {"view": VIEW, **wrong}),
                ("remove_view", {"view": _EXTRA_VIEW}),
                ("set_param", {"publish": self._chance.choice(("rgb8", "jpeg"))}),
                ("describe", {}),
            )
        )
        self._ask(verb, arguments)

    def _ask(self, verb: str, arguments: dict | None = None) -> Reply | None:
        started_s = time.monotonic()
        try:
            reply = self._client.request(verb, arguments)
        except ControlError:
            self.unanswered += 1
            return None
        self.reply_ms.append(1000 * (time.monotonic() - started_s))
        self.codes[reply.code.value] += 1
        return reply

    def __enter__(self) -> "Operator":
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()
        del self._rig


if __name__ == "__main__":
    main()
