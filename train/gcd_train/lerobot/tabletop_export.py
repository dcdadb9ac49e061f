"""Episodes of the tabletop world as a LeRobot data set: what a real robot with several cameras would have recorded."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics
from gcd_train.errors import RecipeError, RunError
from gcd_train.files import new_folder
from gcd_train.lerobot.folder import CameraCalibration
from gcd_train.lerobot.writer import ExportOptions, LeRobotWriter, LoggedEpisode
from gcd_train.scenes.drop import HFOV_DEG, orbit_cameras
from gcd_train.scenes.frozen import freeze
from gcd_train.scenes.renderer import Renderer
from gcd_train.scenes.tabletop import FPS, UNITS_A_METRE, Episode, tabletop_episode, upright_base

WRIST = "wrist"
_IMAGES = "observation.images."
_POSE_FEATURE = f"observation.camera_pose.{WRIST}"
Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class TabletopExport:
    """How episodes are made.

    seeds: one an episode. frames: of an episode, at 24 Hz. cameras: of view0..view15 and wrist, which moves with the
    hand; the others stand where Kubric-4D has them, turned so that they look at every episode's robot alike.
    width, height: pixels. oversample: as in `Renderer`.
    """

    seeds: range
    frames: int = 120
    cameras: tuple[str, ...] = ("view0", "view4", "view9", WRIST)
    width: int = 320
    height: int = 240
    oversample: int = 2


def export_tabletop(out: Path, export: TabletopExport) -> Iterator[int]:
    """Write the data set `out`; yields how many episodes are done. The folder appears when all are.

    Raises:
        RecipeError: no such camera. RunError: `out` is there already, or cannot be written.
        RenderError, DataError: an extra is not installed.
    """
    poses = _base_from_cameras(export.cameras)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise RunError(f"{out} is there already; choose another folder, or remove it")
    names = {_POSE_FEATURE: [f"base_from_camera_{row}{column}" for row in range(4) for column in range(4)]}
    options = ExportOptions(robot="tabletop primitive", fps=round(FPS), names=names)
    with (
        new_folder(out.absolute().parent, out.name) as folder,
        Renderer(export.width, export.height, oversample=export.oversample) as renderer,
        LeRobotWriter(folder, _calibrations(export, poses), options) as writer,
    ):
        for done, seed in enumerate(export.seeds, start=1):
            episode = tabletop_episode(seed, frames=export.frames, skipped_s=0.0)
            features = {"observation.state": episode.motion.state, "action": episode.motion.action}
            if WRIST in export.cameras:
                base_from_wrist = np.linalg.inv(episode.world_from_base) @ episode.wrist
                features[_POSE_FEATURE] = _in_metres(base_from_wrist).reshape(-1, 16)
            logged = LoggedEpisode(features=features, task=episode.task)
            writer.add(logged, _pictures(renderer, episode, poses, export))
            yield done


def _base_from_cameras(names: tuple[str, ...]) -> dict[str, Floats]:
    """base_from_camera [4, 4] of the cameras that stand still, decimetres."""
    there = orbit_cameras(1)
    unknown = [name for name in names if name not in there and name != WRIST]
    if unknown or len(set(names)) != len(names) or len(names) < 2:
        raise RecipeError(
            f"cameras must be two or more different ones of view0..view15 and {WRIST}, got {', '.join(names)}"
        )
    base_from_world = np.linalg.inv(upright_base())
    return {name: base_from_world @ there[name][0] for name in names if name != WRIST}


def _calibrations(export: TabletopExport, poses: Mapping[str, Floats]) -> dict[str, CameraCalibration]:
    lens = Intrinsics.from_hfov(HFOV_DEG, export.width, export.height)
    made: dict[str, CameraCalibration] = {}
    for name in export.cameras:
        rows = None if name == WRIST else tuple(map(tuple, _in_metres(poses[name]).tolist()))
        made[_IMAGES + name] = CameraCalibration(
            width=lens.width,
            height=lens.height,
            fx=lens.fx,
            fy=lens.fy,
            cx=lens.cx,
            cy=lens.cy,
            base_from_camera=rows,
            pose_feature=_POSE_FEATURE if name == WRIST else None,
        )
    return made


def _pictures(
    renderer: Renderer, episode: Episode, poses: Mapping[str, Floats], export: TabletopExport
) -> Iterator[Mapping[str, NDArray[np.uint8]]]:
    """A picture of every camera, frame by frame."""
    cameras = {name: np.tile(episode.world_from_base @ pose, (export.frames, 1, 1)) for name, pose in poses.items()}
    if WRIST in export.cameras:
        cameras[WRIST] = episode.wrist
    views = renderer.views(freeze(episode.scene), cameras)
    while seen := list(islice(views, len(cameras))):
        yield {_IMAGES + name: rendering.rgb for _, name, rendering in seen}


def _in_metres(poses: Floats) -> Floats:
    scaled = poses.copy()
    scaled[..., :3, 3] /= UNITS_A_METRE
    return scaled
