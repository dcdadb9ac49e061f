"""The bird's-eye grid of held-out drives beside the world's own triangles: what is marked occupied and free, and is.

    python tools/grid_figures.py --out DIR [--first-seed 1000200] [--drives 20] [--frames 20] [--cells 0.5,1]

Writes `report.md`, `drives.jsonl` (what was counted of each drive; a second run goes on) and a picture of some grids
beside the truth. A row differs from the one before it in one thing that is estimated instead of exact.

Compared are cells within 20 m of the vehicle that could be observed, by exact geometry and at the picture's pixels:
    occupied   some surface 0.3 to 2 m high lies in the cell, and a piece of it is what a pixel of the source shows (to
               1 % of its depth), now or, where it is part of the standing world, within the memory's seconds;
    free       none does, and ground is what pixels show at half or more of its places, within 0.2 s.
`anywhere` compares all cells within 20 m, seen or not. A cell that is marked free and holds any such surface, seen or
not, counts as falsely free, with the rule and without it.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model.geometry import CameraMount, Intrinsics
from gcd_model.live.config import SKY_M
from gcd_model.live.eyes import Eyes, Floor, SeenFrame
from gcd_model.live.grid import FREE, OCCUPIED, Grid, GridMapper
from gcd_model.networks import LiveNetworks
from gcd_train.data.sample import to_network
from gcd_train.evaluation.statistics import scene_weights
from gcd_train.evaluation.tables import markdown_rows
from gcd_train.live.training import live_model
from gcd_train.scenes.description import moved
from gcd_train.scenes.driving.world import driving_scene
from gcd_train.scenes.renderer import Renderer, Rendering
from gcd_train.scenes.triangles import FrozenScene, freeze

Array = NDArray[Any]

_EXTENT_M, _NEAR_M, _SECONDS, _FPS = (-10.0, 30.0, -20.0, 20.0), 20.0, 2.0, 10.0
_WAY_M, _FREE_S = (0.3, 2.0), 0.2
_GROUNDS_M = (-0.06, 0.0, 0.09, 0.12)
"""Heights of the driving world's terrain, road, courts and pavements."""
_PIECE_M, _PLACE_M, _REACH_M = 0.2, 0.25, 45.0
_SAME_SURFACE, _SAME_HEIGHT_M = 0.01, 0.035
_EGO, _FIRST, _EVERY = 1, 7, 4
"""The own vehicle's body; which frames of a drive are compared."""
_SHOWN, _COLOURS = 4, {"unknown": (90, 90, 90), "free": (255, 255, 255), "occupied": (200, 30, 30)}
_HIDDEN, _WRONG = (240, 190, 190), (255, 0, 255)
_ROWS = (
    "all exact",
    "classes and what moves estimated",
    "depth estimated, odometry exact",
    "all estimated, motion by the pictures",
)
_COUNTS = ("hit", "occupied", "free_hit", "free", "any_hit", "any_occupied", "any_free_hit", "any_free", "falsely")


