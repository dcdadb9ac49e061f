"""What can go wrong in the node, and the exit code each becomes (sysexits).

    NodeError 70
    ├── UsageError 64         options that contradict each other or make no sense
    ├── SourceError 66        an input is missing, empty, damaged or undecodable; a camera is lost
    │   ├── TooShortError 65      an input has fewer frames than one window
    │   ├── DepthError 65         a depth picture, or a picture that depth is taken from, cannot be used
    │   ├── SourceAbsentError 69  there is no such camera
    │   └── SourceLostError 75    a camera is gone and did not come back
    ├── MessageError 65       bytes that are not a valid message of this protocol
    ├── StaleError 69         a view arrived too old to be used
    ├── EndpointError 73      an endpoint is in use or cannot be bound
    ├── OutputError 73        a result cannot be written
    ├── DamagedRunError 65    the folder of a replay is incomplete, damaged or none
    ├── ModelFailedError 70   the model keeps producing unusable views
    ├── ControlError 70       a command was refused; 69 if nobody answers it
    ├── AuthError 77          a node does not let us in
    └── ConfigError 78        a launch file or a setting is wrong

Every message says what was wanted, what came, and what to do. Standard library only, Python 3.10 syntax: planners
import this.
"""


class NodeError(Exception):
    """Root of all errors of this package."""

    exit_code = 70


class UsageError(NodeError):
    """Options that contradict each other or make no sense."""

    exit_code = 64


class SourceError(NodeError):
    """An input is missing, empty, damaged or undecodable, or a camera is lost."""

    exit_code = 66


class TooShortError(SourceError):
    """An input has fewer frames than one window."""

    exit_code = 65


class DepthError(SourceError):
    """A depth picture, or a picture that depth is taken from, cannot be used; the next one may be."""

    exit_code = 65


class SourceAbsentError(SourceError):
    """There is no such camera; the message lists those there are."""

    exit_code = 69


class SourceLostError(SourceError):
    """A camera is gone and did not come back."""

    exit_code = 75


class MessageError(NodeError):
    """Bytes that are not a valid message of this protocol."""

    exit_code = 65


class StaleError(NodeError):
    """A view arrived too old to be used."""

    exit_code = 69


class EndpointError(NodeError):
    """An endpoint is in use or cannot be bound."""

    exit_code = 73


class OutputError(NodeError):
    """A result cannot be written."""

    exit_code = 73


class DamagedRunError(NodeError):
    """The folder of a replay is incomplete, damaged or none."""

    exit_code = 65


class ModelFailedError(NodeError):
    """The model keeps producing unusable views."""

    exit_code = 70


class ControlError(NodeError):
    """A command was refused, or nobody answers it. code: of the protocol, section 5; None if nobody answered."""

    exit_code = 70

    def __init__(self, message: str, code: "str | None" = None) -> None:
        super().__init__(message)
        self.code = code
        self.exit_code = 70 if code is not None else 69


class AuthError(NodeError):
    """A node does not let us in: it asks for a key, or does not know ours, or is another one than we think."""

    exit_code = 77


class ConfigError(NodeError):
    """A launch file or a setting is wrong."""

    exit_code = 78
