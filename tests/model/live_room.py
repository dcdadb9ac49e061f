"""A small clip whose depth and odometry are known, for tests of the live model."""

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

from gcd_model import Clip, Intrinsics, Trajectory
from gcd_model.geometry import pose_trajectory

HEIGHT, WIDTH, FRAMES = 32, 64, 14
LENS = Intrinsics.from_hfov(70.0, WIDTH, HEIGHT)


def room(frames: int = FRAMES, **more: object) -> Clip:
    """A camera that walks along a wall with a bright pattern, 3 m away, and says how far."""
    across = torch.arange(WIDTH) + 2.0 * torch.arange(frames)[:, None, None]
    pattern = torch.sin(across / 3) * torch.cos(torch.arange(HEIGHT)[:, None] / 4)
    video = torch.stack([pattern, pattern.roll(5, -1), -pattern], dim=1).float() * 0.8
    poses = torch.eye(4, dtype=torch.float64).repeat(frames, 1, 1)
    poses[:, 0, 3] = torch.arange(frames) * (2.0 * 3.0 / LENS.fx)
    depth = torch.full((frames, HEIGHT, WIDTH), 3.0)
    return replace(Clip(video=video, fps=10.0, lens=LENS, depth=depth, odometry=poses), **more)


def path(x: float = 0.5, frames: int = FRAMES) -> Trajectory:
    poses = torch.eye(4, dtype=torch.float64).repeat(frames, 1, 1)
    poses[:, 0, 3] = x
    return pose_trajectory(poses)


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """As a node computes; import it where it is wanted."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