class World:
    """What of a drive's world is where, and what the source has seen of it."""

    def __init__(self, scene: FrozenScene, poses: Array, lens: Intrinsics, mount: CameraMount, metres: Array) -> None:
        """poses: world_from_source [T, 4, 4]. metres: exact depth [T, H, W]."""
        self._scene, self._poses, self._lens, self._mount, self._metres = scene, poses, lens, mount, metres
        vehicle_from_camera = mount.vehicle_from_camera.numpy()
        self._vehicles = poses @ np.linalg.inv(vehicle_from_camera)
        self._up = np.tensordot(
            vehicle_from_camera[2, :3], np.stack([*lens.rays().numpy(), np.ones(metres[0].shape)]), 1
        )
        corners = scene.vertices["position"].reshape(-1, 3, 3).astype(np.float64)
        body, path = scene.vertices["tags"][::3, 2], self._vehicles[:, :2, 3]
        low, high = path.min(0) - _REACH_M, path.max(0) + _REACH_M
        self._still = _pieces(corners[body == 0], low, high)
        self._movers = {
            int(b): _pieces(corners[body == b], -high * np.inf, high * np.inf) for b in np.unique(body) if b > _EGO
        }
        sides = (np.arange(np.floor(a), b, _PLACE_M) for a, b in zip(low, high, strict=True))
        self._places = np.stack(np.meshgrid(*sides), -1).reshape(-1, 2)
        self._still_s, self._places_s = (np.full(len(each), -np.inf) for each in (self._still, self._places))

    def see(self, t: int) -> None:
        """The source takes frame t."""
        for points, stamps, seen in (
            (self._still, self._still_s, self._shown),
            (self._places, self._places_s, self._ground),
        ):
            near = np.flatnonzero(np.hypot(*(points[:, :2] - self._vehicles[t, :2, 3]).T) < _REACH_M)
            stamps[near[seen(points[near], t)]] = t / _FPS

    def grid(self, t: int, cell_m: float) -> tuple[Array, Array, Array]:
        """Where something is in the way, where some of that was seen, and where ground was: bool [H, W] each."""
        body = self._scene.poses[t].astype(np.float64)
        movers = np.concatenate(
            [np.zeros((0, 3)), *(p @ body[b, :, :3].T + body[b, :, 3] for b, p in self._movers.items())]
        )
        recent = self._still[t / _FPS - self._still_s <= _SECONDS + 1e-6]
        count = lambda points: self._count(points, t, cell_m)  # noqa: E731
        way = count(self._still) + count(movers) > 0
        seen = count(recent) + count(movers[self._shown(movers, t)]) > 0
        ground = count(self._places[t / _FPS - self._places_s <= _FREE_S + 1e-6])
        return way, seen, ground >= np.maximum(count(self._places), 1) / 2

    def _count(self, points: Array, t: int, cell_m: float) -> Array:
        vehicle_from_world = np.linalg.inv(self._vehicles[t])
        x, y = vehicle_from_world[:2, :2] @ points[:, :2].T + vehicle_from_world[:2, 3:]
        x0, x1, y0, y1 = _EXTENT_M
        sides = [np.arange(a, b + cell_m / 2, cell_m) for a, b in ((y0, y1), (x0, x1))]
        return np.histogram2d(y, x, bins=sides)[0]

    def _pixels(self, points: Array, t: int) -> tuple[Array, Array, Array, Array]:
        """Which points [N, 3] lie in the picture, and of those row, column and depth."""
        x, y, z = moved(np.linalg.inv(self._poses[t]), points).T
        u, v = (
            self._lens.fx * x / np.maximum(z, 0.1) + self._lens.cx,
            self._lens.fy * y / np.maximum(z, 0.1) + self._lens.cy,
        )
        inside = np.flatnonzero((z > 0.1) & (u >= 0) & (u < self._lens.width) & (v >= 0) & (v < self._lens.height))
        return inside, v[inside].astype(int), u[inside].astype(int), z[inside]

    def _shown(self, points: Array, t: int) -> Array:
        """Numbers of the points that lie on what their pixels show."""
        inside, row, column, z = self._pixels(points, t)
        return inside[np.abs(z / self._metres[t, row, column] - 1) <= _SAME_SURFACE]

    def _ground(self, places: Array, t: int) -> Array:
        """Numbers of the places [N, 2] at which pixels show ground."""
        height, found = self._mount.height_m + self._metres[t] * self._up, np.zeros(len(places), bool)
        for level in _GROUNDS_M:
            inside, row, column, _ = self._pixels(np.column_stack([places, np.full(len(places), level)]), t)
            found[inside[np.abs(height[row, column] - level) < _SAME_HEIGHT_M]] = True
        return np.flatnonzero(found)


