"""A node behind the control socket that only remembers what it was told."""

from collections.abc import Mapping
from typing import Any

from cameras import until

from gcd_client.control import Code
from gcd_node.auth import Role
from gcd_node.control import ControlServer
from gcd_node.errors import NodeError
from gcd_node.verbs import Command, Outcome, RequestError, SetView


class FakeNode:
    """Knows one view, `top`, whose revision rises with each set_view."""

    def __init__(self) -> None:
        self.heard: list[Command] = []
        self.view_rev = 1
        self.result: Any = None
        self.events: list[tuple[str, dict[str, object]]] = []

    def serve(self, endpoint: str, **options: Any) -> ControlServer:
        return ControlServer(endpoint, self.handle, lambda: "active", self.event, **options)

    def handle(self, command: Command, role: Role) -> Outcome:
        self.heard.append(command)
        match command.verb:
            case "set_view":
                assert isinstance(command.args, SetView)
                if abs(command.args.azimuth_deg or 0.0) > 90:
                    allowed: dict[str, object] = {"allowed": {"azimuth_deg": [-90, 90]}}
                    raise RequestError("azimuth_deg is beyond what was trained", Code.OUT_OF_RANGE, "", allowed)
                self.view_rev += 1
                return Outcome(result={"view_rev": self.view_rev})
            case "configure":
                raise NodeError("no model here")
            case "cleanup":
                raise ZeroDivisionError("a secret of the code")
            case "stats":
                return Outcome(result=self.result)
            case _:
                return Outcome(result={"role": role})

    def event(self, code: str, level: int, fields: Mapping[str, object]) -> None:
        self.events.append((code, {"level": int(level), **fields}))

    @property
    def codes(self) -> list[str]:
        """Of the events so far."""
        return [code for code, _ in self.events]

    def await_event(self, code: str) -> dict[str, object]:
        """The fields of the first event with this code."""
        until(lambda: code in self.codes)
        return next(fields for each, fields in self.events if each == code)
