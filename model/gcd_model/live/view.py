"""The live model, frame by frame: see, place, paint; and every pixel says which.

frame -> depth, classes, motion -> points, and those of earlier frames -> splat -> paint -> picture + visibility

Each of the three has its own state, so three threads may be at work on consecutive frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from gcd_model.geometry import Intrinsics
from gcd_model.live.eyes import Eyes, Floor, FrameGeometry
from gcd_model.live.networks import LiveNetworks
from gcd_model.live.painter import Painter, ViewFrame
from gcd_model.live.seen_world import seen_world


@dataclass(frozen=True, kw_only=True, slots=True)
class LiveFrame:
    """What became of a source frame. world_from_source: [4, 4], the world begins as a frame's camera.

    lost: why the memory was dropped before this frame, or None.
    """

    views: tuple[ViewFrame, ...]
    geometry: FrameGeometry
    world_from_source: Tensor
    lost: str | None


class LiveView:
    """Views of one camera's video, one frame at a time; a window is its frames one by one.

    Not thread-safe. The state is what was seen and what was painted; `reset` drops both, and so does another lens.
    """

    def __init__(self, networks: LiveNetworks, *, steps: int | None = None, seed: int = 0) -> None:
        """steps, seed: see `Painter`."""
        self.eyes = Eyes(networks)
        self._world = seen_world(networks.config, next(networks.parameters()).device)
        self._painter = Painter(networks, steps=steps, seed=seed)

    def reset(self) -> None:
        """Forget all that was seen and painted."""
        self.eyes.reset()

    def step(
        self,
        frame: Tensor,
        poses: Sequence[Tensor],
        *,
        lens: Intrinsics,
        depth: Tensor | None = None,
        odometry: Tensor | None = None,
        floor: Floor | None = None,
        geometry: FrameGeometry | None = None,
        target_lens: Intrinsics | None = None,
    ) -> LiveFrame:
        """One frame of every view.

        Args:
            frame, lens, depth, odometry, floor, geometry: see `Eyes.see`. poses, target_lens: see `SeenWorld.place`.
        Raises:
            ShapeError, PoseError: see there.
        """
        seen = self.eyes.see(frame, lens=lens, depth=depth, odometry=odometry, floor=floor, geometry=geometry)
        views = self._painter.paint(self._world.place(seen, poses, target_lens))
        return LiveFrame(views=views, geometry=seen.geometry, world_from_source=seen.world_from_source, lost=seen.lost)
