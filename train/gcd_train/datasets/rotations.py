"""Quaternions of data set files as poses."""

import numpy as np
from numpy.typing import NDArray

from gcd_train.errors import DataError
from gcd_train.scenes.description import rotations

_UNIT_TOLERANCE = 0.02


def pose_from_quaternion(quaternions: NDArray[np.float64], positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotations and positions as rigid matrices.

    Args:
        quaternions: f64 [..., 4], w x y z; of length 1 but for rounding, which is taken out.
        positions: f64 [..., 3], metres.
    Returns:
        a_from_b: f64 [..., 4, 4].
    Raises:
        DataError: a number is not finite, or a quaternion is not of length 1.
    """
    lengths = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    if not (np.isfinite(positions).all() and np.isfinite(lengths).all()):
        raise DataError("a pose must be finite, got NaN or infinite numbers")
    if float(np.abs(lengths - 1.0).max()) > _UNIT_TOLERANCE:
        raise DataError(f"a rotation must be a quaternion of length 1, got one of {float(lengths.min()):.3g}")
    poses = np.zeros((*positions.shape[:-1], 4, 4))
    poses[..., :3, :3] = rotations(quaternions / lengths)
    poses[..., :3, 3] = positions
    poses[..., 3, 3] = 1.0
    return poses
