"""What the target camera sees: from a scene's kept geometry, or from the points of the cameras nearest to it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics
from gcd_train.datasets.dataset4d import Dataset4D
from gcd_train.errors import RenderError
from gcd_train.layouts.manifest import GEOMETRY, SceneManifest, read_manifest
from gcd_train.pointcloud import published_picture
from gcd_train.scene_view import SceneView
from gcd_train.scenes.frozen import FrozenScene
from gcd_train.show.footage import Bytes

Poses = NDArray[np.float64]
_CAMERAS = 6


@dataclass(frozen=True, kw_only=True, slots=True)
class TargetPictures:
    """colour: u8 [T, H, W, 3]. depth: f32 [T, H, W] metres, None where it is not known. told: how they were made."""

    colour: Bytes
    depth: NDArray[np.float32] | None
    told: str


def target_pictures(
    data: Dataset4D, scene: str, numbers: Sequence[int], world_from_target: Poses, lens: Intrinsics, *, exact: bool
) -> TargetPictures:
    """The scene's frames `numbers` from poses [T, 4, 4]. Raises FileFault naming what cannot be read."""
    folder = data.folder(scene)
    if exact and (folder / GEOMETRY).exists():
        try:
            manifest = read_manifest(folder)
            return _rendered(FrozenScene.load(folder / GEOMETRY), manifest, numbers, world_from_target, lens)
        except RenderError:
            pass  # no renderer on this machine; points need none
    cameras = _nearest(data, scene, numbers[0], world_from_target)
    colour = [
        published_picture(
            [_thinned(view) for view in data.views(scene, number, cameras)],
            pose,
            lens,
            width=lens.width,
            height=lens.height,
        )
        for number, pose in zip(numbers, world_from_target, strict=True)
    ]
    return TargetPictures(colour=np.stack(colour), depth=None, told=f"points of the\n{len(cameras)} nearest cameras")


def _rendered(
    scene: FrozenScene, manifest: SceneManifest, numbers: Sequence[int], poses: Poses, lens: Intrinsics
) -> TargetPictures:
    try:
        from gcd_train.scenes.renderer import Renderer  # an extra
    except ImportError as error:
        raise RenderError(f"no renderer ({error})") from error
    if manifest.world_from_vehicle is not None:
        poses = np.array(manifest.world_from_vehicle, np.float64)[list(numbers)] @ poses
    moments = replace(scene, poses=scene.poses[list(numbers)], focus=scene.focus[list(numbers)], hfov_deg=lens.hfov_deg)
    with Renderer(lens.width, lens.height, oversample=1) as renderer:
        views = [view for _, _, view in renderer.views(moments, {"target": poses})]
    return TargetPictures(
        colour=np.stack([view.rgb for view in views]),
        depth=np.stack([view.depth for view in views]),
        told="rendered from the\nscene's geometry",
    )


def _nearest(data: Dataset4D, scene: str, time: int, world_from_target: Poses) -> list[str]:
    """The source and the cameras that see most of what the path sees: by place and direction at its ends and middle."""
    views = {camera: data.views(scene, time, [camera])[0] for camera in data.cameras}
    ends = world_from_target[[0, len(world_from_target) // 2, -1]]

    def far(camera: str) -> float:
        pose = views[camera].world_from_camera
        apart = np.linalg.norm(ends[:, :3, 3] - pose[:3, 3], axis=1)
        turned = 1.0 - ends[:, :3, 2] @ pose[:3, 2]
        return float((apart / 10.0 + turned).min())

    others = sorted((camera for camera in data.cameras if camera != data.source_camera), key=far)
    return [data.source_camera, *others[: _CAMERAS - 1]]


def _thinned(view: SceneView, factor: int = 2) -> SceneView:
    """Every other pixel of a view; a large picture still has more points than the target pixels."""
    if view.lens.width < 400:
        return view
    lens, first = view.lens, factor // 2
    rgb, depth = (np.ascontiguousarray(rows[first::factor, first::factor]) for rows in (view.rgb, view.depth))
    thin = Intrinsics(
        fx=lens.fx / factor,
        fy=lens.fy / factor,
        cx=(lens.cx - first - 0.5) / factor + 0.5,
        cy=(lens.cy - first - 0.5) / factor + 0.5,
        width=rgb.shape[1],
        height=rgb.shape[0],
    )
    return replace(view, rgb=rgb, depth=depth, classes=None, instances=None, lens=thin)
