"""Tiny scenes in the published layouts, drawn by analytic ray casting and written without our writers."""

import json
import shutil
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics, Spherical, look_at, to_pose

WIDTH, HEIGHT = 48, 32
FRAMES = 16
BOX_MIN, BOX_MAX = np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 2.0])
GROUND, BOX, SKY = 24, 5, 29
COLOURS = {GROUND: (92, 88, 104), BOX: (0, 0, 142), SKY: (122, 176, 230), 255: (0, 0, 0)}
NAMES = {GROUND: "Road", BOX: "Car", SKY: "Sky", 255: "Void"}
PALETTE = [(0, 0, 0), (250, 40, 30), (20, 220, 90)]
KUBRIC_LENS = Intrinsics.from_hfov(2 * np.degrees(np.arctan(0.5)), WIDTH, HEIGHT)
DRIVING_LENS = Intrinsics.from_hfov(85.0, WIDTH, 36)


@dataclass(frozen=True)
class Drawn:
    """rgb u8 [H, W, 3], depth f32 [H, W] planar (30 000 m: sky), ids u8 [H, W] of GROUND, BOX and SKY."""

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    ids: NDArray[np.uint8]


def draw(world_from_camera: NDArray[np.float64], lens: Intrinsics, *, time: int = 0, box_x: float = 0.0) -> Drawn:
    """A chequered ground z = 0 with a box on it; the box gets brighter with time."""
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    rays = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones_like(u)], -1)
    rays = rays @ world_from_camera[:3, :3].T
    origin = world_from_camera[:3, 3]
    shift = np.array([box_x, 0.0, 0.0])
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(rays[..., 2] < 0, -origin[2] / rays[..., 2], np.inf)
        ends = np.stack([(BOX_MIN + shift - origin) / rays, (BOX_MAX + shift - origin) / rays])
        enter, leave = ends.min(0).max(-1), ends.max(0).min(-1)
    box = np.where((enter < leave) & (enter > 0), enter, np.inf)
    ground = np.where(ground > 200.0, np.inf, ground)
    depth = np.minimum(np.minimum(box, ground), 30_000.0).astype(np.float32)
    hit = origin + rays * np.where(np.isfinite(ground), ground, 0)[..., None]
    chequer = (np.floor(hit[..., 0] / 4) + np.floor(hit[..., 1] / 4)) % 2  # 4 m
    ids = np.where(box <= ground, BOX, GROUND)
    ids = np.where(depth >= 30_000.0, SKY, ids).astype(np.uint8)
    rgb = np.zeros((*ids.shape, 3), np.uint8)
    rgb[...] = np.where(chequer[..., None] > 0, (180, 150, 120), (60, 80, 100))
    rgb[ids == BOX] = (100 + 5 * time, 40, 200)
    rgb[ids == SKY] = (130, 180, 250)
    return Drawn(rgb, depth, ids)


def write_png(path: Path, rgb: NDArray[np.uint8], *, alpha: bool = False) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    bgr = np.ascontiguousarray(rgb[..., ::-1])
    if alpha:
        bgr = np.concatenate([bgr, np.full((*bgr.shape[:2], 1), 255, np.uint8)], -1)
    assert cv2.imwrite(str(path), bgr)


def palette_png(ids: NDArray[np.uint8], palette: list[tuple[int, int, int]] = PALETTE, bits: int = 8) -> bytes:
    """An indexed PNG, or a grey one without a palette; rows are filtered by `up`, which palette pictures may be."""
    height, width = ids.shape
    packed = (
        ids if bits == 8 else np.packbits(np.unpackbits(ids[..., None], -1)[..., 8 - bits :].reshape(height, -1), -1)
    )
    rows = np.full((height, packed.shape[1] + 1), 2, np.uint8)
    rows[0, 1:], rows[1:, 1:] = packed[0], packed[1:] - packed[:-1]
    header = struct.pack(">IIBBBBB", width, height, bits, 3 * bool(palette), 0, 0, 0)
    colours = bytes(channel for colour in palette for channel in colour)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes())), (b"IEND", b"")]
    chunks[1:1] = [(b"PLTE", colours)] * bool(palette)
    packed_chunks = [
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed_chunks)


def quaternion(rotation: NDArray[np.float64]) -> list[float]:
    """w x y z of a rotation without a half turn."""
    w = np.sqrt(max(1e-12, 1 + np.trace(rotation))) / 2
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    return [float(w), *(axis / (4 * w)).tolist()]


def kubric_poses(views: int = 4) -> list[NDArray[np.float64]]:
    """Cameras about the scene."""
    return [
        to_pose(Spherical(azimuth_deg=20.0 + 90.0 * view, elevation_deg=(35.0, 10.0)[view % 2], radius_m=15.0)).numpy()
        for view in range(views)
    ]


def copy_scene(scene: Path, copy: Path) -> Path:
    """The same scene under another name."""
    shutil.copytree(scene, copy)
    for file in copy.glob(f"{scene.name}*"):
        file.rename(copy / file.name.replace(scene.name, copy.name))
    return copy


