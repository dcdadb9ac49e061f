"""What can go wrong in the model package.

    ModelError
    ├── ShapeError        a tensor has the wrong shape, length or size; also a ValueError
    ├── PoseError         a pose is not rigid, not finite or not usable; also a ValueError
    │   ├── ViewRangeError    a view lies outside the limits the checkpoint was trained for
    │   └── ViewFixedError    the checkpoint has one fixed view and takes no camera command
    ├── CheckpointError   a file is missing, damaged, hostile or of another architecture
    ├── AlignmentError    two pictures do not tell where one camera stands in the axes of the other
    ├── FileError         a small text file cannot be read or decoded; also a ValueError
    ├── OptionError       a setting is missing, unknown or contradicts the checkpoint; also a ValueError
    ├── DeviceMemoryError the device ran out of memory; what it held for the call is free again
    ├── NonFiniteError    the network produced NaN or Inf
    └── Cancelled         the caller asked to stop; noticed between two denoising steps

Every message says what was wanted, what came, and what to do.
"""


class ModelError(Exception):
    """Root of all errors of this package."""


class ShapeError(ModelError, ValueError):
    """A tensor has the wrong shape, length or size."""


class PoseError(ModelError, ValueError):
    """A pose is not rigid, not finite or not usable here."""


class ViewRangeError(PoseError):
    """A view lies outside the limits the checkpoint was trained for.

    allowed: {"azimuth_deg": (low, high), ...}, the intervals that would have been accepted.
    """

    def __init__(self, message: str, allowed: dict[str, tuple[float, float]]) -> None:
        super().__init__(message)
        self.allowed = allowed


class ViewFixedError(PoseError):
    """The checkpoint has one fixed view and takes no camera command."""


class CheckpointError(ModelError):
    """A file is missing, damaged, hostile or of another architecture. Nothing was loaded."""


class AlignmentError(ModelError):
    """Two pictures do not tell where one camera stands in the axes of the other."""


class FileError(ModelError, ValueError):
    """A small text file cannot be read or decoded. The message begins where the file's name ends."""


class OptionError(ModelError, ValueError):
    """A setting is missing, unknown or contradicts the checkpoint."""


class DeviceMemoryError(ModelError):
    """The device ran out of memory; what it held for the call is free again."""


class NonFiniteError(ModelError):
    """The network produced NaN or Inf; the view must not be used."""


class Cancelled(ModelError):  # noqa: N818  the caller's wish, not a fault
    """The caller asked to stop; noticed between two denoising steps."""
