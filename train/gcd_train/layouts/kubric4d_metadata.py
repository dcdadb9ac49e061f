"""The JSON beside each view of a Kubric-4D scene."""

import itertools
import math
from typing import Any

import numpy as np

from gcd_model.geometry import Intrinsics
from gcd_train.layouts.camera_facts import Doubles, blender_pose, project, quaternions
from gcd_train.layouts.instance_tracks import InstanceTracks
from gcd_train.scenes.description import Scene, SceneObject, rotations

STEP_RATE_HZ = 480
"""Of the physics of both worlds in this layout."""
_GRAVITY_M_S2 = 9.81
_SENSOR_MM = 32.0
_DIGITS = 5
"""Decimals of metres and shares: hundredths of a millimetre."""

Json = dict[str, Any]


def view_metadata(
    scene: Scene, camera: str, objects: tuple[SceneObject, ...], tracks: InstanceTracks, lens: Intrinsics, facts: Json
) -> Json:
    """Everything the published file tells of one view.

    objects: number k has the id k + 1 in the segmentation and in `tracks`. facts: seed and fps of the scene.
    """
    poses = scene.cameras[camera]
    instances = [_instance(thing, k + 1, tracks, poses, lens) for k, thing in enumerate(objects)]
    seen = int((tracks.pixels[:, 1 : len(objects) + 1].sum(0) > 0).sum())
    background = scene.facts.get("surroundings", "procedural")
    return {
        "scene": {
            "resolution": [lens.width, lens.height],
            "frame_rate": facts["fps"],
            "step_rate": STEP_RATE_HZ,
            "gravity": [0.0, 0.0, -_GRAVITY_M_S2 / float(scene.facts.get("metres_a_unit", 1.0))],
            "num_frames": scene.frames,
            "background": background,
            "num_instances": len(objects),
            "num_valo_instances": seen,
        },
        "camera": camera_metadata(poses, lens),
        "instances": instances,
        "dome": {"asset_id": background},
        "random_seed": facts["seed"],
    }


def camera_metadata(poses: Doubles, lens: Intrinsics) -> Json:
    """Of a camera with poses [T, 4, 4]: angles in radians, Blender's axes, K for pictures of size 1 x 1.

    With Blender's axes a point in front has a negative z: K turns it over, [[fx, 0, -cx], [0, -fy, -cy], [0, 0, -1]].
    R is the pose of the first frame, world from camera.
    """
    hfov = 2 * math.atan(lens.width / 2 / lens.fx)
    placed = blender_pose(poses)
    fx, fy = lens.fx / lens.width, lens.fy / lens.height
    cx, cy = lens.cx / lens.width, lens.cy / lens.height
    return {
        "focal_length": _SENSOR_MM * fx,
        "sensor_width": _SENSOR_MM,
        "field_of_view": hfov,
        "positions": placed[:, :3, 3].tolist(),
        "quaternions": quaternions(placed[:, :3, :3]).tolist(),
        "K": [[fx, 0.0, -cx], [0.0, -fy, -cy], [0.0, 0.0, -1.0]],
        "R": placed[0].tolist(),
    }


def _instance(thing: SceneObject, number: int, tracks: InstanceTracks, poses: Doubles, lens: Intrinsics) -> Json:
    shown = np.flatnonzero(tracks.pixels[:, number])
    scale = np.array([lens.height, lens.width, lens.height, lens.width])
    return {
        "asset_id": thing.name,
        "label": thing.label,
        "dynamic": thing.dynamic,
        "size": _rounded(np.asarray(thing.size)),
        "middle": _rounded(np.asarray(thing.middle)),
        "mass": thing.mass_kg,
        "friction": thing.friction,
        "restitution": thing.restitution,
        "positions": _rounded(thing.positions),
        "quaternions": _rounded(thing.quaternions),
        "velocities": _rounded(thing.velocities),
        "angular_velocities": _rounded(thing.angular_velocities),
        "image_positions": _rounded(project(thing.positions, poses, lens).at),
        "bboxes_3d": _rounded(_corners(thing)),
        "visibility": tracks.pixels[:, number].tolist(),
        "bboxes": _rounded(tracks.boxes[shown, number] / scale),
        "bbox_frames": shown.tolist(),
    }


def _corners(thing: SceneObject) -> Doubles:
    """[T, 8, 3] in the world."""
    unit = np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * thing.size + thing.middle
    return np.einsum("tij,kj->tki", rotations(thing.quaternions), unit) + thing.positions[:, None]


def _rounded(numbers: Doubles) -> Any:
    return np.round(numbers, _DIGITS).tolist()
