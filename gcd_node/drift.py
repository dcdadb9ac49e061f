"""Whether the source camera still stands where canonical views take it to stand; and their poses, found or kept."""

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict

import numpy as np
import torch
from msgspec.structs import replace
from torch import Tensor

from gcd_model import Alignment, AlignmentError, CameraMove, Landmarks, SeenFrame, align, invert_rigid, landmarks_of
from gcd_node.canonical import Reference
from gcd_node.health import THREAD_DIED, Level
from gcd_node.status import Announcer, Condition
from gcd_node.view_config import ViewConfig, pose_matrix
from gcd_node.views import LiveConfig

_LOG = logging.getLogger(__name__)
_PERIOD_S = 0.4  # from one check to the next; each takes some 20 ms of a core
_NICE = 10
_IN_A_ROW = 3  # checks that agree: an arm before the lens is no camera that moved
_UNSEEN_S, _HOLD_S = 5.0, 1.0
_ANSWER_S = 5.0  # for a request; then it has failed
_MOVED_CM, _MOVED_DEG = 0.5, 0.5  # a step, a turn; and a shift of the picture as by such a step to the side
_PREFERRED = 0.7  # of the corners: things that the arm carries pull a pose, and the others do not follow
_FROM_REFERENCE, _SIGMAS = 4.0, 3.0  # so many times that, and surer: other light, other things and a learned depth


