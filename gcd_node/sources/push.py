"""Frames that somebody else pushes: a camera that a ROS driver, LeRobot or a program of the user's own holds open.

The node binds, whoever has frames connects (gcd_client.FramePusher; docs/cameras.md). Nothing that arrives is trusted.
"""

import logging
import time
from dataclasses import replace

import zmq

from gcd_client.frames import PushedFrame, decode_frame
from gcd_client.protocol import MAX_HEADER, MAX_PAYLOAD, PREFIX, ClientError, MessageError
from gcd_node.auth import EventSink, ServerSecurity, SocketGuard, unbind
from gcd_node.errors import DepthError, SourceError, SourceLostError
from gcd_node.frame import Frame, SourceInfo
from gcd_node.sources import PushSource, SourceKind
from gcd_node.sources.depth import clean_depth
from gcd_node.sources.live import LiveCamera

_LOG = logging.getLogger(__name__)
_WAIT_MS = 100
_QUEUED = 2
_FARTHEST_NS = 10_000_000_000  # a stamp that is farther from now is of another clock
_UNCERTAINTY_US = 10_000
_SILENT_S = 0.5  # a pusher that is silent for so long has made way for another one
_HINT = "start who pushes them, or correct endpoint in [source]; state fps there if they come slowly"


def open_push(
    config: PushSource, security: ServerSecurity | None = None, on_event: EventSink | None = None
) -> LiveCamera:
    """The first who pushes frames, as a camera.

    Args:
        security: keys and clients of a tcp endpoint; only operators may push. on_event: gets AUTH_DENIED.
    """
    return LiveCamera(
        f"the push source at {config.endpoint}",
        lambda: _PushDriver(config, security, on_event),
        open_timeout_s=config.open_timeout_s,
        hint=_HINT,
    )


class _PushDriver:
    """A bound socket as a Driver. Stamps arrive in UTC; the node's are of its monotonic clock."""

    def __init__(self, config: PushSource, security: ServerSecurity | None, on_event: EventSink | None) -> None:
        """Raises EndpointError, ConfigError, SetupError: see SocketGuard.bind()."""
        self.kind: SourceKind = "push"
        self.fps, self.corrupt = config.fps, 0
        self._pusher, self._heard_s = "", 0.0
        self._warned = False
        self._guard = SocketGuard(security, on_event)
        try:
            self._socket = self._guard.context.socket(zmq.PULL)
            self._socket.set(zmq.RCVHWM, _QUEUED)
            self._socket.set(zmq.MAXMSGSIZE, PREFIX.size + MAX_HEADER + MAX_PAYLOAD)
            self._endpoint = self._guard.bind(self._socket, config.endpoint, "frames")
            self.id = self._endpoint.rpartition("/")[2]
        except BaseException:
            self._guard.close()
            raise

    def read(self) -> Frame | None:
        self._guard.wait(_WAIT_MS)
        if not self._socket.poll(0):
            return None
        parts = self._socket.recv_multipart(copy=False)
        try:
            if len(parts) != 1:
                raise MessageError(f"a pushed frame is one part, got {len(parts)}")
            return self._frame(decode_frame(parts[0].buffer))
        except SourceLostError:
            raise
        except (ClientError, SourceError) as error:
            self.corrupt += 1
            self._warn(f"a pushed frame is refused: {error}")
            return None

    def describe(self, info: SourceInfo) -> SourceInfo:
        return replace(info, stamp_uncertainty_us=_UNCERTAINTY_US)

    def close(self) -> None:
        unbind(self._socket, self._endpoint, 0)
        self._guard.close()

    def _warn(self, text: str) -> None:
        """Of what may happen with every frame, once."""
        if not self._warned:
            _LOG.warning("%s (told once, counted from here on)", text)
        self._warned = True

    def _frame(self, pushed: PushedFrame) -> Frame:
        """Raises SourceError, MessageError: it is refused; SourceLostError: another camera takes over."""
        late_ns = time.time_ns() - pushed.stamp_ns
        if abs(late_ns) > _FARTHEST_NS:
            raise MessageError(
                f"its stamp is {late_ns / 1e9:.1f} s before now: stamps are UTC, as time.time_ns() gives them"
            )
        now_s = time.monotonic()
        if pushed.pusher != self._pusher:
            if self._pusher and now_s - self._heard_s < _SILENT_S:
                raise MessageError("somebody else pushes frames here already: give each camera a node of its own")
            if self._pusher:
                raise SourceLostError("somebody else pushes frames from now on")
            self._pusher = pushed.pusher
        self._heard_s = now_s
        depth = None
        try:
            if pushed.depth is not None:
                depth = clean_depth(pushed.depth, pushed.image.shape[:2])
        except DepthError as error:
            self._warn(f"frame {pushed.seq} goes without its depth: {error}")
        stamp_ns = time.monotonic_ns() - late_ns
        return Frame(image=pushed.image, stamp_ns=stamp_ns, seq=pushed.seq, depth=depth, odometry=pushed.odometry)
