"""Oriented points, and how a target camera sees them: no weights, one depth test over all moments.

    depth + colour + label --unproject--> Surfels --splat--> Splat

A surfel is one source pixel as a small piece of surface. It knows where the surface goes towards the next pixel, so in
the target picture it covers a parallelogram: neighbours share edges, and nothing falls apart where the target
magnifies. Nothing here has gradients; on the CPU the same inputs give the same bits.
"""

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from gcd_model.geometry import Intrinsics, invert_rigid

_NEAREST_M = 0.1
"""Points nearer to the target camera than this, or behind it, are not drawn."""
_SAME_SURFACE_JUMP = 0.05
"""Relative depth step between neighbours up to which they are one surface: more is an edge, or a grazing plane."""
_IN_LINE = 0.3
"""On a plane 1/z is linear over the picture: three pixels whose two steps of 1/z agree this well are one surface. It
saves the ground, which jumps by more than 5 % a row from 20 rows below the horizon upwards."""
_STEEPEST = 0.5
"""Largest relative step of 1/z from pixel to pixel; beyond, a surfel would reach behind the camera."""
_REACH_PX = 8.0
"""A surfel is drawn at most this far from its middle; a larger one would smear a single pixel over the picture."""
_BEHIND = 0.03
"""A fragment this much farther than the nearest surface of its pixel, relatively, still belongs to that surface."""
_CORE = 0.55
"""Part of a footprint that hides what lies behind; the tails beyond overlap with the neighbours."""
_TAIL = 2.0**60
"""Puts the depth of all tails behind that of all cores, exactly."""
_EDGE = 0.98
"""Part of a footprint that is drawn; at its very edge a fragment is not worth its time."""
_OLD_WEIGHT = 0.1
"""Weight of an earlier moment beside this frame's surfels on the same surface."""
_PAINTED_WEIGHT = 0.01
"""Weight of what was painted beside what was seen on the same surface."""
_SIDES = (2, 3, 4, 8, 17)
"""Footprints are drawn in groups of these widths and heights in pixels, so that few candidates are wasted."""
_CELLS = 1 << 16
"""Candidates at a time: what is worked out for them stays in a CPU's cache."""
_MARGIN = 20
"""Pixels around the picture that are drawn and cut off, so that no fragment is asked whether it is inside."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Surfels:
    """N oriented points, all on one device.

    position: float32 [N, 3], metres in the frame that the poses refer to, the "world".
    step: float32 [N, 2, 3], metres: how the surface goes on to the next source pixel right (0) and down (1). Their
        cross product points away from the side that was seen.
    colour: float32 [N, 3] in [-1, 1]. label: uint8 [N], class id.
    stamp: float32 [N], number of the frame that saw it; larger is newer.
    painted: bool [N], painted rather than seen.
    """

    position: Tensor
    step: Tensor
    colour: Tensor
    label: Tensor
    stamp: Tensor
    painted: Tensor

    def __len__(self) -> int:
        return len(self.position)

    def rows(self, index: Tensor) -> "Surfels":
        """Those of a bool mask [N] or of int64 numbers."""
        if index.dtype == torch.bool:
            index = true_at(index)
        return Surfels(**{field.name: getattr(self, field.name).index_select(0, index) for field in fields(self)})

    def joined(self, *others: "Surfels") -> "Surfels":
        """These, then all others."""
        every = [each for each in (self, *others) if len(each)]
        if len(every) < 2:
            return every[0] if every else self
        return Surfels(**{field.name: torch.cat([getattr(s, field.name) for s in every]) for field in fields(self)})

    @staticmethod
    def empty(device: torch.device | str = "cpu") -> "Surfels":
        """None at all."""
        return Surfels(
            position=torch.zeros(0, 3, device=device),
            step=torch.zeros(0, 2, 3, device=device),
            colour=torch.zeros(0, 3, device=device),
            label=torch.zeros(0, dtype=torch.uint8, device=device),
            stamp=torch.zeros(0, device=device),
            painted=torch.zeros(0, dtype=torch.bool, device=device),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class Splat:
    """Surfels as a target camera sees them; every tensor float32, 0 where nothing falls.

    colour: [3, H, W] in [-1, 1].
    coverage: [H, W] in 0..1: 1 inside a surface, less at its edge and between points too far apart.
    inverse_depth: [H, W], 1 / m.
    votes: [K, H, W], shares of the classes; they sum to 1 wherever coverage is above 0.
    age: [H, W], frames since it was seen. now_share: [H, W], share that this frame saw, in 0..1.
    """

    colour: Tensor
    coverage: Tensor
    inverse_depth: Tensor
    votes: Tensor
    age: Tensor
    now_share: Tensor


def true_at(mask: Tensor) -> Tensor:
    """Numbers of the true ones of bool [N], int64 (on a CPU by numpy, which takes a tenth of the time)."""
    if mask.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return torch.nonzero(mask)[:, 0]


@torch.no_grad()
def unproject(
    depth: Tensor,
    colour: Tensor,
    label: Tensor,
    lens: Intrinsics,
    world_from_camera: Tensor,
    stamp: float,
    painted: bool = False,
    keep: Tensor | None = None,
) -> Surfels:
    """Every pixel with a depth as a surfel, row by row.

    Args:
        depth: [H, W] metres along the optical axis; 0, negative or not finite: none.
        colour: [3, H, W] in [-1, 1]. label: uint8 [H, W].
        world_from_camera: [4, 4]. keep: bool [H, W], the pixels to take; None: all.
    """
    inverse = inverse_depth(depth)
    taken = inverse > 0 if keep is None else (inverse > 0) & keep
    index = true_at(taken.flatten())
    z, slope_right, slope_down, red, green, blue, x, y = (
        each.flatten().index_select(0, index)
        for each in (1 / inverse, *relative_slopes(inverse), *colour.float(), *lens.rays(depth.device))
    )
    # p = z ray; one pixel on, the ray turns by 1 / f and z changes by -z (step of 1/z) / (1/z)
    right, down = -z * slope_right, -z * slope_down
    steps = torch.stack([right * x + z / lens.fx, right * y, right, down * x, down * y + z / lens.fy, down])
    pose = world_from_camera.to(depth.device, torch.float32)
    turn = pose[:3, :3]
    return Surfels(
        position=torch.addmm(pose[:3, 3:], turn, torch.stack([z * x, z * y, z])).T.contiguous(),
        step=(turn @ steps.view(2, 3, -1)).permute(2, 0, 1).contiguous(),
        colour=torch.stack([red, green, blue], dim=1),
        label=label.flatten().index_select(0, index),
        stamp=torch.full_like(z, stamp),
        painted=torch.full_like(index, painted, dtype=torch.bool),
    )


def inverse_depth(depth: Tensor) -> Tensor:
    """1 / m, float32 [H, W]; 0 where the depth is 0, negative or not finite."""
    there = depth.isfinite() & (depth > 0)
    return torch.where(there, 1 / torch.where(there, depth, 1.0), 0.0).float()


def relative_slopes(inverse: Tensor) -> Tensor:
    """How 1/z changes to the next pixel right and down, over 1/z: [2, H, W]; 0 where no neighbour is on the surface.

    Of the steps forward and backward the smaller one counts, if it is small or goes on evenly over three pixels.
    """
    return torch.stack([_slope(inverse), _slope(inverse.T).T])


def _slope(inverse: Tensor) -> Tensor:
    """relative_slopes() along the last axis. inverse: [H, W], 0 for none."""
    rise = inverse[:, 1:] - inverse[:, :-1]
    edge = torch.full_like(inverse[:, :1], torch.inf)
    rise = torch.where((inverse[:, 1:] > 0) & (inverse[:, :-1] > 0), rise, torch.inf)
    rise = torch.cat([edge, edge, rise, edge, edge], dim=1)  # [H, W + 3], rise[i + 2] leads from pixel i to i + 1
    before, after = rise[:, 1:-2], rise[:, 2:-1]
    back = before.abs() <= after.abs()
    slope = torch.where(back, before, after)
    beyond = torch.where(back, rise[:, :-3], rise[:, 3:])
    least = _IN_LINE * slope.abs()
    in_line = ((before - after).abs() <= least) | ((slope - beyond).abs() <= least)
    relative = slope / inverse
    same = (relative.abs() <= _SAME_SURFACE_JUMP) | in_line
    return torch.where(same & relative.isfinite(), relative, 0.0).clamp(-_STEEPEST, _STEEPEST)


@torch.no_grad()
def splat(surfels: Surfels, world_from_camera: Tensor, lens: Intrinsics, classes: int, now: float) -> Splat:
    """The surfels in the picture of a target camera: in every pixel its nearest surface, newest surfels first.

    A surface is shown from the side only that was seen; from behind it is not there.

    Args:
        world_from_camera: [4, 4] of the target. classes: K, more than any label.
        now: stamp of this frame; other stamps weigh less on the same surface.
    """
    number, footprints = _project(surfels, world_from_camera, lens)
    size = (lens.height + 2 * _MARGIN, lens.width + 2 * _MARGIN)
    pixels = size[0] * size[1]
    pixel, owner, weight, z = _in_front(_fragments(footprints, size[1]), pixels)
    stamp, painted = surfels.stamp.index_select(0, number), surfels.painted.index_select(0, number)
    fresh = (stamp == now) & ~painted
    standing = torch.where(painted, _PAINTED_WEIGHT, torch.where(fresh, 1.0, _OLD_WEIGHT))
    colour, label = surfels.colour.index_select(0, number).T.contiguous(), surfels.label.index_select(0, number).long()
    share = weight * standing.index_select(0, owner)
    sums = weight.new_zeros(7, pixels)
    for total, fact in zip(sums, (*colour, now - stamp, fresh.float()), strict=False):
        total.scatter_add_(0, pixel, fact.index_select(0, owner).mul_(share))
    sums[5].scatter_add_(0, pixel, share / z)
    sums[6].scatter_add_(0, pixel, share)
    covered = weight.new_zeros(pixels).scatter_add_(0, pixel, weight).clamp_(max=1.0)
    votes = weight.new_zeros(classes * pixels).scatter_add_(0, label.index_select(0, owner) * pixels + pixel, share)
    inside = (slice(_MARGIN, -_MARGIN), slice(_MARGIN, -_MARGIN))
    sums = sums.view(7, *size)[:, *inside]  # [7, H, W]
    scale = torch.where(sums[6] > 0, 1 / sums[6], 0.0)
    mean = sums * scale
    return Splat(
        colour=mean[:3],
        coverage=covered.view(size)[inside].contiguous(),
        inverse_depth=mean[5],
        votes=votes.view(classes, *size)[:, *inside] * scale,
        age=mean[3],
        now_share=mean[4],
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class _Footprints:
    """M surfels in the target picture, each with a box of pixels around it.

    plane: [3, 3, M]; the first gives s_a, the next s_b, the last the depth in metres, at the pixel (i, j) of the box,
        by (1, i, j) @ plane. (s_a, s_b) counts in the surfel's own steps from its middle.
    column, row: int64 [M], the first of the box. side: [2, M], width and height of the box, pixels; 0: not to be drawn.
    """

    plane: Tensor
    column: Tensor
    row: Tensor
    side: Tensor


def _project(surfels: Surfels, world_from_camera: Tensor, lens: Intrinsics) -> tuple[Tensor, _Footprints]:
    """Numbers of the surfels near the picture, int64 [M], and their footprints."""
    camera_from_world = invert_rigid(world_from_camera.to("cpu", torch.float64)).to(surfels.position)
    turn = camera_from_world[:3, :3]
    x, y, z = torch.addmm(camera_from_world[:3, 3:], turn, surfels.position.T)  # [3, N]
    u, v = lens.fx * x / z + (lens.cx - 0.5), lens.fy * y / z + (lens.cy - 0.5)  # whole at pixel centres
    near = (u > -_REACH_PX) & (u < lens.width + _REACH_PX) & (v > -_REACH_PX) & (v < lens.height + _REACH_PX)
    number = true_at(near & (z > _NEAREST_M))
    u, v, z = (each.index_select(0, number) for each in (u, v, z))
    step = surfels.step.index_select(0, number)
    (a_x, a_y, a_z), (b_x, b_y, b_z) = turn @ step[:, 0].T, turn @ step[:, 1].T  # [3, M] each
    # the pinhole's Jacobian: du = fx (dx - x/z dz) / z
    across, along = (u + (0.5 - lens.cx)) / lens.fx, (v + (0.5 - lens.cy)) / lens.fy
    wide, high = lens.fx / z, lens.fy / z
    a_u, a_v, b_u, b_v = (
        wide * (a_x - across * a_z), high * (a_y - along * a_z), wide * (b_x - across * b_z), high * (b_y - along * b_z)
    )  # fmt: skip
    front = a_u * b_v > a_v * b_u  # else the target looks at the back
    a_u, a_v, b_u, b_v = _large_enough(a_u, a_v, b_u, b_v)
    half_u, half_v = (a_u.abs() + b_u.abs()).clamp_(max=_REACH_PX), (a_v.abs() + b_v.abs()).clamp_(max=_REACH_PX)
    front &= (u > -half_u) & (u < lens.width - 1 + half_u) & (v > -half_v) & (v < lens.height - 1 + half_v)
    column, row = (u - half_u).floor_() + 1, (v - half_v).floor_() + 1
    side = torch.stack([(u + half_u).ceil_() - column, (v + half_v).ceil_() - row]) * front
    i, j = column - u, row - v  # of the box's corner, from the middle
    size = a_u * b_v - a_v * b_u
    s_ai, s_aj, s_bi, s_bj = b_v / size, -b_u / size, -a_v / size, a_u / size
    s_a, s_b = s_ai * i + s_aj * j, s_bi * i + s_bj * j
    depth = (z + s_a * a_z + s_b * b_z, s_ai * a_z + s_bi * b_z, s_aj * a_z + s_bj * b_z)
    plane = torch.stack([s_a, s_ai, s_aj, s_b, s_bi, s_bj, *depth]).view(3, 3, -1)
    return number, _Footprints(plane=plane, column=column.long(), row=row.long(), side=side)


def _large_enough(a_u: Tensor, a_v: Tensor, b_u: Tensor, b_v: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Edges of parallelograms that are a pixel long and a pixel high at least, and not longer than the reach.

    The longer edge keeps its direction; the other is lifted off it. So a surfel smaller than a pixel is drawn over the
    four pixels around it, and a thin one over the two beside its line.
    """
    long_a = a_u.square() + a_v.square() >= b_u.square() + b_v.square()
    l_u, l_v = torch.where(long_a, a_u, b_u), torch.where(long_a, a_v, b_v)
    o_u, o_v = torch.where(long_a, b_u, a_u), torch.where(long_a, b_v, a_v)
    length = (l_u.square() + l_v.square()).sqrt_().clamp_(min=1e-6)
    d_u, d_v = l_u / length, l_v / length
    length.clamp_(1.0, _REACH_PX)
    lean = (o_u * d_u + o_v * d_v).clamp_(-_REACH_PX, _REACH_PX)
    height = (o_v * d_u - o_u * d_v).abs_().clamp_(1.0, _REACH_PX)
    height = torch.where(long_a, height, -height)
    l_u, l_v = d_u * length, d_v * length
    o_u, o_v = d_u * lean - d_v * height, d_v * lean + d_u * height
    a_u, a_v = torch.where(long_a, l_u, o_u), torch.where(long_a, l_v, o_v)
    b_u, b_v = torch.where(long_a, o_u, l_u), torch.where(long_a, o_v, l_v)
    return a_u, a_v, b_u, b_v