class DriftDetector:
    """Compares what the source camera sees with what it saw when this began, a few times a second, in a thread of its
    own: of the frames that were looked at for views, while these are drawn.

    moved: views whose pose no longer holds now.
    """

    def __init__(
        self,
        live: LiveConfig,
        announcer: Announcer,
        references: Mapping[str, Reference],
        notice_change: Callable[[], None],
    ) -> None:
        """notice_change: called once a view has another pose."""
        self._live, self._announcer, self._notice_change = live, announcer, notice_change
        self._references = {view_id: reference.features for view_id, reference in references.items()}
        self._newest: SeenFrame | None = None
        self._asked_s: dict[str, float] = {}  # when
        self._stopped = threading.Event()
        self._recent: deque[Landmarks] = deque(maxlen=_IN_A_ROW)
        self._anchor: Landmarks | None = None  # what the camera saw first
        self._expected: dict[str, Tensor] = {}  # anchor_from_source as the pose of each view takes it to be
        self._last: Tensor | None = None  # the same as it was found by the last check
        self._in_a_row, self._is_seen = 0, True
        self._unseen_s: float | None = None  # since when the scene of the anchor is not seen
        self._moves = Condition("CAMERA_MOVED", announcer, hold_s=_HOLD_S)
        self._unaligned = Condition("UNALIGNED", announcer, hold_s=0.0)
        self.moved: frozenset[str] = frozenset()
        self._held_from: dict[str, int] = {}  # the revision with which a moved view was aligned again

    def was_wrong(self, view_id: str, revision: int) -> bool:
        """Whether what is drawn with this revision of a view shows a pose that no longer holds. From any thread."""
        return view_id in self.moved or revision < self._held_from.get(view_id, 0)

    def offer(self, frame: SeenFrame) -> None:
        """A frame that the model has looked at; the newest is checked. From any thread; never waits."""
        self._newest = frame

    def request(self, view_id: str) -> None:
        """Let the pose of a view follow the camera once it stands; an event tells how that went, within 5 s and a
        check. From any thread, while not `is_over`."""
        self._asked_s[view_id] = time.monotonic()

    @property
    def is_over(self) -> bool:
        """Whether nothing is checked any more."""
        return self._stopped.is_set()

    def stop(self) -> None:
        """End `run` soon."""
        self._stopped.set()

    def run(self) -> None:
        """The thread's work."""
        os.nice(_NICE)  # of this thread alone: views come first
        try:
            while not self._stopped.wait(_PERIOD_S):
                frame, self._newest = self._newest, None
                if frame is not None:
                    self.check(frame)
                late_s = time.monotonic() - _ANSWER_S
                late = [view_id for view_id, asked_s in self._asked_s.copy().items() if asked_s < late_s]
                self._refuse("no frame shows where the camera stands, or it does not stand still", late)
        except Exception as error:  # the end of a thread: whoever asks for health gets it
            _LOG.exception("the drift detector broke")
            fields = {"thread": "drift", "message": f"{type(error).__name__}: {error}; activate the node anew"}
            self._announcer.event(THREAD_DIED, Level.ERROR, fields)
            self._announcer.health.raise_reason(THREAD_DIED, Level.ERROR)
        finally:
            self._stopped.set()
            self._refuse("nothing is looked at any more; activate the node", self._asked_s)
            self._announcer.health.camera = None

    def check(self, frame: SeenFrame) -> None:
        """Look at one frame."""
        now: Landmarks | None = None
        try:
            now = landmarks_of(frame)
            found = align([self._anchor or now], [now.features])
        except AlignmentError as error:
            self._keep(now, is_seen=False)
            self._miss(str(error))
            return
        self._keep(now, is_seen=True)
        if len(self._recent) < _IN_A_ROW:
            return
        self._anchor, self._unseen_s = self._anchor or now, None
        problem: Mapping[str, object] | None = None
        for view_id, view in self._views().items():
            if view_id not in self._expected:
                problem = self._begin(view_id, view, found.pose) or problem
        self._unaligned.update(problem)
        self._judge(found)

    def _keep(self, now: Landmarks | None, *, is_seen: bool) -> None:
        """The latest frames of one scene. is_seen: of that of the anchor."""
        if now is None or is_seen != self._is_seen:
            self._recent.clear()
        self._is_seen = is_seen
        if now is not None:
            self._recent.append(now)

    def _views(self) -> dict[str, ViewConfig]:
        """The canonical views that there are now."""
        views = self._live.config.view
        return {each: views[each] for each in self._references if each in views and views[each].kind == "canonical"}

    def _begin(self, view_id: str, view: ViewConfig, anchor_from_now: Tensor) -> Mapping[str, object] | None:
        """Find the pose of a view, or see whether the stated one holds; what is wrong if there is none."""
        try:
            found = align(self._recent, self._references[view_id])
        except AlignmentError as error:
            if view.pose is None:
                return {"view": view_id, "message": f"the view is not drawn: {error}"}
            _LOG.info("%s: whether its pose holds cannot be seen: %s", view_id, error)
            self._expected[view_id] = anchor_from_now
            return None
        self._expected[view_id] = anchor_from_now
        if view.pose is None:
            self._set_pose(view_id, view, found.pose, found.moved_from(torch.eye(4, dtype=torch.float64)))
        elif _is_beyond(found, _pose_of(view), _FROM_REFERENCE, _SIGMAS):
            self._expected[view_id] = anchor_from_now @ found.pose @ invert_rigid(_pose_of(view))
        return None

    def _judge(self, found: Alignment) -> None:
        """Tell whether the camera moved, and let views follow it once it stands."""
        views, last, self._last = self._views(), self._last, found.pose
        moves = {each: found.moved_from(pose) for each, pose in self._expected.items() if each in views}
        beyond = {view_id for view_id in moves if _is_beyond(found, self._expected[view_id])}
        view_id, worst = max(moves.items(), key=lambda each: each[1].pixels, default=("", None))
        self._announcer.health.camera = None if worst is None else _rounded(worst)
        self._in_a_row = self._in_a_row + 1 if beyond else 0
        if worst is not None and self._in_a_row >= _IN_A_ROW:
            self.moved = frozenset(beyond)
            text = f"the source camera no longer stands where {view_id} takes it to stand"
            self._moves.update({"view": view_id, "message": text, **_rounded(worst)})
        elif not beyond:
            self.moved = frozenset()
            self._moves.update(None)
        if last is not None and not _is_beyond(found, last):  # it stands
            for view_id in moves:
                if view_id in self._asked_s or (views[view_id].realign and view_id in self.moved):
                    self._follow(view_id, views[view_id])

    def _follow(self, view_id: str, view: ViewConfig) -> None:
        """Give a view the pose that follows from how the source camera moved."""
        assert self._anchor is not None, "what was judged was compared with it"
        try:
            found = align([self._anchor], [each.features for each in self._recent])
        except AlignmentError as error:
            self._refuse(str(error), [view_id])
            return
        expected = self._expected[view_id]
        pose = invert_rigid(found.pose) @ expected @ _pose_of(view)
        if revision := self._set_pose(view_id, view, pose, found.moved_from(expected)):
            if view_id in self.moved:
                self._held_from[view_id] = revision
            self._expected[view_id], self.moved, self._in_a_row = found.pose, self.moved - {view_id}, 0

    def _set_pose(self, view_id: str, view: ViewConfig, pose: Tensor, move: CameraMove) -> int | None:
        """The view's new revision, unless a command has changed it meanwhile. move: what the event tells."""
        changed = replace(view, pose=tuple(pose.flatten().tolist()))
        revision = self._live.set_view(view_id, changed, instead_of=view)
        if revision is not None:
            self._asked_s.pop(view_id, None)
            self._notice_change()
            fields = {"view": view_id, "view_rev": revision, "goal": changed.plain, **_rounded(move)}
            self._announcer.event("VIEW_ALIGNED", Level.OK, fields)
        return revision

    def _miss(self, reason: str) -> None:
        """The camera sees nothing of what it saw first: it was turned away, or something stands before it."""
        self._announcer.health.camera = None
        self._unseen_s = self._unseen_s or time.monotonic()
        self._refuse(reason, self._asked_s)
        if self._anchor is None:  # nor was there anything
            waiting = [each for each, view in self._views().items() if view.pose is None]
            self._unaligned.update({"view": waiting[0], "message": reason} if waiting else None)
        elif time.monotonic() - self._unseen_s > _UNSEEN_S and not self._found_by_reference():
            self.moved = frozenset(self._expected.keys() & self._views().keys())
            self._moves.update({"message": f"the source camera no longer sees what it saw at the start: {reason}"})

    def _refuse(self, reason: str, view_ids: Iterable[str]) -> None:
        """Answer what was asked for these views."""
        for view_id in list(view_ids):
            if self._asked_s.pop(view_id, None) is not None:
                self._announcer.event("ALIGN_FAILED", Level.WARN, {"view": view_id, "message": reason})

    def _found_by_reference(self) -> bool:
        """Whether a reference tells where the camera stands now; it is compared with what it sees now from here on."""
        for view_id, view in self._views().items():
            try:
                found = align(self._recent, self._references[view_id])
            except AlignmentError:
                continue
            if view_id in self._expected:
                now_from_anchor = found.pose @ invert_rigid(self._expected[view_id] @ _pose_of(view))
                self._expected = {each: now_from_anchor @ pose for each, pose in self._expected.items()}
                self._anchor, self._last = self._recent[-1], None
                return True
        return False


def _pose_of(view: ViewConfig) -> Tensor:
    return torch.tensor(pose_matrix(view.pose or ()), dtype=torch.float64).view(4, 4)


def _is_beyond(found: Alignment, expected: Tensor, times: float = 1.0, sigmas: float = 1.0) -> bool:
    """Whether the camera surely stands farther from there than it may, or so many times farther."""
    move = found.moved_from(expected)
    aside_px = found.lens.fx * _MOVED_CM / 100 / float(np.median(found.inliers.point[:, 2]))
    return found.preference(expected) > _PREFERRED and (
        move.centimetres - sigmas * move.doubt_centimetres > times * _MOVED_CM
        or move.degrees - sigmas * move.doubt_degrees > times * _MOVED_DEG
        or move.pixels - sigmas * move.doubt_pixels > times * aside_px
    )


def _rounded(move: CameraMove) -> dict[str, float]:
    return {name: round(number, 3) for name, number in asdict(move).items()}
