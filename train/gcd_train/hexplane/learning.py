"""From pictures of one clip to its field, and from the field to other pictures."""

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_train.errors import DataError
from gcd_train.hexplane.bounds import SceneBounds
from gcd_train.hexplane.field import HexField
from gcd_train.hexplane.posed_pictures import Camera, PosedPicture, RayTable, narrowed, taken
from gcd_train.hexplane.rendering import render
from gcd_train.hexplane.settings import HexPlaneSettings

_RAYS_AT_ONCE = 4096
"""Rays drawn together without gradients: 4096 rays of 48 samples with 48 features are 38 MB."""


def learn(
    pictures: Sequence[PosedPicture],
    bounds: SceneBounds,
    settings: HexPlaneSettings,
    *,
    frames: int,
    seed: int = 0,
    device: str = "auto",
    progress: Callable[[int, float], None] | None = None,
) -> HexField:
    """The field that shows the pictures again.

    Args:
        pictures: of one scene, with their cameras. frames: T of the clip. seed: of weights, rays and samples.
        device: "auto" (CUDA where there is one), or as torch names it; the field stays there.
        progress: called after each update with its number and the mean squared error of its rays.
    Returns:
        On the CPU the same field for the same pictures, settings, seed and number of threads.
    Raises:
        DataError: there is no picture.
    """
    if not pictures:
        raise DataError("HexPlane learns from pictures, got none; give at least the source clip")
    place, generator = _device(device), torch.Generator().manual_seed(seed)
    table = RayTable.of([picture.narrowed(settings.picture_width) for picture in pictures], place)
    field = HexField(bounds, frames, settings, generator).to(place)
    done = 0
    for stage, side in enumerate(settings.sides, start=1):
        field.planes.refine(side)
        optimiser = _optimiser(field, settings)
        end = settings.updates * stage // len(settings.sides)
        for number in range(done, end):
            _set_rates(optimiser, settings, number)
            error = _update(field, optimiser, table.drawn(settings.rays, generator), settings, generator)
            if progress is not None:
                progress(number, error)
        done = end
    return field.eval()


@torch.no_grad()
def draw(field: HexField, camera: Camera, settings: HexPlaneSettings) -> Tensor:
    """The picture of a camera, float32 [3, H, W] on the CPU, in [0, 1], in the size of its lens."""
    lens = narrowed(camera.lens, settings.picture_width)
    rays = Camera(lens=lens, world_from_camera=camera.world_from_camera, time=camera.time).rays()
    rows: list[Tensor] = []
    for start in range(0, lens.width * lens.height, _RAYS_AT_ONCE):
        some = taken(rays, slice(start, start + _RAYS_AT_ONCE)).to(field.planes.space.device)
        rows.append(render(field, some, coarse=settings.coarse, fine=settings.fine).cpu())
    picture = torch.cat(rows).T.reshape(3, lens.height, lens.width)
    size = (camera.lens.height, camera.lens.width)
    if picture.shape[1:] == size:
        return picture
    return F.interpolate(picture[None], size=size, mode="bicubic", align_corners=False)[0].clamp(0.0, 1.0)


def _device(name: str) -> torch.device:
    if name != "auto":
        return torch.device(name)
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def _update(
    field: HexField,
    optimiser: torch.optim.Optimizer,
    batch: RayTable,
    settings: HexPlaneSettings,
    generator: torch.Generator,
) -> float:
    shown = render(field, batch.rays, coarse=settings.coarse, fine=settings.fine, generator=generator)
    error = F.mse_loss(shown, batch.colours)
    optimiser.zero_grad(set_to_none=True)
    (error + settings.smoothness * field.planes.roughness()).backward()
    optimiser.step()
    return float(error.detach())


def _optimiser(field: HexField, settings: HexPlaneSettings) -> torch.optim.Adam:
    planes = list(field.planes.parameters())
    heads = [weight for name, weight in field.named_parameters() if not name.startswith("planes.")]
    return torch.optim.Adam(
        [{"params": planes, "lr": settings.plane_rate}, {"params": heads, "lr": settings.head_rate}],
        betas=(0.9, 0.99),
    )


def _set_rates(optimiser: torch.optim.Optimizer, settings: HexPlaneSettings, number: int) -> None:
    """Both rates fall evenly on a logarithmic scale, to a tenth at the end."""
    share = 0.1 ** (number / settings.updates)
    for group, rate in zip(optimiser.param_groups, (settings.plane_rate, settings.head_rate), strict=True):
        group["lr"] = rate * share
