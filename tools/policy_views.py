"""What a policy is shown of a moved camera: its picture as it is, or turned back to where the policy learned.

All know how the camera was moved. The homography knows the table's plane as well, homography-height also how high
over it the things stand; two views are given exact depth.
"""

import cv2
import numpy as np
import torch
from policy_world import CAMERA, HEIGHT, LENS, WIDTH
from torch import Tensor

from gcd_model.live.eyes import Eyes, Floor, SeenWorld
from gcd_model.live.paint_net import filled, seen_of
from gcd_model.live.splat import splat, unproject
from gcd_model.live.synthesizer import Painter
from gcd_model.networks import LiveNetworks

VIEWS = ("none", "homography", "homography-height", "splat-exact", "canonical-learned", "canonical-exact")
_BENCH_M = 1.6
"""Nearer than this are table, arm and things."""


def to_network(pictures: Tensor) -> Tensor:
    """uint8 [..., H, W, 3] → float32 [..., 3, H, W] in [-1, 1]."""
    return pictures.movedim(-1, -3).float() / 127.5 - 1


class Correction:
    """One view of one moved camera, picture by picture.

    view: of VIEWS. camera: table_from_camera [4, 4] of the moved one. networks: of the live model. raised_m: how high
    the things stand. depth_errors: median relative error of learned depth nearer than 1.6 m, a number a picture.
    """

    def __init__(self, view: str, camera: np.ndarray, networks: LiveNetworks, raised_m: float) -> None:
        self._view, self._camera = view, camera
        self._plane_m = raised_m if view == "homography-height" else 0.0
        self._moved_from_learned = torch.from_numpy(np.linalg.inv(camera) @ CAMERA)
        self._eyes, self._world = Eyes(networks), SeenWorld(networks.config)
        self._painter = Painter(networks, steps=networks.config.steps)
        self.depth_errors: list[float] = []

    def __call__(self, picture: np.ndarray, metres: np.ndarray) -> Tensor:
        """picture: uint8 [H, W, 3]; metres: exact depth [H, W] → [3, H, W] in [-1, 1]."""
        if self._view.startswith("homography"):
            picture = self._by_plane(picture)
        shown, depth = to_network(torch.from_numpy(picture)), torch.from_numpy(metres).float()
        if self._view == "splat-exact":
            return self._splatted(shown, depth)
        if self._view.startswith("canonical"):
            return self._canonical(shown, depth, exact=self._view == "canonical-exact")
        return shown

    def _by_plane(self, picture: np.ndarray) -> np.ndarray:
        """Exact for what lies on the plane; its border goes on outwards."""
        plane = np.array([[1, 0, 0], [0, 1, 0], [0, 0, self._plane_m], [0, 0, 1]])
        moved, learned = (LENS.matrix.numpy() @ np.linalg.inv(pose)[:3] @ plane for pose in (self._camera, CAMERA))
        to_centres = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
        move = to_centres @ moved @ np.linalg.inv(learned) @ np.linalg.inv(to_centres)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(
            cv2.warpPerspective(picture, move, (WIDTH, HEIGHT), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        )

    def _splatted(self, picture: Tensor, depth: Tensor) -> Tensor:
        """This picture's points alone; holes have the colours around."""
        nothing = torch.zeros(HEIGHT, WIDTH)
        points = unproject(depth, picture, nothing.to(torch.uint8), LENS, torch.eye(4), 1.0)
        seen = splat(points, self._moved_from_learned, LENS, classes=1, now=1.0)
        return filled(seen_of(seen, None, LENS.rays(), nothing, torch.zeros(12)))[0].clamp(-1, 1)

    def _canonical(self, picture: Tensor, depth: Tensor, *, exact: bool) -> Tensor:
        """The live model's view, frame by frame as a node runs it for a camera that stands where it was put."""
        up = torch.from_numpy(self._camera[2, :3].copy()).float()
        floor = Floor(up=up, height_m=float(self._camera[2, 3]))
        still = torch.eye(4, dtype=torch.float64)
        seen = self._eyes.see(picture, lens=LENS, depth=depth if exact else None, odometry=still, floor=floor)
        if not exact:
            near = (depth > 0) & (depth < _BENCH_M)
            self.depth_errors.append(float((seen.geometry.metres / depth - 1)[near].abs().median()))
        return self._painter.paint(self._world.place(seen, [self._moved_from_learned]))[0].picture.clamp(-1, 1)
