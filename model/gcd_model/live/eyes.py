"""What a source frame shows, where the camera is, and what is remembered of earlier frames.

frame + an earlier one -> depth network, ego-motion -> SeenFrame -> SeenWorld -> PlacedFrame
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from gcd_model.errors import OptionError
from gcd_model.geometry import Intrinsics, invert_rigid
from gcd_model.live.blocks import likeliest
from gcd_model.live.config import SIZE_FACTOR, SKY_M, LiveConfig
from gcd_model.live.depth_net import Reference, depth_inputs, plane_depth, read_depth, sweep_costs
from gcd_model.live.ego_motion import EgoMotion
from gcd_model.live.splat import Splat, Surfels, inverse_depth, relative_slopes, splat, true_at, unproject
from gcd_model.networks import LiveNetworks
from gcd_model.weights.load import load_weights, weights_path

_FRAMES = 6
"""So many earlier frames are kept."""
LONGEST = 0.3
"""Of the median depth: how far away an earlier camera may have been."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Floor:
    """The plane on which the source camera's carrier stands: its normal in camera axes, float32 [3], towards the
    camera, and the camera's height over it in metres.
    """

    up: Tensor
    height_m: float


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameGeometry:
    """What a source frame shows: metres [H, W] (0: hole, SKY_M: sky), labels uint8 [H, W], static bool [H, W].

    ood: how unlike its training it looks to the depth network, 0 to 1; see `Familiarity`. spread: [H, W], see
    `DepthReading`; None for depth from elsewhere.
    """

    metres: Tensor
    labels: Tensor
    static: Tensor
    ood: float
    spread: Tensor | None = None


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class SeenFrame:
    """A source frame, once it was looked at.

    picture: [3, H, W] in [-1, 1]. lens, floor: of the source. world_from_source: [4, 4], the world begins as a frame's
    camera. begins: nothing of an earlier frame holds. lost: why, if the motion is unknown; None also where it begins
    as it should.
    """

    picture: Tensor
    geometry: FrameGeometry
    lens: Intrinsics
    floor: Floor | None
    world_from_source: Tensor
    begins: bool
    lost: str | None


class References:
    """The last frames of a camera, of which one is chosen to compare the next one with."""

    def __init__(self) -> None:
        self._frames: deque[tuple[Tensor, Tensor]] = deque(maxlen=_FRAMES)
        self._median_m = 0.0

    def add(self, picture: Tensor, world_from_camera: Tensor, metres: Tensor) -> None:
        """picture: [3, H, W]. metres: [H, W]; 0 for holes."""
        self._frames.append((picture, world_from_camera))
        near = metres[(metres > 0) & (metres < SKY_M)]
        self._median_m = float(near.median()) if near.numel() else 0.0

    def chosen(self, world_from_camera: Tensor) -> Reference | None:
        """The oldest one from which the scene does not look too different, or None."""
        for picture, pose in self._frames:
            move = invert_rigid(pose) @ world_from_camera
            if float(move[:3, 3].norm()) <= LONGEST * self._median_m:
                return Reference(picture, move)
        return None


