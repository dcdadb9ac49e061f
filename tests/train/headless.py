"""For tests that draw: a mark, and all pictures of a scene."""

import pytest

from gcd_train.errors import RenderError
from gcd_train.scenes.description import Scene
from gcd_train.scenes.renderer import Renderer, Rendering
from gcd_train.scenes.triangles import freeze


def _can_draw() -> bool:
    try:
        Renderer(16, 16).close()
    except RenderError:
        return False
    return True


needs_egl = pytest.mark.skipif(
    not _can_draw(),
    reason="needs headless OpenGL: pip install 'gcd-node[scenes]', apt-get install libegl1 libgl1-mesa-dri",
)


def drawn(scene: Scene, width: int, height: int, oversample: int = 1) -> dict[str, Rendering]:
    """By camera, at all time steps."""
    with Renderer(width, height, oversample=oversample) as renderer:
        return renderer.render(freeze(scene), scene.cameras)
