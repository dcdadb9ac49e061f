"""What the metrics ask of the shapes they are given."""

from torch import Tensor

from gcd_model.errors import ShapeError


def require_same_shape(first: Tensor, second: Tensor) -> None:
    """Raises ShapeError unless a view and its target have one shape."""
    if first.shape != second.shape:
        raise ShapeError(f"view and target must have one shape, got {list(first.shape)} and {list(second.shape)}")


def require_mask(mask: Tensor, frames: int, height: int, width: int) -> None:
    """Raises ShapeError unless a mask has one truth value for each pixel of each frame."""
    if tuple(mask.shape) != (frames, height, width):
        raise ShapeError(f"a mask must be [T, H, W] = [{frames}, {height}, {width}], got {list(mask.shape)}")
