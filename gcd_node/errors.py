"""What can go wrong in the node, and the exit code each becomes (sysexits).

    NodeError 70
    ├── UsageError 64, StaleError 69, RemoteError 69, PublisherError 70, ModelFailedError 70
    ├── EndpointError 73, OutputError 73, DamagedRunError 65, ConfigError 78
    └── SourceError 66
        └── TooShortError 65, DepthError 65, SourceAbsentError 69, ReaderError 70, SourceLostError 75

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


class RemoteError(NodeError):
    """A model that computes elsewhere gave no views, or none in time."""

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
