"""What of a scene a view cannot see: its triangles in groups that stand together, each within a sphere.

A camera on a street sees a quarter of it, the sun's shadow map about half. What is left out lies outside of the
picture: the pictures are the same to the pixel.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.compile import Run, Vertices
from gcd_train.scenes.description import STATIC, Floats

_CELL_M = 16.0
"""Side of the squares on the ground by which what stands still is parted."""
_SLACK_M = 0.01
"""Added to every sphere: OpenGL places corners with 24 bits, here they are placed with 53."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Groups:
    """Triangles that follow each other, are painted alike, ride on one body and stand near each other.

    ends: [G + 1] int, group g has the vertices ends[g] to ends[g + 1]. body: [G] int. centre: [G, 3], metres in the
    body's frame, and radius: [G], metres, of a sphere that holds the group.
    """

    ends: NDArray[np.int64]
    body: NDArray[np.int64]
    centre: NDArray[np.float64]
    radius: NDArray[np.float64]

    def placed(self, poses: Floats) -> NDArray[np.float64]:
        """Where the spheres are when the bodies are at `poses` [B, 3, 4] (world_from_body): [G, 3], metres."""
        rows = poses[self.body].astype(np.float64)
        return (rows[..., :3] @ self.centre[..., None])[..., 0] + rows[..., 3]

    def within(self, clip_from_world: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which groups reach into the picture of a projection [4, 4], at `places` as `placed` gives them: bool [G]."""
        last = clip_from_world[3]
        planes = np.concatenate([last + clip_from_world[:3], last - clip_from_world[:3]])  # each >= 0 within [6, 4]
        planes /= np.linalg.norm(planes[:, :3], axis=1, keepdims=True)
        inside = places @ planes[:, :3].T + planes[:, 3]  # metres from each side of the picture [G, 6]
        return (inside >= -self.radius[:, None]).all(1)

    def stretches(self, shown: NDArray[np.bool_], first: int, count: int) -> Iterator[tuple[int, int]]:
        """Of `count` vertices from `first`, whole groups, those `shown` [G]: first vertex and number of each piece."""
        start, stop = np.searchsorted(self.ends, (first, first + count))
        edges = np.flatnonzero(np.diff(np.concatenate([[False], shown[start:stop], [False]])))
        at = self.ends[start + edges].tolist()
        for begin, end in zip(at[::2], at[1::2], strict=True):
            yield begin, end - begin


def grouped(vertices: Vertices, runs: Sequence[Run]) -> tuple[Vertices, Groups]:
    """Vertices with those of a group beside each other, within the runs that they are drawn in, and the groups.

    vertices: [N], runs: as `runs_of` gives them. Groups stand in the order of their first triangle.
    """
    triangles = vertices.reshape(-1, 3)
    body = triangles["tags"][:, 0, 2].astype(np.int64)
    cell = np.floor(triangles["position"][:, 0, :2] / _CELL_M).astype(np.int64) * (body == STATIC)[:, None]
    run = np.repeat(np.arange(len(runs)), [each.count // 3 for each in runs])
    keys = np.stack([run, body, cell[:, 0], cell[:, 1]], 1)
    _, first, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    rank = np.empty_like(first)
    rank[np.argsort(first)] = np.arange(len(first))
    group = rank[which.reshape(-1)]
    sorted_triangles = triangles[np.argsort(group, kind="stable")]
    counts = np.bincount(group, minlength=len(first))
    ends = 3 * np.concatenate([[0], np.cumsum(counts)])
    centre, radius = _spheres(sorted_triangles["position"].reshape(-1, 3).astype(np.float64), ends)
    found = Groups(ends=ends, body=body[np.sort(first)], centre=centre, radius=radius)
    return sorted_triangles.reshape(-1), found


def _spheres(corners: NDArray[np.float64], ends: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """About the box of each group: centres [G, 3] and radii [G]."""
    starts, counts = ends[:-1], np.diff(ends)
    if len(starts) == 0:
        return np.empty((0, 3)), np.empty(0)
    centre = (np.minimum.reduceat(corners, starts) + np.maximum.reduceat(corners, starts)) / 2
    away = np.linalg.norm(corners - np.repeat(centre, counts, axis=0), axis=1)
    return centre, np.maximum.reduceat(away, starts) + _SLACK_M
