"""The life of a node as ROS 2 counts it: states, the transitions between them, nothing else (wire protocol, section 6).

    unconfigured --configure--> inactive --activate--> active
         ^            cleanup      |  ^   deactivate      |
         +-------------------------+  +-------------------+          shutdown from each of the three: finalized

Pure: whoever holds a `Lifecycle` does the work between `begin` and its outcome. The states of the source and of the
model are beside this one: a lost source does not leave active.
"""

import enum
import types
from collections.abc import Mapping
from typing import Literal, TypeAlias

from gcd_client.control import ControlError

Verb: TypeAlias = Literal["configure", "activate", "deactivate", "cleanup", "shutdown"]
"""What may be asked of a node's life."""


class State(enum.IntEnum):
    """The primary states 1 to 4, and those a node passes through; the numbers are ROS 2's lifecycle ids."""

    UNCONFIGURED = 1
    INACTIVE = 2
    ACTIVE = 3
    FINALIZED = 4
    CONFIGURING = 10
    CLEANINGUP = 11
    SHUTTINGDOWN = 12
    ACTIVATING = 13
    DEACTIVATING = 14
    ERRORPROCESSING = 15

    @property
    def label(self) -> str:
        """As it is said on the wire: lower case."""
        return self.name.lower()

    @property
    def settled(self) -> bool:
        """Whether the node stays here until somebody asks for something."""
        return self <= State.FINALIZED


PATHS: Mapping[Verb, tuple[frozenset[State], State, State]] = types.MappingProxyType(
    {
        "configure": (frozenset({State.UNCONFIGURED}), State.CONFIGURING, State.INACTIVE),
        "activate": (frozenset({State.INACTIVE}), State.ACTIVATING, State.ACTIVE),
        "deactivate": (frozenset({State.ACTIVE}), State.DEACTIVATING, State.INACTIVE),
        "cleanup": (frozenset({State.INACTIVE}), State.CLEANINGUP, State.UNCONFIGURED),
        "shutdown": (
            frozenset({State.UNCONFIGURED, State.INACTIVE, State.ACTIVE}),
            State.SHUTTINGDOWN,
            State.FINALIZED,
        ),
    }
)
"""Of each verb: where it may be asked, the state meanwhile, and where it leads."""


class Lifecycle:
    """Where a node stands. One transition at a time: `begin`, then one of `succeed`, `fail` and `error`."""

    def __init__(self) -> None:
        self._state = State.UNCONFIGURED
        self._from = State.UNCONFIGURED
        self._to = State.UNCONFIGURED

    @property
    def state(self) -> State:
        """Where it stands now."""
        return self._state

    def refusal(self, verb: Verb) -> str | None:
        """Why `verb` cannot be begun now; None if it can."""
        allowed, passing, _ = PATHS[verb]
        if self._state in allowed:
            return None
        wanted = " or ".join(sorted(state.label for state in allowed))
        busy = "" if self._state.settled else "; wait until that is over"
        done = " already" if self._state in (passing, self._goal(verb)) else ""
        return f"{verb} is for a node that is {wanted}, this one is {self._state.label}{done}{busy}"

    def begin(self, verb: Verb) -> None:
        """Enter the state between.

        Raises:
            ControlError: WRONG_STATE; nothing has changed.
        """
        refusal = self.refusal(verb)
        if refusal is not None:
            raise ControlError(refusal, "WRONG_STATE")
        _, passing, goal = PATHS[verb]
        self._from, self._to, self._state = self._state, goal, passing

    def succeed(self) -> State:
        """The work was done: go where the transition leads."""
        self._require_underway()
        self._state = self._to
        return self._state

    def fail(self) -> State:
        """It could not be done, and nothing has changed: back to where it was begun."""
        self._require_underway()
        self._state = self._from
        return self._state

    def error(self) -> None:
        """Something broke on the way, or while the node was settled: nobody knows what still stands."""
        if self._state is State.FINALIZED:
            raise ControlError("a finalized node does not break any more", "WRONG_STATE")
        self._state = State.ERRORPROCESSING

    def recover(self, *, cleaned: bool) -> State:
        """After `error`: everything was let go, so that configuring can start anew; or it could not be."""
        if self._state is not State.ERRORPROCESSING:
            raise ControlError(f"only an error is recovered from, the node is {self._state.label}", "WRONG_STATE")
        self._state = State.UNCONFIGURED if cleaned else State.FINALIZED
        return self._state

    @staticmethod
    def _goal(verb: Verb) -> State:
        return PATHS[verb][2]

    def _require_underway(self) -> None:
        if self._state.settled or self._state is State.ERRORPROCESSING:
            raise ControlError(f"no transition is under way, the node is {self._state.label}", "WRONG_STATE")
