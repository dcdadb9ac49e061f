"""A first rendering for nobody, so that the first window does not pay for what happens only once."""

from collections.abc import Sequence

import torch

from gcd_model import CameraMount, Clip, OptionError, RenderOptions, Traits, Trajectory, ViewSynthesizer


def render_grey(
    synthesizer: ViewSynthesizer, paths: Sequence[Trajectory], mount: CameraMount | None, options: RenderOptions
) -> None:
    """Render a grey clip along paths, encoded a frame at a time as windows are.

    Args:
        mount: of the source camera.
    Raises:
        NonFiniteError, DeviceMemoryError, Cancelled: see ViewSynthesizer.render.
    """
    traits = synthesizer.traits
    grey = Clip(video=torch.zeros(1, 3, *_size(traits)), fps=traits.fps, mount=mount)
    encoded = synthesizer.encode(grey)
    synthesizer.render(encoded.followed_by(*[encoded] * (traits.config.frames - 1)), paths, options)


def _size(traits: Traits) -> tuple[int, int]:
    """Height and width of the clip to warm up with: half of each on a CPU, where a whole rendering takes longer than
    all that happens only once, and puts off the first view."""
    height, width = traits.config.height, traits.config.width
    if traits.device != "cpu":
        return height, width
    try:
        traits.check_size(height // 2, width // 2)
    except OptionError:
        return height, width
    return height // 2, width // 2
