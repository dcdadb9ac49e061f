"""The streets of a grown driving world: a winding main road and the roads that cross it, all of them alike in kind."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.driving.road import Crossing, Road

STEP_M = 2.0
_START_M, _END_M = -160.0, 340.0
_SIDE_M = 130.0
_APART_M = 48.0
_CALM_M = 22.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Street:
    """main: the ego's road; its s = 0 is the middle of the drive. crossed: the roads across it, one for each of
    `main.crossings`; their s = 0 lies on the main road's centre line, and s grows to its left.
    """

    main: Road
    crossed: tuple[Road, ...]

    @property
    def roads(self) -> tuple[Road, ...]:
        """All of them, the main one first."""
        return (self.main, *self.crossed)


def random_street(random: np.random.Generator) -> Street:
    """A layout drawn at random. Roads neither meet themselves nor each other but in their crossings."""
    crossings = _random_crossings(random)
    s = np.arange(_START_M, _END_M + STEP_M, STEP_M)
    headings = _winding(s, crossings, random)
    main = _road(s, headings, crossings, random, lanes=(3, 3))
    made = [_side_road(main, crossing, random) for crossing in crossings]
    kept = [i for i, road in enumerate(made) if all(_apart(road, other) for other in made[:i])]
    crossings = tuple(
        replace(crossings[i], half_m=(made[i].right_m + made[i].left_m) / 2, at_m=crossings[i].at_m) for i in kept
    )
    return Street(main=replace(main, crossings=crossings), crossed=tuple(made[i] for i in kept))


def _random_crossings(random: np.random.Generator) -> tuple[Crossing, ...]:
    """Places of crossings; their widths follow from the roads."""
    made: list[Crossing] = []
    for _ in range(int(random.choice([0, 1, 2, 3], p=[0.12, 0.38, 0.32, 0.18]))):
        at, zebra = float(random.uniform(-45, 125)), bool(random.random() < 0.7)
        if all(abs(at - other.at_m) > _APART_M for other in made):
            made.append(Crossing(at_m=at, half_m=4.0, zebra=zebra))
    return tuple(sorted(made, key=lambda crossing: crossing.at_m))


def _winding(
    s: NDArray[np.float64], crossings: tuple[Crossing, ...], random: np.random.Generator
) -> NDArray[np.float64]:
    """Headings that sway but never turn back; straight in junctions, 0 at s = 0. No bend below 60 m of radius."""
    long, short = float(random.uniform(280, 480)), float(random.uniform(140, 240))
    sway = float(random.choice([0.0, 0.35, 0.6])) * float(random.uniform(0.7, 1.0))
    wave = sway * np.sin(2 * np.pi * (s / long + random.uniform())) + 0.15 * sway * np.sin(
        2 * np.pi * (s / short + random.uniform())
    )
    curvature = np.gradient(wave, s)
    for crossing in crossings:
        curvature = curvature * (1 - np.exp(-(((s - crossing.at_m) / _CALM_M) ** 4)))
    headings = np.cumsum(np.clip(curvature, -1 / 60, 1 / 60)) * STEP_M
    return headings - np.interp(0.0, s, headings)


def _road(
    s: NDArray[np.float64],
    headings: NDArray[np.float64],
    crossings: tuple[Crossing, ...],
    random: np.random.Generator,
    lanes: tuple[int, int],
) -> Road:
    steps = np.stack([np.cos(headings), np.sin(headings)], -1) * STEP_M
    points = np.cumsum(steps, 0)
    points -= [np.interp(0.0, s, points[:, i]) for i in (0, 1)]
    right, left = (int(random.choice([1, 2, 3], p=[0.5, 0.4, 0.1])) for _ in range(2))
    strips = [float(random.uniform(2.25, 2.6)) if random.random() < 0.55 else 0.0 for _ in range(2)]
    return Road(
        points=points,
        headings=headings,
        lane_m=float(random.uniform(3.2, 3.7)),
        lanes_right=min(right, lanes[0]),
        lanes_left=min(left, lanes[1]),
        parking_m=(strips[0], strips[1]),
        pavement_m=float(random.uniform(2.4, 4.6)),
        verge_m=float(random.choice([0.0, random.uniform(1, 6)])),
        crossings=crossings,
        start_m=float(s[0]),
    )


def _side_road(main: Road, crossing: Crossing, random: np.random.Generator) -> Road:
    """A road square across the main one, which it sees as its own crossing; further out all of them run alike."""
    s = np.arange(-_SIDE_M, _SIDE_M + STEP_M, STEP_M)
    x, y, heading = main.at(crossing.at_m)
    settled = float(np.mean(main.headings)) + 0.2 * float(random.uniform(-1, 1))
    share = np.clip((np.abs(s) - 25.0) / 60.0, 0, 1)
    headings = np.pi / 2 + heading + (settled - heading) * share**2 * (3 - 2 * share)
    across = Crossing(
        at_m=(main.left_m - main.right_m) / 2,
        half_m=(main.left_m + main.right_m) / 2,
        zebra=bool(random.random() < 0.5),
    )
    road = _road(s, headings, (across,), random, lanes=(2, 2))
    return replace(_symmetric(road), points=road.points + np.array([x, y]))


def _symmetric(road: Road) -> Road:
    """As many lanes one way as the other, so that the junction is centred where the roads meet."""
    lanes = min(road.lanes_left, road.lanes_right)
    strip = min(road.parking_m)
    return replace(road, lanes_left=lanes, lanes_right=lanes, parking_m=(strip, strip))


def _apart(road: Road, other: Road) -> bool:
    """Whether two side roads keep room for houses between them."""
    gaps = np.linalg.norm(road.points[:, None] - other.points[None], axis=-1)
    return bool(gaps.min() > 30.0)
