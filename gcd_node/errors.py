"""What can go wrong in the node, and the exit code each becomes (sysexits).

    NodeError 70
    ├── UsageError 64         options that contradict each other or make no sense
    ├── SourceError 66        an input is missing, empty, damaged or undecodable; a camera is lost
    │   ├── TooShortError 65      an input has fewer frames than one window
    │   ├── DepthError 65         a depth picture, or a picture that depth is taken from, cannot be used
    │   ├── SourceAbsentError 69  there is no such camera
    │   ├── ReaderError 70        reading or placing frames broke: nobody foresaw how
    │   └── SourceLostError 75    a camera is gone and did not come back
    ├── StaleError 69         no fresh status came in time
    ├── EndpointError 73      an endpoint is in use or cannot be bound
    ├── PublisherError 70     the publisher thread has died
    ├── OutputError 73        a result cannot be written
    ├── DamagedRunError 65    the folder of a replay is incomplete, damaged or none
    ├── ModelFailedError 70   the model keeps producing unusable views
    └── ConfigError 78        a launch file or a setting is wrong

Messages, commands, endpoints and keys have the client's errors (gcd_client.ClientError), with exit codes of the same
kind. Every message says what was wanted, what came, and what to do.
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


class ReaderError(SourceError):
    """Reading frames, or placing them in windows, broke in a way that nobody foresaw."""

    exit_code = 70


class SourceLostError(SourceError):
    """A camera is gone and did not come back."""

    exit_code = 75


class StaleError(NodeError):
    """No fresh status came in time."""

    exit_code = 69


class EndpointError(NodeError):
    """An endpoint is in use or cannot be bound."""

    exit_code = 73


class PublisherError(NodeError):
    """The publisher thread has died."""


class OutputError(NodeError):
    """A result cannot be written."""

    exit_code = 73


class DamagedRunError(NodeError):
    """The folder of a replay is incomplete, damaged or none."""

    exit_code = 65


class ModelFailedError(NodeError):
    """The model keeps producing unusable views."""


class ConfigError(NodeError):
    """A launch file or a setting is wrong."""

    exit_code = 78
