"""Small live clips made without a renderer: a textured floor and a box, seen by a pinhole camera by casting rays."""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save_file

from gcd_model.live.config import DepthConfig, LiveConfig, PaintConfig
from gcd_train.live.clips import encode_depth

FRAMES, HEIGHT, WIDTH, HFOV_DEG = 14, 32, 64, 80.0
FLOOR, BOX = 1, 8  # road, car
TINY = LiveConfig(
    height=HEIGHT,
    width=WIDTH,
    depth=DepthConfig(widths=(8, 16, 16), mixers=1, fine_width=8, half_width=8, bins=8),
    paint=PaintConfig(widths=(8, 16, 16), fine_width=8, half_width=8, embedding_width=16),
    memory=2000,
)


def looking_ahead(x: float, height: float, down_deg: float = 20.0) -> NDArray[np.float64]:
    """world_from_camera of a camera that looks along world x and somewhat down."""
    down = np.radians(down_deg)
    ahead = np.array([np.cos(down), 0.0, -np.sin(down)])
    right = np.array([0.0, -1.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], -1)
    pose[:3, 3] = [x, 0.0, height]
    return pose


def cast(pose: NDArray[np.float64]) -> tuple[NDArray[np.uint8], NDArray[np.float64], NDArray[np.uint8]]:
    """Picture [H, W, 3], depth [H, W] (0: sky) and labels of a floor at z = 0 and a wall-sided box ahead."""
    focal = WIDTH / 2 / np.tan(np.radians(HFOV_DEG) / 2)
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(u - WIDTH / 2) / focal, (v - HEIGHT / 2) / focal, np.ones_like(u)], -1) @ pose[:3, :3].T
    eye = pose[:3, 3]
    with np.errstate(divide="ignore"):
        floor = np.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], np.inf)
        front = (9.0 - eye[0]) / rays[..., 0]
    at = eye + front[..., None] * rays
    on_box = (np.abs(at[..., 1]) < 1.0) & (at[..., 2] > 0) & (at[..., 2] < 1.5) & (front > 0)
    depth = np.where(on_box, np.minimum(front, floor), floor)
    point = eye + np.where(np.isfinite(depth), depth, 0.0)[..., None] * rays
    tile = (np.floor(point[..., 0]) + np.floor(point[..., 1])).astype(int) & 1
    colour = np.where(tile[..., None] == 1, [200, 190, 150], [70, 80, 90])
    colour = np.where(on_box[..., None], [180, 40, 40], colour)
    colour = np.where(np.isfinite(depth)[..., None], colour, [120, 170, 230])
    labels = np.where(on_box, BOX, np.where(np.isfinite(depth), FLOOR, 0))
    return colour.astype(np.uint8), np.where(np.isfinite(depth), depth, 0.0), labels.astype(np.uint8)


def write_clip(folder: Path, seed: int, world: str = "driving") -> Path:
    """One clip: the source drives ahead, the target looks from above. The visibility is the splat's business: all 2."""
    start = 0.1 * (seed % 7)
    source = np.stack([looking_ahead(start + 0.2 * t, 1.5) for t in range(FRAMES)])
    target = np.stack([looking_ahead(start + 0.2 * t - 1.0, 3.0, 30.0) for t in range(FRAMES)])
    arrays: dict[str, NDArray[np.generic]] = {}
    for name, poses in (("source", source), ("target", target)):
        pictures, depths, labels = (np.stack(each) for each in zip(*map(cast, poses), strict=True))
        arrays |= {
            f"{name}.rgb": pictures,
            f"{name}.depth": encode_depth(depths),
            f"{name}.labels": labels,
            f"{name}.instances": (labels == BOX).astype(np.uint8),
            f"{name}.moves": np.zeros_like(labels),
            f"{name}.pose": poses,
        }
    arrays["target.visibility"] = np.full_like(arrays["target.labels"], 2)
    lenses = {"source_hfov_deg": HFOV_DEG, "target_hfov_deg": HFOV_DEG}
    facts = {"world": world, "fps": 10.0, **lenses, "floor_z_m": 0.0}
    path = folder / world / f"{seed:07d}-0.safetensors"
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file(arrays, path, metadata={"facts": json.dumps(facts)})
    return path