_Fragments = tuple[Tensor, Tensor, Tensor, Tensor]
"""Pairs of a pixel and a footprint: pixel number, footprint number (both int64), weight, depth."""


def _fragments(footprints: _Footprints, width: int) -> _Fragments:
    """All pixels that footprints touch, in a picture of that width, margin included; tails _TAIL times as deep."""
    order, groups = _by_size(footprints.side)
    corner = ((footprints.row + _MARGIN) * width + footprints.column + _MARGIN).index_select(0, order)
    plane = torch.stack([each.index_select(0, order) for each in footprints.plane.view(9, -1)]).view(3, 3, -1)
    parts = [_group(plane, corner, order, group, width) for group in groups]
    if not parts:
        none = plane.new_zeros(0)
        return none.long(), none.long(), none, none
    pixel, owner, weight, z = (torch.cat(each) for each in zip(*parts, strict=True))
    return pixel, owner, weight, z


def _by_size(side: Tensor) -> tuple[Tensor, list[tuple[slice, int, int]]]:
    """Numbers of the footprints to be drawn, sorted by size, and what is where in them: slice, width and height."""
    base = len(_SIDES) + 1
    table = torch.bucketize(torch.arange(_SIDES[-1] + 1, device=side.device), side.new_tensor((0, *_SIDES)))
    across, down = table.to(torch.uint8).index_select(0, side.flatten().int()).view(2, -1)
    group, order = torch.sort((across * base + down) * (across > 0), stable=True)
    groups: list[tuple[slice, int, int]] = []
    start = 0
    for each, count in enumerate(torch.bincount(group).tolist()):
        if each:
            wide, high = _SIDES[each // base - 1], _SIDES[each % base - 1]
            most = _CELLS // (wide * high)
            groups += [(slice(i, min(i + most, start + count)), wide, high) for i in range(start, start + count, most)]
        start += count
    return order, groups


def _group(plane: Tensor, corner: Tensor, number: Tensor, group: tuple[slice, int, int], width: int) -> _Fragments:
    """Fragments of footprints with boxes of one size. corner: number of the box's first pixel. number: theirs."""
    chosen, across, down = group
    cell = torch.arange(across * down, device=plane.device)
    row, column = cell // across, cell % across
    grid = torch.stack([torch.ones_like(row), column, row], dim=1).to(plane)  # [cells, 3]
    s_a, s_b, z = grid @ plane[..., chosen]  # [cells, M] each
    far = torch.maximum(s_a.abs_(), s_b.abs_())
    hit = true_at((far < _EDGE).flatten())
    weight = (1 - s_a).mul_(1 - s_b)
    z.clamp_(min=_NEAREST_M)
    rank = z * (far > _CORE).mul(_TAIL).clamp_(min=1.0)  # takes a third of what `where` does
    pixel = corner[chosen] + (row * width + column)[:, None]
    owner = number[chosen].expand(len(cell), -1)
    return tuple(each.flatten().index_select(0, hit) for each in (pixel, owner, weight, rank))  # pyright: ignore[reportReturnType]


def _in_front(fragments: _Fragments, size: int) -> _Fragments:
    """Those on the nearest surface of their pixel, tails as deep as they are. size: pixels in all.

    What hides is a core; a tail does so only where there is no core at all, and is dropped in front of one.
    """
    pixel, owner, weight, rank = fragments
    nearest = rank.new_full((size,), torch.inf).scatter_reduce_(0, pixel, rank, "amin")
    nearest, z = (each * (each < _TAIL * _NEAREST_M).float().clamp_(min=1 / _TAIL) for each in (nearest, rank))
    nearest = nearest.index_select(0, pixel)
    front = true_at((z <= nearest * (1 + _BEHIND)) & (z >= nearest * (1 - _BEHIND)))
    return tuple(each.index_select(0, front) for each in (pixel, owner, weight, z))  # pyright: ignore[reportReturnType]
