"""A node behind the control socket that only remembers what it was told."""

import threading
import time
from collections.abc import Mapping

from cameras import until

from gcd_client.control import Code
from gcd_node.auth import Role
from gcd_node.errors import NodeError
from gcd_node.verbs import Command, Outcome, RequestError, SetView


class FakeCommands:
    """Counts; knows one view, `top`, whose revision rises with each accepted set_view."""

    def __init__(self) -> None:
        self.heard: list[tuple[Command, Role]] = []
        self.view_rev = 1
        self.result: object = None

    def handle(self, command: Command, role: Role) -> Outcome:
        self.heard.append((command, role))
        if command.verb == "set_view":
            return self._set_view(command)
        if command.verb == "activate":
            return Outcome(code=Code.ACCEPTED, message="opening the source")
        if command.verb == "configure":
            raise NodeError("no model here")
        if command.verb == "cleanup":
            raise ZeroDivisionError("a secret of the code")
        if command.verb == "stats":
            return Outcome(result=self.result)  # pyright: ignore[reportArgumentType]  whatever the test puts there
        return Outcome(result={"role": role})

    def _set_view(self, command: Command) -> Outcome:
        assert isinstance(command.args, SetView)
        if command.args.view != "top":
            return Outcome(code=Code.UNKNOWN_VIEW, message="known are top", result={"views": ["top"]})
        if command.if_view_rev not in (None, self.view_rev):
            message = f"the view has revision {self.view_rev}"
            return Outcome(code=Code.WRONG_STATE, message=message, result={"view_rev": self.view_rev})
        if abs(command.args.azimuth_deg or 0.0) > 90:
            result: dict[str, object] = {"allowed": {"azimuth_deg": [-90, 90]}}
            raise RequestError("azimuth_deg is beyond what the model was trained with", Code.OUT_OF_RANGE, "", result)
        if not command.dry_run:
            self.view_rev += 1
        return Outcome(result={"view_rev": self.view_rev})


class Events:
    """An event sink that can be waited for."""

    def __init__(self) -> None:
        self.seen: list[tuple[str, dict[str, object]]] = []
        self._lock = threading.Lock()

    def __call__(self, code: str, level: int, fields: Mapping[str, object]) -> None:
        with self._lock:
            self.seen.append((code, {"level": int(level), **fields}))

    def codes(self) -> list[str]:
        with self._lock:
            return [code for code, _ in self.seen]

    def wait(self, code: str) -> dict[str, object]:
        """The fields of the first event with this code."""
        until(lambda: code in self.codes())
        return next(fields for each, fields in self.seen if each == code)

    def within(self, code: str, seconds: float) -> bool:
        """Whether there was an event with this code before so many seconds have passed."""
        until = time.monotonic() + seconds
        while code not in self.codes():
            if time.monotonic() >= until:
                return False
            time.sleep(0.005)
        return True