def edit_json(path: Path, change: Callable[[Any], object]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


VIEWS = tuple(f"view{number}" for number in range(4))


def write_kubric(root: Path, number: int = 0, *others: int, views: int = 4, frames: int = FRAMES) -> Path:
    """A scene folder as published, and others of the same scene; the first."""
    scene = root / f"scn{number:05d}"
    lens = KUBRIC_LENS
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    lengths = np.sqrt(1 + ((u - lens.cx) / lens.fx) ** 2 + ((v - lens.cy) / lens.fy) ** 2)
    for view, pose in enumerate(kubric_poses(views)):
        folder = scene / f"frames_p0_v{view}"
        folder.mkdir(parents=True)
        blender = pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])
        metadata = {
            "scene": {"resolution": [WIDTH, HEIGHT], "frame_rate": 24, "num_frames": frames, "gravity": [0, 0, -9.81]},
            "camera": {
                "focal_length": 32.0,
                "positions": [pose[:3, 3].tolist()] * frames,
                "quaternions": [quaternion(blender)] * frames,
                "K": [[lens.fx / WIDTH, 0.0, -0.5], [0.0, -lens.fy / HEIGHT, -0.5], [0.0, 0.0, -1.0]],
            },
            "instances": [{"asset_id": "box"}],
        } | ({"collisions": [1, 2, 3]} if view == 0 else {})
        (scene / f"{scene.name}_p0_v{view}.json").write_text(json.dumps(metadata))
        for time in range(frames):
            drawn = draw(pose, lens, time=time)
            write_png(folder / f"rgba_{time:05d}.png", drawn.rgb, alpha=True)
            assert cv2.imwrite(str(folder / f"depth_{time:05d}.tiff"), (drawn.depth * lengths).astype(np.float32))
            ids = np.where(drawn.ids == BOX, 1, 0).astype(np.uint8)
            (folder / f"segmentation_{time:05d}.png").write_bytes(palette_png(ids))
    for other in others:
        copy_scene(scene, root / f"scn{other:05d}")
    return scene


DRIVING_POSES = {
    "yaw-0": ((1.6, 0.0, 1.55), (6.6, 0.0, 1.55)),
    "yaw-60": ((1.6, 0.0, 1.55), (4.1, 4.33, 1.55)),
    "camera0": ((-2.0, -6.0, 5.0), (9.0, 0.0, 0.5)),
}
"""Position and looked-at point in the vehicle's frame."""
CAMERAS = tuple(DRIVING_POSES)


def driving_pose(camera: str) -> NDArray[np.float64]:
    position, target = (torch.tensor(point, dtype=torch.float64) for point in DRIVING_POSES[camera])
    return look_at(position, target).numpy()


def write_driving(root: Path, number: int = 0, *others: int, frames: int = FRAMES, spelling: int = 0) -> Path:
    """As write_kubric; spelling 1 has the other names of poses."""
    scene = root / f"scene_{number:06d}"
    lens = DRIVING_LENS
    for camera in DRIVING_POSES:
        for time in range(frames):
            drawn = draw(driving_pose(camera), lens, time=time, box_x=9.0)
            stem = f"{10 * time + 5:018d}"
            write_png(scene / "rgb" / camera / f"{stem}.png", drawn.rgb)
            (scene / "depth" / camera).mkdir(parents=True, exist_ok=True)
            np.savez_compressed(scene / "depth" / camera / f"{stem}.npz", data=drawn.depth)
            ids = np.zeros((*drawn.ids.shape, 3), np.uint8)
            ids[..., 0] = drawn.ids
            write_png(scene / "semantic_segmentation_2d" / camera / f"{stem}.png", ids)
            ids[..., 0], ids[..., 1] = np.where(drawn.ids == BOX, 44, 0), np.where(drawn.ids == BOX, 1, 0)
            write_png(scene / "instance_segmentation_2d" / camera / f"{stem}.png", ids)
    (scene / "calibration").mkdir()
    (scene / "calibration" / "a1b2c3.json").write_text(json.dumps(calibration(spelling)))
    (scene / "ontology").mkdir()
    (scene / "ontology" / "d4e5f6.json").write_text(json.dumps(ontology()))
    for other in others:
        copy_scene(scene, root / f"scene_{other:06d}")
    return scene


def calibration(spelling: int = 0) -> dict[str, list[object]]:
    lens = DRIVING_LENS
    rotation, translation, q = ("rotation", "translation", "q") if spelling == 0 else ("orientation", "position", "")
    told: dict[str, list[object]] = {
        "names": ["velodyne"],
        "intrinsics": [None],
        "extrinsics": [{"rotation": {"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0}, "translation": {"z": 2.0}}],
    }
    for camera in DRIVING_POSES:
        pose = driving_pose(camera)
        told["names"].append(camera)
        told["intrinsics"].append({"fx": lens.fx, "fy": lens.fy, "cx": lens.cx, "cy": lens.cy, "skew": 0, "fov": 1.48})
        numbers = quaternion(pose[:3, :3])
        told["extrinsics"].append(
            {
                rotation: {f"{q}{axis}": number for axis, number in zip("wxyz", numbers, strict=True)},
                translation: dict(zip("xyz", pose[:3, 3].tolist(), strict=True)),
            }
        )
    return told


def ontology() -> dict[str, object]:
    items = [
        {"id": number, "name": NAMES[number], "color": dict(zip("rgb", colour, strict=True)), "isthing": False}
        for number, colour in COLOURS.items()
    ]
    return {"items": items}
