"""The virtual cameras of a node: which path each wants for the next window."""

from dataclasses import replace

import torch

from gcd_model import CameraMount, OptionError, Orbit, SphericalDelta, Traits, Trajectory
from gcd_node.config import NodeConfig, ViewConfig
from gcd_node.life.live_config import Settings
from gcd_node.optics.source_pose import stated_sphere

NANOSECONDS = 1_000_000_000


class VirtualView:
    """One configured virtual camera; an orbit remembers where it stands.

    rev: counts changes of the view; receivers drop older ones.
    """

    def __init__(
        self, view_id: str, config: NodeConfig, traits: Traits, mount: CameraMount | None = None, rev: int = 1
    ) -> None:
        """Check that the checkpoint can give it. mount: of the source camera, None for the trained one.

        Raises:
            ViewRangeError, ViewFixedError: it cannot. PoseError: no camera has that pose. OptionError: an impossible
            orbit, or the motion number cannot be worked out and was not given; or places on a vehicle for a camera that
            is declared on a sphere.
        """
        self.view_id, self.rev = view_id, rev
        self._traits, self._mount, self._source = traits, mount, stated_sphere(config.source.pose)
        self._move_time = traits.move_time if config.model.move_time is None else config.model.move_time
        wanted = self._wanted = config.view[view_id]
        self._goal = SphericalDelta(
            azimuth_deg=wanted.azimuth_deg, elevation_deg=wanted.elevation_deg, radius_m=wanted.radius
        )
        self._orbit = _orbit(wanted)
        self._newest: tuple[int, int] | None = None  # epoch and stamp of the last window
        self._planned: tuple[SphericalDelta, Trajectory] | None = None  # most views stand still
        self._check_reach()
        if config.model.motion_bucket is None:
            traits.motion_bucket(self.planned())

    def trajectory(self, stamp_ns: int, epoch: int) -> Trajectory:
        """The camera path for a window whose newest frame was captured at `stamp_ns`.

        An orbit's destination goes on from the last window's by the time between them, and turns at its limit. Stamps
        of different epochs cannot be compared: there it waits for one window. The same window may be asked for again.
        """
        if self._orbit is not None and self._newest is not None and self._newest[0] == epoch:
            self._orbit = self._orbit.advanced((stamp_ns - self._newest[1]) / NANOSECONDS)
        self._newest = (epoch, stamp_ns)
        return self.planned()

    def planned(self) -> Trajectory:
        """The path to where the view is now; an orbit does not move on."""
        goal = self._destination(self._orbit)
        if self._planned is None or self._planned[0] != goal:
            self._planned = (goal, self._plan(goal))
        return self._planned[1]

    def _destination(self, orbit: Orbit | None) -> SphericalDelta:
        return self._goal if orbit is None else replace(self._goal, azimuth_deg=orbit.azimuth_deg)

    def _plan(self, goal: SphericalDelta) -> Trajectory:
        wanted, traits = self._wanted, self._traits
        if wanted.position_m is not None and wanted.look_at_m is not None:
            if self._source is not None:
                raise OptionError(
                    f"[view.{self.view_id}] position_m is counted from what the camera is mounted on: in [source.pose] "
                    "state height_m and tilt_deg instead of elevation_deg and radius"
                )
            return traits.plan_placed(wanted.position_m, wanted.look_at_m, mount=self._mount)
        if wanted.source_from_view is not None:
            pose = torch.tensor(wanted.source_from_view, dtype=torch.float64).view(4, 4)
            return traits.plan_poses(pose.repeat(traits.config.frames, 1, 1), source=self._source)
        own = traits.live and self._orbit is None and wanted.at_source
        return traits.plan_view(
            None if own else goal, source=self._source, move_time=self._move_time, mount=self._mount
        )

    def _check_reach(self) -> None:
        """Raises ViewRangeError or ViewFixedError before the first window rather than in the middle of a run."""
        self._plan(self._goal)
        if self._orbit is not None:
            for azimuth_deg in (-self._orbit.amplitude_deg, self._orbit.amplitude_deg):
                self._plan(replace(self._goal, azimuth_deg=azimuth_deg))


def _orbit(config: ViewConfig) -> Orbit | None:
    if config.kind == "fixed" or config.rate_deg_s is None or config.amplitude_deg is None:
        return None
    return Orbit(rate_deg_s=config.rate_deg_s, amplitude_deg=config.amplitude_deg, azimuth_deg=config.azimuth_deg)


class VirtualViews:
    """The views a configuration names, made anew where a command has changed one. Belongs to one thread."""

    def __init__(self, traits: Traits) -> None:
        self._traits = traits
        self._made: dict[str, tuple[CameraMount | None, VirtualView]] = {}

    def following(self, settings: Settings, mount: CameraMount | None = None) -> list[VirtualView]:
        """The views now; an orbit whose view has not changed goes on from where it was.

        Raises: as VirtualView.
        """
        for view_id, rev in settings.revisions.items():
            made = self._made.get(view_id)
            if made is None or (made[0], made[1].rev) != (mount, rev):
                self._made[view_id] = (mount, VirtualView(view_id, settings.config, self._traits, mount, rev))
        return [self._made[view_id][1] for view_id in settings.revisions]
