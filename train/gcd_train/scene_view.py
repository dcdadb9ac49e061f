"""One camera's picture of one moment of a scene: what generators write and readers give back."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics

Bytes = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneView:
    """Colour, depth and labels of one picture, and where its camera was.

    rgb: u8 [H, W, 3]. depth: f32 [H, W], metres along the optical axis, 0 where nothing is known. classes: u8 [H, W],
    ids of the ontology, None where the set has none. instances: u16 [H, W], 0 for what is not counted, None where the
    set has none. world_from_camera: f64 [4, 4]; x right, y down, z ahead; the world is right-handed with z up, metres.
    lens: pixels.
    """

    rgb: Bytes
    depth: NDArray[np.float32]
    classes: Bytes | None
    instances: NDArray[np.uint16] | None
    world_from_camera: NDArray[np.float64]
    lens: Intrinsics
