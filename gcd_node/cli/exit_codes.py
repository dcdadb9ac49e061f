"""The exit codes of the model's errors (sysexits); the node's own carry theirs."""

from gcd_model import (
    Cancelled,
    CheckpointError,
    DeviceMemoryError,
    ModelError,
    NonFiniteError,
    OptionError,
    PoseError,
    ShapeError,
)

EXIT_CODES: tuple[tuple[type[ModelError], int], ...] = (
    (CheckpointError, 65),
    (OptionError, 64),
    (PoseError, 64),
    (ShapeError, 65),
    (DeviceMemoryError, 70),
    (NonFiniteError, 70),
    (Cancelled, 130),
    (ModelError, 70),
)
"""The first that fits holds."""


def exit_code_of(error: Exception) -> int | None:
    """None for what is no error of the model."""
    return next((code for kind, code in EXIT_CODES if isinstance(error, kind)), None)
