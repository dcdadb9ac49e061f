"""The life of a node as ROS 2 counts it: states, the transitions between them, nothing else (wire protocol, section 6).

    unconfigured --configure--> inactive --activate--> active
         ^            cleanup      |  ^   deactivate      |
         +-------------------------+  +-------------------+          shutdown from each of the three: finalized

Pure: the holder of a `Lifecycle` does the work between `begin` and its outcome. The states of the source and of the
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
        """Whether the node stays here until a command comes."""
        return self <= State.FINALIZED


_LIVING = frozenset({State.UNCONFIGURED, State.INACTIVE, State.ACTIVE})
PATHS: Mapping[Verb, tuple[frozenset[State], State, State]] = types.MappingProxyType(
    {
        "configure": (frozenset({State.UNCONFIGURED}), State.CONFIGURING, State.INACTIVE),
        "activate": (frozenset({State.INACTIVE}), State.ACTIVATING, State.ACTIVE),
        "deactivate": (frozenset({State.ACTIVE}), State.DEACTIVATING, State.INACTIVE),
        "cleanup": (frozenset({State.INACTIVE}), State.CLEANINGUP, State.UNCONFIGURED),
        "shutdown": (_LIVING, State.SHUTTINGDOWN, State.FINALIZED),
    }
)
"""Of each verb: where it may be asked, the state meanwhile, and where it leads."""


class Lifecycle:
    """Where a node stands. One transition at a time: `begin`, then one of `succeed`, `fail` and `error`."""

    def __init__(self) -> None:
        self.state = self._from = self._to = State.UNCONFIGURED
        """state: where it stands now; changed here alone."""

    def refusal(self, verb: Verb) -> str | None:
        """Why `verb` cannot be begun now; None if it can."""
        allowed, passing, goal = PATHS[verb]
        if self.state in allowed:
            return None
        expected = " or ".join(sorted(state.label for state in allowed))
        busy = "" if self.state.settled else "; wait until that is over"
        already = " already" if self.state in (passing, goal) else ""
        return f"{verb} is for a node that is {expected}, this one is {self.state.label}{already}{busy}"

    def begin(self, verb: Verb) -> None:
        """Enter the state between.

        Raises:
            ControlError: WRONG_STATE; nothing has changed.
        """
        refusal = self.refusal(verb)
        if refusal is not None:
            raise ControlError(refusal, "WRONG_STATE")
        _, passing, goal = PATHS[verb]
        self._from, self._to, self.state = self.state, goal, passing

    def succeed(self) -> None:
        """The work was done: go where the transition leads."""
        self.state = self._to

    def fail(self) -> None:
        """It could not be done, and nothing has changed: back to where it was begun."""
        self.state = self._from

    def error(self) -> None:
        """Something broke on the way: what still stands is unknown."""
        self.state = State.ERRORPROCESSING

    def recover(self, *, cleaned: bool) -> None:
        """After `error`: everything was let go, so that configuring can start anew; or it could not be."""
        self.state = State.UNCONFIGURED if cleaned else State.FINALIZED
