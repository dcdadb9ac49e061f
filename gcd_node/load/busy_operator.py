"""Somebody who commands a node all the time: moves views, adds and removes one, changes parameters, restarts it."""

import random
import time
from array import array
from collections import Counter, deque

from gcd_node.control.client import ControlClient
from gcd_node.control.message import Code, Reply
from gcd_node.errors import ControlError
from gcd_node.load.rig import VIEW, Rig

_TIMEOUT_S = 5.0
_EVERY_S = 0.5
_EXTRA = "extra"
_FROM = {"deactivate": "active", "cleanup": "inactive", "configure": "unconfigured", "activate": "inactive"}


class BusyOperator:
    """Call `step` often; it asks twice a second. Belongs to one thread; use it as a context manager.

    reply_s: how long each reply took. codes: what came back. unanswered: nothing came in 5 s. restarts: times the
    stream was stopped and started, every fifth time the model is given back too.
    """

    def __init__(self, rig: Rig, *, restart_s: float, seed: int) -> None:
        """restart_s: from one restart to the next."""
        self._rig, self._restart_s = rig, restart_s
        self._chance = random.Random(seed)  # noqa: S311  commands are no secrets
        self._client = ControlClient(rig.control, timeout_s=_TIMEOUT_S, attempts=1)
        self._plan: deque[str] = deque()
        self._next_s = self._restarted_s = time.monotonic()
        self.reply_s = array("d")
        self.codes: Counter[str] = Counter()
        self.unanswered = self.restarts = 0

    def step(self) -> None:
        """Ask what is due, if anything."""
        now_s = time.monotonic()
        if now_s < self._next_s:
            return
        self._next_s = now_s + _EVERY_S
        if now_s - self._restarted_s > self._restart_s and not self._plan:
            self._restarted_s = now_s
            self.restarts += 1
            deep = self.restarts % 5 == 0
            self._plan.extend(("deactivate", "cleanup", "configure") if deep else ("deactivate",))
        self._go_on()
        self._ask("stats")
        self._change()

    def close(self) -> None:
        """Close the connection."""
        self._client.close()

    def __enter__(self) -> "BusyOperator":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _go_on(self) -> None:
        """With the restart, as far as the state allows; and never leave the node inactive."""
        state = self._rig.node.state.label
        if self._plan:
            if state == _FROM[self._plan[0]] and self._accepted(self._ask(self._plan[0])):
                self._plan.popleft()
        elif state == "inactive":
            self._ask("activate")

    def _change(self) -> None:
        draw = self._chance.randrange(6)
        azimuth_deg = self._chance.uniform(-60.0, 60.0)
        if draw == 0:
            self._ask("set_view", {"view": VIEW, "azimuth_deg": azimuth_deg})
        elif draw == 1:
            self._ask("set_view", {"view": _EXTRA, "kind": "orbit", "rate_deg_s": 5.0, "amplitude_deg": 30.0})
        elif draw == 2:
            self._ask("remove_view", {"view": _EXTRA})
        elif draw == 3:
            self._ask("set_param", {"publish": self._chance.choice(("rgb8", "jpeg"))})
        elif draw == 4:
            self._ask("set_view", {"view": VIEW, "azimuth_deg": 10 * azimuth_deg, "elevation_deg": 85.0})
        else:
            self._ask("describe")

    def _ask(self, verb: str, args: dict[str, object] | None = None) -> Reply | None:
        started_s = time.monotonic()
        try:
            reply = self._client.request(verb, args)
        except ControlError:
            self.unanswered += 1
            return None
        self.reply_s.append(time.monotonic() - started_s)
        self.codes[reply.code.value] += 1
        return reply

    def _accepted(self, reply: Reply | None) -> bool:
        return reply is not None and reply.code is Code.ACCEPTED