class Eyes:
    """Look at one camera's frames, one after the other: depth, classes and motion. The state is earlier frames."""

    def __init__(self, networks: LiveNetworks) -> None:
        self._networks, self._config = networks.eval(), networks.config
        self._device = next(networks.parameters()).device
        self._lens: Intrinsics | None = None
        self.reset()

    def reset(self) -> None:
        """Forget all frames: the next one begins."""
        self._ego, self._references, self._begins = EgoMotion(), References(), True

    @torch.inference_mode()
    def look(
        self,
        frame: Tensor,
        lens: Intrinsics,
        *,
        depth: Tensor | None = None,
        floor: Floor | None = None,
        reference: Reference | None = None,
    ) -> FrameGeometry:
        """Depth, classes and motion of one frame; leaves the state alone.

        Args: see `see`. reference: an earlier frame to compare it with.
        """
        picture, rays = frame.to(self._device, torch.float32), lens.rays(self._device)
        ground = torch.zeros_like(rays[0])
        if floor is not None:
            ground = plane_depth(rays, floor.up.to(self._device), floor.height_m)
        inputs = depth_inputs(picture[None], rays[None], ground[None])
        output = self._networks.depth(inputs, sweep_costs(picture, lens, reference, self._config.depth)[None])
        reading = read_depth(output, self._config.depth)
        return FrameGeometry(
            metres=reading.metres[0] if depth is None else _taken(depth, reading.metres[0]),
            labels=likeliest(output.classes[0]),
            static=output.moves[0] < 0,
            ood=float(self._networks.familiarity.score(output.summary, reading.entropy)[0]),
            spread=reading.spread[0] if depth is None else None,
        )

    @torch.inference_mode()
    def see(
        self,
        frame: Tensor,
        *,
        lens: Intrinsics,
        depth: Tensor | None = None,
        odometry: Tensor | None = None,
        floor: Floor | None = None,
    ) -> SeenFrame:
        """Take in one frame: its depth, its classes, and how the camera moved.

        Args:
            frame: float32 [3, H, W], RGB in [-1, 1]; H and W multiples of 32.
            lens: of the source; 40 to 120 degrees across were trained.
            depth: [H, W] metres, 0 or not finite where unknown, instead of the depth network's.
            odometry: world_from_source [4, 4] of any world that stays the same from frame to frame; None: from the
                pictures.
            floor: where the declared mount has the ground.
        """
        picture = frame.to(self._device, torch.float32)
        if lens != self._lens:  # another camera, or another size of its pictures
            self.reset()
            self._lens = lens
        pose, lost = self._ego.follow(picture, lens, odometry)
        if lost is not None:
            self._references = References()
        geometry = self.look(picture, lens, depth=depth, floor=floor, reference=self._references.chosen(pose))
        self._ego.settle(geometry.metres, geometry.static, geometry.spread)
        self._references.add(picture, pose, geometry.metres)
        begins, self._begins = self._begins or lost is not None, False
        return SeenFrame(
            picture=picture,
            geometry=geometry,
            lens=lens,
            floor=floor,
            world_from_source=pose,
            begins=begins,
            lost=lost,
        )


def _taken(depth: Tensor, learned: Tensor) -> Tensor:
    """Depth from elsewhere: bad numbers are holes, a hole in what the network calls sky is sky."""
    metres = torch.where(depth.isfinite() & (depth > 0), depth, 0.0).float().to(learned.device)
    return torch.where((metres == 0) & (learned >= SKY_M), SKY_M, metres)


@lru_cache(maxsize=2)
def packaged_eyes(device: torch.device) -> Eyes:
    """The depth network of the model that ships, loaded once."""
    networks = load_weights(weights_path("package:live-small")).networks
    assert isinstance(networks, LiveNetworks)
    return Eyes(networks.to(device, torch.float32))


@torch.no_grad()
def estimated_depth(video: Tensor, lens: Intrinsics) -> Tensor:
    """Depth as the packaged live model sees it in each frame by itself, without ground or motion.

    Args:
        video: float32 [T, 3, H, W] in [-1, 1]; H and W multiples of 32.
    Returns:
        float32 [T, H, W], metres along the axis; 0 for the sky, as in data.
    Raises: OptionError for another size.
    """
    if video.shape[-2] % SIZE_FACTOR or video.shape[-1] % SIZE_FACTOR:
        size = f"{video.shape[-2]} x {video.shape[-1]}"
        raise OptionError(f"depth is estimated for heights and widths that are multiples of {SIZE_FACTOR}, got {size}")
    metres = torch.stack([packaged_eyes(video.device).look(frame, lens).metres for frame in video])
    return torch.where(metres < SKY_M, metres, 0.0)


