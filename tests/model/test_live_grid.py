"""Grids of made-up streets: what is free, occupied and unknown, and what is remembered of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gcd_model import CameraMount, Grid, GridMapper, Intrinsics, SeenFrame
from gcd_model.live.eyes import FrameGeometry
from gcd_model.live.grid import FREE, NEVER_SEEN, OCCUPIED, SEEN_BEFORE, SEEN_NOW, UNKNOWN

MOUNT = CameraMount(height_m=1.5, forward_m=1.0, tilt_deg=5.0)
LENS = Intrinsics.from_hfov(80.0, 96, 64)
ROAD, BUILDING, CAR = 1, 5, 8
EXTENT = (-5.0, 20.0, -10.0, 10.0)


def street(
    *boxes: tuple[float, float, float, float, float], label: int = BUILDING, x: float = 0.0, yaw_deg: float = 0.0
) -> SeenFrame:
    """Of a vehicle at x with a heading, where boxes face the camera: from x, y from, y to, z from, z to, thin sheets
    across the road of the world."""
    yaw = np.radians(yaw_deg)
    world_from_vehicle = np.eye(4)
    world_from_vehicle[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    world_from_vehicle[0, 3] = x
    vehicle_from_camera = MOUNT.vehicle_from_camera.numpy()
    pose = world_from_vehicle @ vehicle_from_camera
    right, down = LENS.rays().double().numpy()
    rays = np.stack([right, down, np.ones_like(right)]).reshape(3, -1)
    directions, eye = pose[:3, :3] @ rays, pose[:3, 3]
    with np.errstate(divide="ignore"):
        metres = np.where(directions[2] < 0, -eye[2] / directions[2], 1000.0)
    labels = np.where(metres < 1000, ROAD, 0)
    for at, y0, y1, z0, z1 in boxes:
        depth = (at - eye[0]) / directions[0]
        there = eye[:, None] + depth * directions
        hit = (depth > 0) & (depth < metres) & (there[1] > y0) & (there[1] < y1) & (there[2] > z0) & (there[2] < z1)
        metres, labels = np.where(hit, depth, metres), np.where(hit, label, labels)
    shape = (LENS.height, LENS.width)
    world_from_source = np.linalg.inv(vehicle_from_camera) @ pose  # the world begins as the first camera
    return SeenFrame(
        picture=torch.zeros(3, *shape),
        geometry=FrameGeometry(
            metres=torch.from_numpy(metres.reshape(shape)).float(),
            labels=torch.from_numpy(labels.reshape(shape).astype(np.uint8)),
            static=torch.ones(shape, dtype=torch.bool),
            ood=0.0,
        ),
        lens=LENS,
        floor=None,
        world_from_source=torch.from_numpy(world_from_source),
        begins=False,
        lost=None,
    )


def mapper(seconds: float = 2.0) -> GridMapper:
    return GridMapper(MOUNT, extent_m=EXTENT, cell_m=0.5, seconds=seconds)


def at(grid: Grid, x: float, y: float) -> tuple[int, int, int]:
    """Occupancy, visibility and class at a place on the vehicle."""
    j, i = int((y - EXTENT[2]) / 0.5), int((x - EXTENT[0]) / 0.5)
    return tuple(int(layer[j, i]) for layer in (grid.occupancy, grid.visibility, grid.classes))


WALL = (10.0, -2.0, 2.0, 0.0, 3.0)


def test_ground_is_free_a_wall_occupied_and_what_was_never_seen_unknown() -> None:
    grid = mapper().update(street(WALL), 0.0)
    assert at(grid, 6.25, 0.25) == (FREE, SEEN_NOW, ROAD)
    assert at(grid, 10.25, 0.25) == (OCCUPIED, SEEN_NOW, BUILDING)
    assert at(grid, 9.75, 0.25)[0] != FREE  # within half a cell of it
    for x, y in ((-3.25, 0.25), (0.25, 5.25), (15.25, 0.25)):  # behind, beside, hidden
        assert at(grid, x, y) == (UNKNOWN, NEVER_SEEN, 0)
    assert grid.height_m[20, 30] == pytest.approx(2.0, abs=0.3)
    assert np.array_equal(grid.visibility == NEVER_SEEN, (grid.age_ms == 0) & (grid.visibility == 0))


def test_a_kerb_is_ground_and_ground_under_something_is_not_free() -> None:
    grid = mapper().update(street((8.0, -2.0, 2.0, 0.0, 0.15)), 0.0)
    assert at(grid, 8.25, 0.25)[0] != OCCUPIED
    hanging = mapper().update(street((8.0, -2.0, 2.0, 0.6, 3.0)), 0.0)
    assert at(hanging, 8.25, 0.25)[0] == OCCUPIED
    assert at(hanging, 10.25, 0.25)[0] == UNKNOWN  # its ground is in the picture
    assert at(hanging, 10.25, 6.25)[0] == FREE


def test_ground_close_in_front_of_something_is_free_only_by_measured_depth() -> None:
    hanging = street((15.0, -6.0, 6.0, 0.6, 3.0))
    learned = replace(hanging, geometry=replace(hanging.geometry, spread=torch.zeros(64, 96)))
    measured, estimated = (mapper().update(each, 0.0) for each in (hanging, learned))
    assert (at(measured, 14.25, 0.25)[0], at(estimated, 14.25, 0.25)[:2]) == (FREE, (UNKNOWN, NEVER_SEEN))
    assert at(measured, 12.25, 0.25)[0] == at(estimated, 12.25, 0.25)[0] == FREE


def test_what_stands_is_remembered_where_it_is_while_the_vehicle_moves_and_turns() -> None:
    made = mapper()
    made.update(street(WALL), 0.0)
    grid = made.update(street(x=4.0, yaw_deg=90.0), 0.5)  # looks to the left, sees nothing of it
    assert at(grid, -0.25, -6.25)[:2] == (OCCUPIED, SEEN_BEFORE)
    assert int(grid.age_ms[grid.occupancy == OCCUPIED].min()) == 500
    assert at(grid, -0.25, -2.25)[:2] == (UNKNOWN, SEEN_BEFORE)  # free ground was seen too long ago
    assert not (made.update(street(x=4.0, yaw_deg=90.0), 2.6).occupancy == OCCUPIED).any()


def test_what_moves_is_forgotten_at_once_and_what_is_seen_past_soon() -> None:
    car = street(WALL, label=CAR)
    moving = replace(car, geometry=replace(car.geometry, static=torch.zeros_like(car.geometry.static)))
    for first, gone_after in ((moving, 1), (car, 1), (street(WALL), 1)):
        made = mapper()
        assert at(made.update(first, 0.0), 10.25, 0.25)[0] == OCCUPIED
        for number in range(gone_after):
            grid = made.update(street((18.0, -6.0, 6.0, 0.0, 3.0)), 0.1 + number / 10)
        assert not (grid.occupancy[:, :36] == OCCUPIED).any()


def test_a_new_world_knows_nothing_of_the_old_one_and_a_hole_proves_nothing() -> None:
    made = mapper()
    made.update(street(WALL), 0.0)
    seen = street(x=4.0, yaw_deg=90.0)
    assert not (made.update(replace(seen, begins=True), 0.1).visibility == SEEN_BEFORE).any()
    blind = replace(seen, geometry=replace(seen.geometry, metres=torch.full((64, 96), torch.nan)))
    assert (made.update(replace(blind, begins=True), 0.2).occupancy == UNKNOWN).all()
    doubted = replace(seen, geometry=replace(seen.geometry, spread=torch.full((64, 96), 0.5)))
    assert (made.update(replace(doubted, begins=True), 0.3).visibility == NEVER_SEEN).all()
