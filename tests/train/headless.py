"""A mark for tests that draw."""

import pytest

from gcd_train.errors import RenderError
from gcd_train.scenes.renderer import Renderer


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
