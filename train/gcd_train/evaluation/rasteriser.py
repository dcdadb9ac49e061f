"""Gaussians as a camera sees them, with gradients: in plain torch anywhere, by gsplat on a GPU.

After Kerbl et al. 2023, "3D Gaussian Splatting for Real-Time Radiance Field Rendering", and Zwicker et al. 2001, "EWA
Volume Splatting".
"""

import importlib
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.geometry import Intrinsics
from gcd_train.evaluation.per_scene import Camera

NEAREST_M = 0.2
"""What lies less far ahead of a camera is not drawn."""
LOW_PASS = 0.3
"""Square pixels, added to both variances of a Gaussian in a picture, so that none falls between two pixels."""
FAINTEST, DENSEST = 1 / 255, 0.99
"""Opacity of a Gaussian in a pixel: below, it is not there; and the most."""
_BEYOND = 0.3  # of half a picture: farther beyond its edge the projection is taken to be as it is there
_TILE = 8  # pixels
_NOTHING = -30.0  # logarithm of an opacity that counts as none


@dataclass(frozen=True, kw_only=True, slots=True)
class Gaussians:
    """N Gaussians of one moment, in the world.

    means: float [N, 3], metres. quaternions: [N, 4], w x y z, of any length but 0: from the axes of a Gaussian to the
    world's. scales: [N, 3], standard deviations along its axes, metres. opacities: [N] in the middle, within 0 to 1.
    colours: [N, 3], RGB.
    """

    means: Tensor
    quaternions: Tensor
    scales: Tensor
    opacities: Tensor
    colours: Tensor


@dataclass(frozen=True, kw_only=True, slots=True)
class Picture:
    """What a camera sees of Gaussians.

    colours: [H, W, 3], light of the Gaussians alone. passed: [H, W], share of the light from behind them.
    centres: of the means, in pixels, [..., N, 2]; part of the graph, so that its gradient can be retained.
    """

    colours: Tensor
    passed: Tensor
    centres: Tensor


@lru_cache
def has_gsplat(device: torch.device) -> bool:
    """Whether pictures on this device are drawn by gsplat (extra `gsplat`): where it is CUDA, and one can be drawn."""
    if device.type != "cuda":
        return False
    lens = Intrinsics.from_hfov(60.0, _TILE, _TILE)
    try:
        one = torch.ones(1, 4, device=device)
        ball = Gaussians(means=one[:, :3], quaternions=one, scales=one[:, :3], opacities=one[:, 0], colours=one[:, :3])
        _by_gsplat(ball, Camera(lens=lens, world_from_camera=torch.eye(4), time=0.0))
    except Exception:  # parts that are compiled are missing in many ways
        return False
    return True


def rasterised(gaussians: Gaussians, camera: Camera) -> Picture:
    """By gsplat where the Gaussians are on a CUDA device and it works, else by `rasterised_plainly`."""
    return (_by_gsplat if has_gsplat(gaussians.means.device) else rasterised_plainly)(gaussians, camera)


def _by_gsplat(gaussians: Gaussians, camera: Camera) -> Picture:
    gsplat = importlib.import_module("gsplat")
    colours, covered, more = gsplat.rasterization(
        gaussians.means,
        gaussians.quaternions,
        gaussians.scales,
        gaussians.opacities,
        gaussians.colours,
        viewmats=torch.linalg.inv(camera.world_from_camera)[None].to(gaussians.means),
        Ks=camera.lens.matrix[None].to(gaussians.means),
        width=camera.lens.width,
        height=camera.lens.height,
        near_plane=NEAREST_M,
        eps2d=LOW_PASS,
        packed=False,
    )
    return Picture(colours=colours[0], passed=1.0 - covered[0, ..., 0], centres=more["means2d"])


