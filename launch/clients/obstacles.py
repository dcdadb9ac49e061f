"""Obstacles from pixels that the camera sees now, of models that send `vis` and `depth`.

Needs gcd-client alone: `python obstacles.py [ENDPOINT]`. What is seen is still moved by an estimated depth, so give
each point the margin that its error needs. No point means nothing: it adds no caution, and never says go.
"""

import sys

import numpy as np
from numpy.typing import NDArray

from gcd_client import ReceivedView, ViewSubscriber
from gcd_client.images import SEEN_NOW


def seen_points(vis: ReceivedView, depth: ReceivedView) -> NDArray[np.float64]:
    """What the camera sees in the newest frame, [N, 3] metres in its axes: x right, y down, z ahead."""
    header = depth.header
    if header.intrinsics is None or header.source_from_view is None or header.pose_units != "m" or header.quality.ood:
        return np.empty((0, 3))
    inverse = depth.inverse_depth[-1]  # 1/m; 0: sky, or none
    rows, columns = np.nonzero((vis.images[-1, ..., 0] == SEEN_NOW) & (inverse > 0))
    fx, _, cx, _, fy, cy, *_ = header.intrinsics
    z = 1.0 / inverse[rows, columns].astype(np.float64)
    in_view = np.stack([(columns - cx) * z / fx, (rows - cy) * z / fy, z, np.ones_like(z)])
    source_from_view = np.reshape(header.source_from_view[-1], (4, 4))
    return (source_from_view @ in_view)[:3].T


def nearest_ahead_m(points: NDArray[np.float64], half_width_m: float = 1.2, camera_height_m: float = 1.5) -> float:
    """The nearest obstacle in the corridor ahead, at least 0.3 m above the ground; infinity adds nothing, never: go."""
    x, y, z = points.T
    ahead = z[(np.abs(x) < half_width_m) & (y < camera_height_m - 0.3) & (z > 0)]
    return float(ahead.min()) if ahead.size else float("inf")


class SeenObstacles:
    """Joins the visibility and the depth of one window."""

    def __init__(self, endpoint: str = "ipc", view: str = "topdown", max_age_ms: float = 10_000.0) -> None:
        self.maps = ViewSubscriber(endpoint, view, ("vis", "depth"), conflate=False, max_age_ms=max_age_ms)
        self._vis: ReceivedView | None = None

    def poll(self, wait_ms: float = 100.0) -> NDArray[np.float64] | None:
        """The points of a window whose depth has just come; None if nothing has, or it cannot be used."""
        received = self.maps.receive(wait_ms)
        if received is None or received.expired:
            return None
        if received.message.topic.endswith("/vis"):  # its depth comes next
            self._vis = received
            return None
        vis, self._vis = self._vis, None
        return seen_points(vis, received) if vis is not None and same_window(vis, received) else None


def same_window(a: ReceivedView, b: ReceivedView) -> bool:
    names = ("boot_id", "view_rev", "window_id")
    return all(getattr(a.header, name) == getattr(b.header, name) for name in names)


def main(endpoint: str = "ipc") -> None:
    obstacles = SeenObstacles(endpoint)
    while not obstacles.maps.ended:
        points = obstacles.poll()
        if points is not None:
            print(f"{len(points)} points seen, nearest ahead at {nearest_ahead_m(points):.1f} m")
    obstacles.maps.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
