"""How an activation ends: what the event says, and what becomes of the source."""

from gcd_node.errors import ConfigError, EndpointError, SourceError, TooShortError
from gcd_node.health.report import SourceState

LASTING = ("TOO_SHORT", "SRC_REFUSED", "NOT_DELIVERED")
"""Reasons that stay in the node's health until the next activation."""


def ending(failure: Exception | None, *, stopped: bool) -> tuple[str, SourceState]:
    """Event code, and the state of the source, after an activation that ended with this failure, or by itself.

    stopped: somebody wanted it to end.
    """
    if isinstance(failure, TooShortError):
        return "TOO_SHORT", "ended"
    if isinstance(failure, SourceError):
        return "SRC_LOST", "lost"
    if isinstance(failure, ConfigError):
        return "SRC_REFUSED", "closed"
    if isinstance(failure, EndpointError):
        return "NOT_DELIVERED", "closed"
    if failure is not None:
        return "MODEL_FAILED", "closed"
    return ("STOPPED", "closed") if stopped else ("SRC_ENDED", "ended")