_NEAREST_M = 0.1
"""What lies nearer to the source camera than this, or behind it, is outside its picture."""
_SAME_SURFACE = 0.05
"""Relative depth by which a surfel may lie behind what this frame sees and still be that surface, seen again."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PlacedFrame:
    """A seen frame and its views before anything is painted. targets: world_from_target [4, 4]. lenses: of the views.
    splats: all that was seen, as each target shows it."""

    seen: SeenFrame
    targets: tuple[Tensor, ...]
    lenses: tuple[Intrinsics, ...]
    splats: tuple[Splat, ...]


class SeenWorld:
    """Frame by frame: `look`, then `splat` from as many targets as there are. Poses refer to one world throughout.

    A frame's own surfels are remembered after it was drawn, so that all are splatted in one depth test.
    """

    def __init__(self, config: LiveConfig, device: torch.device | str = "cpu") -> None:
        self._config, self._device = config, device
        self._now = 0.0  # stamp of the newest frame's points
        self.reset()

    def reset(self) -> None:
        """Forget everything: another scene, or a camera that jumped."""
        self._fresh = self._static = self._memory = Surfels.empty(self._device)

    @torch.inference_mode()
    def look(
        self,
        picture: Tensor,
        metres: Tensor,
        labels: Tensor,
        static: Tensor,
        lens: Intrinsics,
        world_from_source: Tensor,
    ) -> None:
        """Take in a frame.

        Args:
            picture: [3, H, W] in [-1, 1]. metres: [H, W], 0 for a hole. labels: uint8 [H, W]. static: bool [H, W], what
                may be remembered. world_from_source: [4, 4].
        """
        self._now += 1.0
        config, known = self._config, metres > 0
        kept = remembered(self._memory, self._static, config.memory, config.memory_frames)
        self._memory = unrefuted(kept, metres, lens, world_from_source, known)
        self._fresh = unproject(metres, picture, labels, lens, world_from_source, self._now)
        self._static = self._fresh.rows(static.flatten()[known.flatten()])

    @torch.inference_mode()
    def place(
        self, frame: SeenFrame, poses: Sequence[Tensor], target_lenses: Sequence[Intrinsics | None] | None = None
    ) -> PlacedFrame:
        """Take in a frame, and splat all of it from every target.

        poses: source_from_target [4, 4] of each view, metres. target_lenses: of each view; None: the source's.
        """
        if frame.begins:
            self.reset()
        seen, pose = frame.geometry, frame.world_from_source
        lenses = tuple(each or frame.lens for each in target_lenses or [None] * len(poses))
        self.look(frame.picture, seen.metres, seen.labels, seen.static, frame.lens, pose)
        targets = tuple(pose @ each for each in poses)
        points = self._fresh.joined(self._memory)
        splats = tuple(
            splat(points, each, lens, len(self._config.classes), self._now)
            for each, lens in zip(targets, lenses, strict=True)
        )
        return PlacedFrame(seen=frame, targets=targets, lenses=lenses, splats=splats)

    def splat(self, world_from_target: Tensor, lens: Intrinsics) -> Splat:
        """All of it as a target camera sees it, in one depth test."""
        points = self._fresh.joined(self._memory)
        return splat(points, world_from_target, lens, len(self._config.classes), self._now)


def remembered(memory: Surfels, fresh: Surfels, capacity: int, oldest_frames: int) -> Surfels:
    """Both; what is beyond the capacity, or older than so many frames (0: no limit), goes, oldest first."""
    every = memory.joined(fresh)
    if not capacity or not len(every):
        return memory
    young = every.stamp >= every.stamp.max() - (oldest_frames or float("inf"))
    every = every if bool(young.all()) else every.rows(young)
    if len(every) <= capacity:
        return every
    oldest = every.stamp.kthvalue(len(every) - capacity + 1).values
    newer, at = every.stamp > oldest, true_at(every.stamp == oldest)
    room = capacity - int(newer.sum())  # of the oldest frame that still has some an even share is kept
    newer[at[torch.arange(room, device=at.device) * len(at) // max(room, 1)]] = True
    return every.rows(newer)


def unrefuted(memory: Surfels, depth: Tensor, lens: Intrinsics, world_from_camera: Tensor, known: Tensor) -> Surfels:
    """Without what a frame sees again or sees through; what is hidden from it, or out of its sight, stays.

    What it sees is the plane of a pixel, not its middle alone: on a street the depth changes by half within a pixel.

    Args:
        depth: [H, W] metres, 0 or not finite where nothing is as far as the camera can see, as in the sky.
        world_from_camera: [4, 4] of the source camera, which took the depth.
        known: bool [H, W], false where the depth is a hole: it proves nothing.
    """
    if not len(memory):
        return memory
    position = memory.position
    camera_from_world = invert_rigid(world_from_camera.to("cpu", torch.float64)).to(position)
    x, y, z = torch.addmm(camera_from_world[:3, 3:], camera_from_world[:3, :3], position.T)
    u, v = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
    inside = (z > _NEAREST_M) & (u >= 0) & (u < lens.width) & (v >= 0) & (v < lens.height)
    column, row = (torch.where(inside, each, 0.0).floor() for each in (u, v))
    pixel = (row * lens.width + column).long()
    inverse = inverse_depth(depth)
    here, right, down = (each.flatten().index_select(0, pixel) for each in (inverse, *relative_slopes(inverse)))
    plane = here * (1 + right * (u - column - 0.5) + down * (v - row - 0.5))
    refuted = inside & (z * plane <= 1 + _SAME_SURFACE) & known.flatten().index_select(0, pixel)
    return memory.rows(~refuted)
