"""A scene ready to draw, and as a file: triangles and where their bodies are, so that any camera can look at it later.

A scene folder keeps one, and a target view can be drawn exactly along any path, without simulating anything again.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Self

import msgspec
import numpy as np

from gcd_model.small_files import decode_json
from gcd_train.data.files import read_npz
from gcd_train.errors import DataError
from gcd_train.scenes.compile import VERTEX, Vertices, vertices_of
from gcd_train.scenes.description import STREET, Extent, Floats, Light, Scene

_FORMAT = 2


@dataclass(frozen=True, kw_only=True, slots=True)
class FrozenScene:
    """What the renderer needs.

    vertices: [N] of `compile.VERTEX`, three in a row are a triangle, in their bodies' frames. The rest as in `Scene`.
    """

    vertices: Vertices
    poses: Floats
    focus: Floats
    hfov_deg: float
    light: Light
    extent: Extent = STREET

    @property
    def frames(self) -> int:
        """T."""
        return self.poses.shape[0]

    def save(self, file: BinaryIO) -> None:
        """Write it as a compressed npz."""
        facts = _Facts(format=_FORMAT, hfov_deg=self.hfov_deg, light=self.light, extent=self.extent)
        told = np.frombuffer(msgspec.json.encode(facts), np.uint8)
        raw = self.vertices.view(np.uint8).reshape(-1, VERTEX.itemsize)
        np.savez_compressed(file, vertices=raw, poses=self.poses, focus=self.focus, facts=told)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what `save` wrote. Raises DataError if the file is missing, damaged or of another version."""
        try:
            arrays: dict[str, Any] = read_npz(path)
            facts = decode_json(arrays["facts"].tobytes(), _Facts)
            if facts.format != _FORMAT:
                raise ValueError(f"its format is {facts.format}, this version reads {_FORMAT}")
            return cls(
                vertices=arrays["vertices"].reshape(-1).view(VERTEX),
                poses=arrays["poses"].astype(np.float32),
                focus=arrays["focus"].astype(np.float32),
                hfov_deg=facts.hfov_deg,
                light=facts.light,
                extent=facts.extent,
            )
        except Exception as error:  # numpy and zipfile raise many kinds for a damaged file
            raise DataError(f"{path} is no drawable scene ({error}); generate the scene again") from error


class _Facts(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    format: int
    hfov_deg: float
    light: Light
    extent: Extent


def freeze(scene: Scene) -> FrozenScene:
    """A scene's triangles and motion, without its cameras."""
    return FrozenScene(
        vertices=vertices_of(scene),
        poses=scene.poses,
        focus=scene.focus,
        hfov_deg=scene.hfov_deg,
        light=scene.light,
        extent=scene.extent,
    )
