"""One window in work: what was decided for it, what is known of it, what its pictures show, and what it cost."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from gcd_model import PlacedFrame, PoseError, SeenFrame, SourceFeatures, Trajectory, View
from gcd_node.errors import DepthError, RemoteError
from gcd_node.messages import world_flags
from gcd_node.model import Failure
from gcd_node.status import Announcer, Condition
from gcd_node.stream_context import StreamContext
from gcd_node.views import Settings, VirtualView
from gcd_node.window import FrameWindow

_KEPT = 1000  # a node runs for weeks
_HOLD_S = 1.0
_OTHER_WORLD = "this is another world than the model learned from: depth and classes are guesses"
_REASONS = ("DEPTH_BAD", "ODOMETRY_BAD", "MOTION_LOST", "world")


@dataclass(slots=True)
class WorkCounts:
    """What the model thread has done. render_s: inference times of the latest windows. age_ms: theirs, at publish."""

    windows: int = 0
    nan_windows: int = 0
    last_window_id: int = -1
    render_s: deque[float] = field(default_factory=lambda: deque[float](maxlen=_KEPT))
    age_ms: deque[float] = field(default_factory=lambda: deque[float](maxlen=_KEPT))


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class WindowReport:
    """A window that was just published, for observers. render_s, age_ms: see WorkCounts."""

    window: FrameWindow
    render_s: float
    age_ms: float


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Job:
    """One window and everything that was decided for it when it was taken. paths: of its views. started_ns: when that
    was, on the monotonic clock. memory: the model's, which began anew so many times."""

    window: FrameWindow
    settings: Settings
    context: StreamContext
    views: list[VirtualView]
    paths: list[Trajectory]
    started_ns: int
    memory: int


Seen = SourceFeatures | Sequence[SeenFrame] | Failure
"""What is known of a window, frame by frame if the model works so; or what that failed with."""
Known = SourceFeatures | Sequence[PlacedFrame]
Placed = Known | Failure
"""The same, and of its views."""


class WorkConditions:
    """What is wrong with what comes in, or with a model elsewhere, as windows show it."""

    def __init__(self, announcer: Announcer, *, frame_by_frame: bool) -> None:
        """frame_by_frame: how the model sees them; see Condition."""
        self._health = announcer.health
        hold_s = _HOLD_S if frame_by_frame else 0.0
        self._depth, self._odometry, self._motion, self._world = (
            Condition(code, announcer, hold_s=hold_s) for code in _REASONS
        )
        self._remote = Condition("REMOTE_LATE", announcer, hold_s=0.0, over="REMOTE_BACK")

    def bad_depth(self, error: DepthError | None) -> None:
        """Of one frame; None: all of a window can be used."""
        if error is not None:
            self._health.count("bad_depths")
        self._depth.update(None if error is None else {"message": str(error)})

    def odometry(self, error: PoseError | None) -> None:
        """Of one frame: None if it can be used."""
        self._odometry.update(None if error is None else {"message": str(error)})

    def source(self, context: StreamContext, view: View) -> None:
        """Whether the model knows such a source, and how it moved; the same for all views of a window."""
        self._motion.update({"message": view.lost[0], "frames": len(view.lost)} if view.lost else None)
        self._health.ood_score = view.ood
        is_foreign = bool(world_flags(context.traits, view.ood))
        self._world.update({"message": _OTHER_WORLD, "ood_score": view.ood} if is_foreign else None)

    def remote_late(self, error: RemoteError | None) -> None:
        """Of a window that was sent elsewhere; None: it came back in time."""
        self._remote.update(None if error is None else {"message": str(error)})
