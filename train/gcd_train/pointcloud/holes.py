"""What is shown where no point fell."""

import torch
import torch.nn.functional as F
from torch import Tensor

_LEAST = 1e-7


def fill_holes(
    colour: Tensor, covered: Tensor, *, kernel: int = 21, sigma: float = 5.25, blur_sigma: float = 0.6
) -> Tensor:
    """Holes take the weighted mean of what is around them; then the whole picture is blurred a little.

        filled = G(colour * covered) / max(G(covered), 1e-7)        where not covered, G a Gaussian of `kernel` pixels

    Holes with nothing covered within the kernel stay black. Pictures go on beyond their edges mirrored.

    Args:
        colour: float32 [H, W, C]. covered: bool [H, W].
        kernel, sigma: of the filling, pixels; kernel is odd. blur_sigma: of the 3 x 3 blur over everything.
    Returns:
        [H, W, C].
    Source: Generative Camera Dolly, point renderer as released; the mirrored edges are our reading.
    """
    held = covered[..., None].to(colour.dtype)
    blurred = _blur(torch.cat([colour * held, held], dim=-1), kernel, sigma)
    filled = torch.where(covered[..., None], colour, blurred[..., :-1] / blurred[..., -1:].clamp(min=_LEAST))
    return _blur(filled, 3, blur_sigma)


def _blur(picture: Tensor, kernel: int, sigma: float) -> Tensor:
    """[H, W, C] through a Gaussian, one axis after the other."""
    reach = kernel // 2
    away = torch.arange(-reach, reach + 1, device=picture.device, dtype=picture.dtype)
    weights = torch.softmax(-(away**2) / (2 * sigma**2), dim=0)
    planes = F.pad(picture.permute(2, 0, 1)[:, None], (reach, reach, reach, reach), mode="reflect")  # [C, 1, H, W]
    planes = F.conv2d(F.conv2d(planes, weights.view(1, 1, 1, -1)), weights.view(1, 1, -1, 1))
    return planes[:, 0].permute(1, 2, 0)