def rasterised_plainly(gaussians: Gaussians, camera: Camera) -> Picture:
    """Sorted by depth, front to back; each pixel from all Gaussians that count in its tile of 8 x 8.

    Source: Kerbl et al. 2023 (3DGS), section 6 and appendix C.
    """
    centres, variances, inverse, depths = projected(gaussians, camera)
    across, down = -(-camera.lens.width // _TILE), -(-camera.lens.height // _TILE)
    with torch.no_grad():
        reach = 2.0 * (gaussians.opacities / FAINTEST).log().clamp(min=0.0)[:, None]
        half = (reach * variances).sqrt()  # of the box in which it counts
        near_first = ((depths > NEAREST_M) & (gaussians.opacities > FAINTEST)).nonzero()[:, 0]
        near_first = near_first[depths[near_first].argsort(stable=True)]
        tiles, members = _by_tile(centres[near_first], half[near_first], across, down)
        members, counts = near_first[members], torch.bincount(tiles, minlength=across * down)
        starts = counts.cumsum(0) - counts
    table = torch.cat(
        [centres, inverse, gaussians.opacities.clamp(min=FAINTEST).log()[:, None], gaussians.colours], dim=1
    )  # [N, 9]
    light = centres.new_tensor([0.0, 0.0, 0.0, 1.0]).repeat(across * down, _TILE * _TILE, 1)  # of tiles without any
    # lists of a tile differ in length: those of similar lengths are worked out together
    for most in sorted({1 << (count - 1).bit_length() for count in counts.unique().tolist() if count}):
        some = ((counts > most // 2) & (counts <= most)).nonzero()[:, 0]
        place = torch.arange(int(counts[some].max()), device=some.device)
        there = place < counts[some, None]  # [n, K]
        rows = F.embedding(members[torch.where(there, starts[some, None] + place, 0)], table)  # [n, K, 9]
        corner = torch.stack([some % across, some // across], dim=1)[:, None] * _TILE
        faint = torch.where(there, rows[..., 5], _NOTHING)
        log_alpha = faint[..., None] + _exponents(rows[..., :2] - corner, rows[..., 2:5])
        light = light.index_copy(0, some, torch.cat(_Mixed.apply(log_alpha, rows[..., 6:]), dim=-1))
    whole = light.view(down, across, _TILE, _TILE, 4).transpose(1, 2).reshape(down * _TILE, across * _TILE, 4)
    whole = whole[: camera.lens.height, : camera.lens.width]
    return Picture(colours=whole[..., :3], passed=whole[..., 3], centres=centres)


def projected(gaussians: Gaussians, camera: Camera) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """In the picture: means [N, 2], variances [N, 2] and the covariances' inverse [N, 3], xx, xy and yy, in pixels; and
    depths [N] along the optical axis.

        Sigma' = J W Sigma W^T J^T + k I,   Sigma = R S S^T R^T,   k = 0.3
        det Sigma' = |a x b|^2 + k (|a|^2 + |b|^2) + k^2,   a and b the rows of J W R S

    The determinant is so exact for needles, too. W turns the world's axes to the camera's; J is the derivative of the
    projection at the mean. What lies less than `NEAREST_M` ahead has no meaning but its depth.
    Source: Zwicker et al. 2001, section 6.2.2; Kerbl et al. 2023 (3DGS), equations 5 and 6.
    """
    pose, lens = camera.world_from_camera.to(gaussians.means), camera.lens
    x, y, depths = ((gaussians.means - pose[:3, 3]) @ pose[:3, :3]).unbind(dim=1)
    z = depths.clamp(min=NEAREST_M)
    right, below = x / z, y / z
    beyond = _BEYOND * lens.width / lens.fx / 2, _BEYOND * lens.height / lens.fy / 2
    at_x = right.clamp(-lens.cx / lens.fx - beyond[0], (lens.width - lens.cx) / lens.fx + beyond[0])
    at_y = below.clamp(-lens.cy / lens.fy - beyond[1], (lens.height - lens.cy) / lens.fy + beyond[1])
    none = torch.zeros_like(z)
    rows = [torch.stack([lens.fx / z, none, -lens.fx * at_x / z], 1)]
    rows += [torch.stack([none, lens.fy / z, -lens.fy * at_y / z], 1)]
    turned = torch.stack(rows, dim=1) @ pose[:3, :3].T @ rotations(gaussians.quaternions)  # J W R
    half = turned * gaussians.scales[:, None]
    own, (a, b) = half.square().sum(dim=2), half.unbind(dim=1)
    determinant = torch.linalg.cross(a, b).square().sum(dim=1) + LOW_PASS * own.sum(dim=1) + LOW_PASS**2
    variances = own + LOW_PASS
    inverse = torch.stack([variances[:, 1], -(a * b).sum(dim=1), variances[:, 0]], dim=1) / determinant[:, None]
    centres = torch.stack([lens.fx * right + lens.cx, lens.fy * below + lens.cy], dim=1)
    return centres, variances, inverse, depths


def rotations(quaternions: Tensor) -> Tensor:
    """[N, 4], w x y z, of any length but 0 -> [N, 3, 3]."""
    w, x, y, z = F.normalize(quaternions, dim=1).unbind(dim=1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, dim=1).unflatten(1, (3, 3))


def _by_tile(centres: Tensor, half: Tensor, across: int, down: int) -> tuple[Tensor, Tensor]:
    """Tiles, rising, and who reaches into them, [M] each; those of one tile in the order in which they came.

    centres, half: [N, 2], middle and half the sides of boxes in pixels. across, down: so many tiles.
    """
    most = torch.tensor([across, down], device=centres.device)
    first = ((centres - half) / _TILE).floor().clamp(min=0.0).minimum(most).long()
    after = ((centres + half) / _TILE).floor().add(1.0).clamp(min=0.0).minimum(most).long()
    wide, high = (after - first).clamp(min=0).unbind(dim=1)
    many = wide * high
    members = torch.arange(len(centres), device=centres.device).repeat_interleave(many)
    number = torch.arange(len(members), device=centres.device) - (many.cumsum(0) - many)[members]
    column, row = number % wide[members], number // wide[members]
    tiles, order = ((first[members, 1] + row) * across + first[members, 0] + column).sort(stable=True)
    return tiles, members[order]


def _exponents(centres: Tensor, inverse: Tensor) -> Tensor:
    """-d^T Sigma'^-1 d / 2 in the middle of each pixel of a tile, as one product of matrices, [n, K, P].

    centres: [n, K, 2], pixels from the tile's corner. inverse: [n, K, 3], of the covariance: xx, xy and yy.
    """
    line = torch.arange(_TILE, dtype=centres.dtype, device=centres.device) + 0.5
    y, x = (each.flatten() for each in torch.meshgrid(line, line, indexing="ij"))
    (u, v), (xx, xy, yy) = centres.unbind(dim=-1), inverse.unbind(dim=-1)
    to_x, to_y = xx * u + xy * v, xy * u + yy * v
    factors = [-(to_x * u + to_y * v) / 2, to_x, to_y, -xx / 2, -xy, -yy / 2]
    exponents = torch.stack(factors, dim=-1) @ torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y])
    return exponents.clamp_(max=0.0)  # far from a needle's middle what is rounded is large


class _Mixed(torch.autograd.Function):
    """Front to back: colours [n, P, 3] and what light passes, [n, P, 1].

        C = sum over i of c_i w_i,   w_i = alpha_i product over j < i of (1 - alpha_j)

    log_alpha: [n, K, P], nearest first. colours: [n, K, 3]. The gradient is written out: half of autograd's time.
    Source: Kerbl et al. 2023 (3DGS), equation 3 and appendix C.
    """

    @staticmethod
    def forward(ctx: Any, log_alpha: Tensor, colours: Tensor) -> tuple[Tensor, Tensor]:
        alpha = log_alpha.clamp(min=_NOTHING).exp_().clamp_(max=DENSEST)
        alpha *= alpha >= FAINTEST
        passed = (1.0 - alpha).cumprod_(dim=1)
        share = alpha.clone()
        share[:, 1:] *= passed[:, :-1]
        ctx.save_for_backward(alpha, passed[:, -1:], share, colours)
        return share.mT @ colours, passed[:, -1, :, None]

    @staticmethod
    def backward(ctx: Any, *wanted: Tensor) -> tuple[Tensor, Tensor]:
        alpha, passed, share, colours = ctx.saved_tensors
        own = (colours @ wanted[0].mT).mul_(share)  # [n, K, P]
        behind = own.sum(dim=1, keepdim=True).addcmul_(passed, wanted[1].mT) - own.cumsum(dim=1)
        own -= behind.mul_(alpha).div_(1.0 - alpha)
        return own.mul_(alpha < DENSEST), share @ wanted[0]