def _pieces(corners: Array, low: Array, high: Array) -> Array:
    """Middles [N, 3] of small pieces of the triangles [M, 3, 3] that are in the way and within a rectangle."""
    found = [np.zeros((0, 3))]
    while len(corners):
        x_y, z = corners[..., :2], corners[..., 2]
        near = ((x_y.max(1) >= low) & (x_y.min(1) <= high)).all(1)
        corners = corners[near & (z.max(1) >= _WAY_M[0]) & (z.min(1) <= _WAY_M[1])]
        small = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1).max(1) <= _PIECE_M
        found.append(corners[small].mean(1))
        a, b, c = np.moveaxis(corners[~small], 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        corners = np.concatenate([np.stack(each, 1) for each in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    points = np.concatenate(found)
    return points[(points[:, 2] >= _WAY_M[0]) & (points[:, 2] <= _WAY_M[1])]


def seen_frames(
    networks: LiveNetworks, scene: FrozenScene, view: Rendering, poses: Array, mount: CameraMount
) -> Iterator[tuple[str, list[SeenFrame]]]:
    """What the source sees of a drive, for each of _ROWS."""
    lens, video = Intrinsics.from_hfov(mount.hfov_deg, *view.depth.shape[:0:-1]), to_network(view.rgb)
    floor = Floor(up=mount.vehicle_from_camera[2, :3].float(), height_m=mount.height_m)
    metres = torch.from_numpy(np.where(view.depth > 0, view.depth, SKY_M).astype(np.float32))
    moves = np.abs(np.diff(scene.poses, axis=0)).max((-1, -2)) > 1e-3
    moves = np.pad(moves, ((1, 0), (0, 0))) | np.pad(moves, ((0, 1), (0, 0)))
    world_from_source = torch.from_numpy(np.linalg.inv(poses[0]) @ poses)

    def look(**odometry: Any) -> list[SeenFrame]:
        eyes = Eyes(networks)
        given = world_from_source if odometry else [None] * len(video)
        return [
            eyes.see(frame, lens=lens, odometry=pose, floor=floor) for frame, pose in zip(video, given, strict=True)
        ]

    estimated = look(odometry=True)
    measured = [
        replace(each, geometry=replace(each.geometry, metres=depth, spread=None))
        for each, depth in zip(estimated, metres, strict=True)
    ]
    exact = [
        replace(
            each,
            geometry=replace(
                each.geometry,
                labels=torch.from_numpy(view.classes[t]),
                static=torch.from_numpy(~moves[t, view.bodies[t]]),
            ),
        )
        for t, each in enumerate(measured)
    ]
    yield from zip(_ROWS, (exact, measured, estimated, look()), strict=True)


def counted(grid: Grid, truth: tuple[Array, Array, Array], cell_m: float) -> dict[str, float]:
    """Cells by _COUNTS: of IoUs what both have and what either has, and how many of the free ones are not free."""
    way, seen, ground = truth
    x0, x1, y0, y1 = _EXTENT_M
    y, x = (np.arange(a + cell_m / 2, b, cell_m) for a, b in ((y0, y1), (x0, x1)))
    near = np.hypot(*np.meshgrid(x, y)) <= _NEAR_M
    observable = near & np.where(way, seen, ground)
    occupied, free = grid.occupancy == OCCUPIED, grid.occupancy == FREE
    sets = (
        *(occupied & way & observable, (occupied | way) & observable, free & ~way & observable),
        (free & near & way) | ((free | ~way) & observable),
        *(occupied & way & near, (occupied | way) & near, free & ~way & near, (free | ~way) & near),
        free & way & near,
    )
    return {name: int(each.sum()) for name, each in zip(_COUNTS, sets, strict=True)} | {
        "marked_free": int((free & near).sum())
    }


def measure_drive(
    networks: LiveNetworks, renderer: Renderer, seed: int, frames: int, cells: Sequence[float]
) -> tuple[dict[str, Any], Array]:
    """What was counted, and a picture."""
    mount = CameraMount()
    scene = driving_scene(seed, frames=frames, mount=mount)
    frozen, poses = freeze(scene), scene.cameras["source"]
    view = renderer.render(frozen, {"source": poses})["source"]
    lens = Intrinsics.from_hfov(mount.hfov_deg, *view.depth.shape[:0:-1])
    world, truths = (
        World(frozen, poses, lens, mount, np.where(view.depth > 0, view.depth, SKY_M)),
        dict[tuple[int, float], Any](),
    )
    for t in range(frames):
        world.see(t)
        if t >= _FIRST and (t - _FIRST) % _EVERY == 0:
            truths |= {(t, cell_m): world.grid(t, cell_m) for cell_m in cells}
    shown, strips, counts, cpu_ms, lost = (
        max(t for t, _ in truths),
        list[Array](),
        dict[str, dict[str, float]](),
        list[float](),
        0,
    )
    for row, seen in seen_frames(networks, frozen, view, poses, mount):
        lost = sum(each.lost is not None for each in seen)
        for cell_m in cells:
            mapper, sums = GridMapper(mount, extent_m=_EXTENT_M, cell_m=cell_m, seconds=_SECONDS), dict[str, float]()
            for t, frame in enumerate(seen):
                begun_s = time.thread_time()
                grid = mapper.update(frame, t / _FPS)
                if cell_m == cells[0]:
                    cpu_ms.append(1000 * (time.thread_time() - begun_s))
                if (t, cell_m) in truths:
                    for name, count in counted(grid, truths[t, cell_m], cell_m).items():
                        sums[name] = sums.get(name, 0) + count
                if t == shown and cell_m == cells[0]:
                    strips.append(picture(grid, truths[t, cell_m]))
            counts[f"{row}, {cell_m:g} m"] = sums
    way, sight, ground = truths[shown, cells[0]]
    truth = np.full((*way.shape, 3), _COLOURS["unknown"], np.uint8)
    for mask, colour in ((ground, _COLOURS["free"]), (way, _HIDDEN), (sight, _COLOURS["occupied"])):
        truth[mask] = colour
    strips = [enlarged(each) for each in (truth, *strips)]
    scale = strips[0].shape[0]
    source = np.asarray(cv2.resize(view.rgb[shown], (scale * 3 // 2, scale)), np.uint8)
    facts = {"seed": seed, **{name: scene.facts[name] for name in ("weather", "district", "ego_m_s")}, "lost": lost}
    return facts | {"counts": counts, "cpu_ms": np.percentile(cpu_ms, [50, 95]).tolist()}, np.concatenate(
        [source, *strips], 1
    )


def picture(grid: Grid, truth: tuple[Array, Array, Array]) -> Array:
    """Its occupancy in colour; what is marked free and is not in another."""
    drawn = np.full((*grid.occupancy.shape, 3), _COLOURS["unknown"], np.uint8)
    drawn[grid.occupancy == FREE], drawn[grid.occupancy == OCCUPIED] = _COLOURS["free"], _COLOURS["occupied"]
    drawn[(grid.occupancy == FREE) & truth[0]] = _WRONG
    return drawn


def enlarged(drawn: Array) -> Array:
    """With x up and y to the left, as from above."""
    up = np.ascontiguousarray(np.swapaxes(drawn, 0, 1)[::-1, ::-1])
    return cv2.copyMakeBorder(
        cv2.resize(up, None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST), 0, 0, 6, 0, cv2.BORDER_CONSTANT
    )


def report(drives: Sequence[dict[str, Any]]) -> str:
    """Ratios of sums over drives with 95 % intervals, bootstrapped over drives."""
    columns: dict[str, Callable[[dict[str, Any]], tuple[float, float]]] = {
        "IoU occupied": lambda c: (c["hit"], c["occupied"]),
        "IoU free": lambda c: (c["free_hit"], c["free"]),
        "falsely free, %": lambda c: (100 * c["falsely"], c["marked_free"]),
        "anywhere: occupied": lambda c: (c["any_hit"], c["any_occupied"]),
        "anywhere: free": lambda c: (c["any_free_hit"], c["any_free"]),
    }
    weights, rows = scene_weights(len(drives)), list[list[str]]()
    for name in drives[0]["counts"]:
        cells = [name]
        for column in columns.values():
            over, under = np.array([column(drive["counts"][name]) for drive in drives], np.float64).T
            low, high = np.quantile((weights @ over) / np.maximum(weights @ under, 1e-9), [0.025, 0.975])
            cells.append(f"{over.sum() / max(under.sum(), 1e-9):.3f} [{low:.3f}, {high:.3f}]")
        rows.append(cells)
    times = np.median([drive["cpu_ms"] for drive in drives], axis=0)
    lost = sum(drive["lost"] > 0 for drive in drives)
    told = f"{len(drives)} drives; processor time of a grid: median {times[0]:.1f} ms, 95 % {times[1]:.1f} ms a frame; "
    return "\n".join(
        [told + f"motion by the pictures was lost in {lost} drives.", "", *markdown_rows(["", *columns], rows), ""]
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description="Grids of held-out drives beside the truth.")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--weights", default="package:live-small", help="a live model's")
    parser.add_argument("--first-seed", type=int, default=1_000_200)
    parser.add_argument("--drives", type=int, default=20)
    parser.add_argument("--frames", type=int, default=20, help="of each drive, at 10 Hz")
    parser.add_argument(
        "--cells", default="0.5,1", help="sides of cells, metres, with commas; the first is timed and drawn"
    )
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    networks, cells = (
        live_model(options.weights, device="cpu").networks,
        [float(each) for each in options.cells.split(",")],
    )
    lines = options.out / "drives.jsonl"
    drives = [json.loads(line) for line in lines.read_text().splitlines()] if lines.exists() else []
    with Renderer(192, 128, oversample=2) as renderer:
        for seed in range(options.first_seed, options.first_seed + options.drives):
            if seed in [drive["seed"] for drive in drives]:
                continue
            drive, drawn = measure_drive(networks, renderer, seed, options.frames, cells)
            drives.append(drive)
            with lines.open("a") as file:
                file.write(json.dumps(drive) + "\n")
            if len(drives) <= _SHOWN:
                cv2.imwrite(str(options.out / f"{seed}.png"), drawn[..., ::-1])
            (options.out / "report.md").write_text(report(drives))
            print(f"drive {len(drives)} of {options.drives}", flush=True)


if __name__ == "__main__":
    main()
