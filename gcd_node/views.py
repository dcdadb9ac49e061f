"""The views a node gives: what is asked for now, the path of each one's camera, the end of its topics; and the preview
of the input."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import get_args

import msgspec
import torch

from gcd_client.protocol import PREVIEW_ID, PREVIEW_TOPIC, ViewKind, ViewMessage, view_topic
from gcd_model import CameraMount, Intrinsics, OptionError, Orbit, SphericalDelta, Traits, Trajectory
from gcd_node.canonical import Reference
from gcd_node.config import ModelSection, NodeConfig, PublishConfig
from gcd_node.frame import Frame
from gcd_node.messages import PREVIEW_PERIOD_S, MessageSink, end_message, preview_message
from gcd_node.preprocess import stated_sphere
from gcd_node.stream_context import StreamContext, published_kinds
from gcd_node.view_config import ViewConfig, pose_matrix

_LEAST = 0.9  # of a period between two previews, so that a camera's jitter does not make it miss every second one


@dataclass(frozen=True, kw_only=True, slots=True)
class Settings:
    """The configuration at one moment. revisions: of every view in it; each change of a view raises its own."""

    config: NodeConfig
    revisions: Mapping[str, int]


class LiveConfig:
    """Holds the configuration between the control thread that changes it and the model thread that follows it.

    Nothing is checked here. A view that was removed may come back, and its revision goes on from where it was:
    receivers drop older ones. canonical: names of such views, removed or not; they are no other view's.
    """

    def __init__(self, config: NodeConfig) -> None:
        self._lock = threading.Lock()
        self._revisions = dict.fromkeys(config.view, 1)  # of removed views too
        self.canonical = frozenset(name for name, view in config.view.items() if view.kind == "canonical")
        self._settings = Settings(config=config, revisions=dict(self._revisions))

    @property
    def config(self) -> NodeConfig:
        """In force now."""
        return self._settings.config

    @property
    def known_views(self) -> tuple[str, ...]:
        """Every view there is or has been."""
        return tuple(self._revisions)

    def settings(self) -> Settings:
        """In force now, with the revisions of its views."""
        return self._settings

    def revision(self, view_id: str) -> int:
        """Of a view there is or has been; 0 for others."""
        return self._revisions.get(view_id, 0)

    def set_view(self, view_id: str, view: ViewConfig, instead_of: ViewConfig | None = None) -> int | None:
        """Replace or add a view; gives its new revision. None, and nothing changes: it is no longer `instead_of`."""
        with self._lock:
            if instead_of is not None and self.config.view.get(view_id) is not instead_of:
                return None
            self._revisions[view_id] = self._revisions.get(view_id, 0) + 1
            self._replace(view={**self.config.view, view_id: view})
            return self._revisions[view_id]

    def remove_view(self, view_id: str) -> None:
        """Take a view out. Raises KeyError if it is not in."""
        with self._lock:
            left = dict(self.config.view)
            del left[view_id]
            self._replace(view=left)

    def change(self, model: ModelSection, publish: PublishConfig) -> None:
        """Replace how views are drawn and how they are sent."""
        with self._lock:
            self._replace(model=model, publish=publish)

    def _replace(self, **changes: object) -> None:
        config = msgspec.structs.replace(self.config, **changes)
        self._settings = Settings(config=config, revisions={each: self._revisions[each] for each in config.view})


class VirtualView:
    """One configured virtual camera; an orbit remembers where it stands.

    rev: counts changes of the view; receivers drop older ones.
    """

    def __init__(
        self,
        view_id: str,
        config: NodeConfig,
        traits: Traits,
        mount: CameraMount | None = None,
        rev: int = 1,
        lens: Intrinsics | None = None,
    ) -> None:
        """Check that the checkpoint can give it. mount: of the source camera, None for the trained one. lens: of the
        view, None for the source's.

        Raises:
            ViewRangeError, ViewFixedError: it cannot. PoseError: no camera has that pose. OptionError: an impossible
            orbit, or the motion number cannot be worked out and was not given; or places on a vehicle for a camera that
            is declared on a sphere; or a canonical view of another model than the live one.
        """
        self.view_id, self.rev = view_id, rev
        self._traits, self._mount, self._source = traits, mount, stated_sphere(config.source.pose)
        self._lens = lens
        self._move_time = traits.move_time if config.model.move_time is None else config.model.move_time
        view = self._view = config.view[view_id]
        if view.kind == "canonical" and not traits.live:
            raise OptionError(f'[view.{view_id}] kind = "canonical" is for the live model; take package:live-small')
        self._goal = SphericalDelta(
            azimuth_deg=view.azimuth_deg, elevation_deg=view.elevation_deg, radius_m=view.radius
        )
        self._orbit: Orbit | None = None
        if view.rate_deg_s is not None and view.amplitude_deg is not None:
            self._orbit = Orbit(
                rate_deg_s=view.rate_deg_s, amplitude_deg=view.amplitude_deg, azimuth_deg=view.azimuth_deg
            )
        self._newest: tuple[int, int] | None = None  # epoch and stamp of the last window
        self._planned: tuple[SphericalDelta, Trajectory] | None = None  # most views stand still
        self._plan(self._goal)
        if self._orbit is not None:  # as far as it swings: not to fail in the middle of a run
            for azimuth_deg in (-self._orbit.amplitude_deg, self._orbit.amplitude_deg):
                self._plan(replace(self._goal, azimuth_deg=azimuth_deg))
        if config.model.motion_bucket is None:
            traits.motion_bucket(self.planned())

    def trajectory(self, stamp_ns: int, epoch: int) -> Trajectory:
        """The camera path for a window whose newest frame was captured at `stamp_ns`.

        An orbit's destination goes on from the last window's by the time between them, and turns at its limit. Stamps
        of different epochs cannot be compared: there it waits for one window. The same window may be asked for again.
        """
        if self._orbit is not None and self._newest is not None and self._newest[0] == epoch:
            self._orbit = self._orbit.advanced((stamp_ns - self._newest[1]) / 1e9)
        self._newest = (epoch, stamp_ns)
        return self.planned()

    def planned(self) -> Trajectory:
        """The path to where the view is now; an orbit does not move on."""
        goal = self._goal if self._orbit is None else replace(self._goal, azimuth_deg=self._orbit.azimuth_deg)
        if self._planned is None or self._planned[0] != goal:
            self._planned = (goal, self._plan(goal))
        return self._planned[1]

    def _plan(self, goal: SphericalDelta) -> Trajectory:
        view, traits = self._view, self._traits
        if view.position_m is not None and view.look_at_m is not None:
            if self._source is not None:
                raise OptionError(
                    f"[view.{self.view_id}] position_m is counted from what the camera is mounted on: in [source.pose] "
                    "state height_m and tilt_deg instead of elevation_deg and radius"
                )
            return traits.plan_placed(view.position_m, view.look_at_m, mount=self._mount)
        if view.pose is not None:
            pose = torch.tensor(pose_matrix(view.pose), dtype=torch.float64).view(4, 4)
            path = traits.plan_poses(pose.repeat(traits.config.frames, 1, 1), source=self._source)
            return path if self._lens is None else replace(path, lens=self._lens)
        own = traits.live and self._orbit is None and view.at_source
        return traits.plan_view(
            None if own else goal, source=self._source, move_time=self._move_time, mount=self._mount
        )


class VirtualViews:
    """The views a configuration names, made anew where a command has changed one. Belongs to one thread."""

    def __init__(self, traits: Traits) -> None:
        self._traits = traits
        self._made: dict[str, tuple[CameraMount | None, VirtualView]] = {}

    def sync(
        self,
        settings: Settings,
        mount: CameraMount | None = None,
        references: Mapping[str, Reference] = MappingProxyType({}),
    ) -> list[VirtualView]:
        """The views now, but for canonical ones whose pose is not known yet; an orbit whose view has not changed goes
        on from where it was.

        Raises: as VirtualView.
        """
        views = settings.config.view
        drawn = [each for each in settings.revisions if views[each].kind != "canonical" or views[each].pose is not None]
        for view_id in drawn:
            made, rev = self._made.get(view_id), settings.revisions[view_id]
            if made is None or (made[0], made[1].rev) != (mount, rev):
                lens = references[view_id].view if views[view_id].kind == "canonical" and references else None
                view = VirtualView(view_id, settings.config, self._traits, mount, rev, lens)
                self._made[view_id] = (mount, view)
        return [self._made[view_id][1] for view_id in drawn]


class EndOfStream:
    """Sends views, and ends every topic once: what is made of a view now, and what was made of it before a command
    changed that."""

    def __init__(self, live: LiveConfig, sink: MessageSink, context: Callable[[], StreamContext]) -> None:
        """context: what is known of the source now."""
        self._live, self._sink, self._context = live, sink, context
        self._open: dict[str, Set[str]] = {view_id: set() for view_id in live.config.view}
        """Views that have not ended, and on which of their topics something was sent."""
        self._ended: dict[str, int] = {}
        """The latest revision of each view that was taken out: what is still in work of it is not sent."""
        self._newest_goal: dict[str, tuple[int, int]] = {}

    def send(self, messages: Sequence[ViewMessage]) -> None:
        """What one view of one window came to; what is made of the view no more, such as deviations of a single sample,
        ends. Left out: frames that an overlapping window has sent before, and views that have ended."""
        header = messages[0].header
        if header.view_rev <= self._ended.get(header.view_id, 0):
            return
        for message in messages:
            if message.topic.endswith("/frm"):
                moment = (message.header.src.epoch, message.header.src.seq[0])
                if moment <= self._newest_goal.get(message.topic, (-1, -1)):
                    continue
                self._newest_goal[message.topic] = moment
            self._sink.send(message)
        topics = {message.topic for message in messages}
        gone = self._open.get(header.view_id, topics) - topics
        self._end(header.view_id, header.view_rev, gone, header.window_id, delay_ms=0)
        self._open[header.view_id] = topics

    def announce_removed(self, last_window_id: int) -> None:
        """End views that were taken out."""
        there = self._live.config.view
        for view_id in [each for each in self._open if each not in there]:
            self._ended[view_id] = self._live.revision(view_id)
            self._end(view_id, self._ended[view_id], self._topics(view_id), last_window_id, delay_ms=0)
        for view_id in there:  # that came meanwhile: they end, too, when they go
            self._open.setdefault(view_id, set())

    def announce_all(self, last_window_id: int, *, delay_ms: int | None) -> None:
        """End everything. delay_ms: see MessageSink."""
        self.announce_removed(last_window_id)
        for view_id, rev in self._live.settings().revisions.items():
            self._end(view_id, rev, self._topics(view_id), last_window_id, delay_ms=delay_ms)

    def _topics(self, view_id: str) -> Set[str]:
        """What is made of a view now, or was and has not ended."""
        now = published_kinds(replace(self._context(), config=self._live.config))
        return self._open.pop(view_id, set[str]()) | {view_topic(view_id, kind) for kind in now}

    def _end(self, view_id: str, rev: int, topics: Set[str], last: int, *, delay_ms: int | None) -> None:
        for topic in [topic for kind in get_args(ViewKind) if (topic := view_topic(view_id, kind)) in topics]:
            self._sink.end(end_message(self._context(), topic, view_id, rev, last), delay_ms=delay_ms)


class InputPreview:
    """Shows what the camera sees to its subscribers, a few times a second. Belongs to the reader thread."""

    def __init__(
        self, sink: MessageSink, context: Callable[[], StreamContext], clock: Callable[[], float] = time.monotonic
    ) -> None:
        """context: what is known of the source now. clock: monotonic seconds."""
        self._sink, self._context, self._clock = sink, context, clock
        self._next_s = clock()
        self._shown = False

    def offer(self, frame: Frame, arrival_ns: int, epoch: int) -> None:
        """A frame arrived; does not wait. With no subscriber it costs a look at a counter."""
        now_s = self._clock()
        if now_s < self._next_s or self._sink.stats.previews == 0:
            return
        self._next_s = max(self._next_s + PREVIEW_PERIOD_S, now_s + _LEAST * PREVIEW_PERIOD_S)
        self._shown = True
        context = self._context()
        self._sink.preview(lambda: preview_message(context, frame, arrival_ns, epoch))

    def announce_end(self, *, delay_ms: int | None) -> None:
        """End the topic, if anybody got something on it. delay_ms: see MessageSink."""
        if self._shown:
            self._sink.end(end_message(self._context(), PREVIEW_TOPIC, PREVIEW_ID, 1, -1), delay_ms=delay_ms)
