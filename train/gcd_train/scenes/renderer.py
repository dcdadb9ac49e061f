"""A headless OpenGL renderer: one draw call gives colour, depth, instance and class of a view.

The shadow map of a time step is drawn once and shared by its cameras; programs and primitives are cached. Works on
software OpenGL (Mesa's llvmpipe) as on a GPU.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from gcd_train.errors import RenderError
from gcd_train.scenes.compile import VERTEX
from gcd_train.scenes.description import Floats, Light, Scene
from gcd_train.scenes.frozen import FrozenScene, freeze
from gcd_train.scenes.shaders import FRAGMENT, SHADOW_FRAGMENT, SHADOW_VERTEX
from gcd_train.scenes.shaders import VERTEX as VERTEX_SHADER

_NEAR_M, _FAR_M = 0.3, 900.0
_SHADOW_PIXELS, _SHADOW_RADIUS_M = 1024, 55.0
_FORMAT = "3f4 3f4 4f1 4u1"
_NAMES = ("position", "normal", "colour", "tags")
_BODIES = 256


@dataclass(frozen=True, kw_only=True, slots=True)
class Rendering:
    """One view of one time step.

    rgb: u8 [H, W, 3]. depth: f32 [H, W], metres along the optical axis, 0 where there is only sky.
    classes, instances: u8 [H, W].
    """

    rgb: NDArray[np.uint8]
    depth: Floats
    classes: NDArray[np.uint8]
    instances: NDArray[np.uint8]


class Renderer:
    """Draws scenes at one size. Not thread-safe; one a process.

    oversample: pixels drawn per output pixel along each side; colours are averaged, depth and labels are picked.
    Raises RenderError without a headless OpenGL.
    """

    def __init__(self, width: int, height: int, *, oversample: int = 2) -> None:
        self._width, self._height, self._oversample = width, height, oversample
        self._context = _context()
        self._program = self._context.program(vertex_shader=VERTEX_SHADER, fragment_shader=FRAGMENT)
        self._shadow_program = self._context.program(vertex_shader=SHADOW_VERTEX, fragment_shader=SHADOW_FRAGMENT)
        size = (width * oversample, height * oversample)
        self._colour = self._context.renderbuffer(size, 4)
        self._facts = self._context.renderbuffer(size, 2, dtype="f4")
        depth = self._context.depth_renderbuffer(size)
        self._target = self._context.framebuffer([self._colour, self._facts], depth)
        self._shadow = self._context.depth_texture((_SHADOW_PIXELS, _SHADOW_PIXELS))
        self._shadow.compare_func = "<="
        self._shadow_target = self._context.framebuffer(depth_attachment=self._shadow)
        self._bodies = self._context.texture((3, _BODIES), 4, dtype="f4")
        self._bodies.filter = (self._context.NEAREST, self._context.NEAREST)

    def render(self, scene: Scene) -> dict[str, list[Rendering]]:
        """Every camera of a scene, at every time step.

        Raises: RenderError if there are more bodies than the renderer can move.
        """
        made: dict[str, list[Rendering]] = {name: [] for name in scene.cameras}
        for _, name, view in self.views(freeze(scene), scene.cameras):
            made[name].append(view)
        return made

    def views(
        self, scene: FrozenScene, cameras: Mapping[str, NDArray[np.float64]]
    ) -> Iterator[tuple[int, str, Rendering]]:
        """Time step, camera and view, one after the other, so that a long scene needs no memory for all.

        cameras: name -> world_from_camera [T, 4, 4]. All cameras of a time step follow each other.
        Raises: RenderError if there are more bodies than the renderer can move.
        """
        if scene.poses.shape[1] > _BODIES:
            raise RenderError(f"a scene may have {_BODIES} bodies, got {scene.poses.shape[1]}; split it")
        buffer = self._context.buffer(scene.vertices.tobytes())
        full = self._context.vertex_array(self._program, [(buffer, _FORMAT, *_NAMES)])
        shadow_format = f"3f4 {VERTEX.itemsize - 16}x 4u1"
        shadow = self._context.vertex_array(self._shadow_program, [(buffer, shadow_format, "position", "tags")])
        try:
            self._set_light(scene.light)
            for step in range(scene.frames):
                self._move(scene.poses[step])
                self._cast(scene.light, scene.focus[step], shadow)
                for name, poses in cameras.items():
                    yield step, name, self._view(poses[step], scene.hfov_deg, full)
        finally:
            for resource in (full, shadow, buffer):
                resource.release()

    def _move(self, poses: Floats) -> None:
        rows = np.zeros((_BODIES, 3, 4), np.float32)
        rows[: len(poses)] = poses
        self._bodies.write(rows.tobytes())
        self._bodies.use(0)

    def _cast(self, light: Light, focus: Floats, array: Any) -> None:
        light_from_world = _sun_matrix(np.asarray(light.sun_to), focus.astype(np.float64))
        self._shadow_target.use()
        self._context.enable_only(self._context.DEPTH_TEST)
        self._shadow_target.clear(depth=1.0)
        _set(self._shadow_program, clip_from_world=light_from_world, bodies=0)
        array.render()
        _set(self._program, light_from_world=light_from_world)

    def _view(self, world_from_camera: NDArray[np.float64], hfov_deg: float, array: Any) -> Rendering:
        self._target.use()
        self._context.enable_only(self._context.DEPTH_TEST | self._context.CULL_FACE)
        self._target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
        self._shadow.use(1)
        aspect = self._width / self._height
        matrix = _clip_from_camera(hfov_deg, aspect) @ np.linalg.inv(world_from_camera)
        eye, ahead = world_from_camera[:3, 3], world_from_camera[:3, 2]
        _set(self._program, clip_from_world=matrix, eye=eye, ahead=ahead, bodies=0, shadow=1)
        array.render()
        return self._read()

    def _read(self) -> Rendering:
        n = self._oversample
        shape = (self._height * n, self._width * n)
        colour = np.frombuffer(self._target.read(components=3, attachment=0), np.uint8).reshape(*shape, 3)[::-1]
        facts = np.frombuffer(self._target.read(components=2, attachment=1, dtype="f4"), np.float32)
        picked = facts.reshape(*shape, 2)[::-1][n // 2 :: n, n // 2 :: n]
        labels = picked[..., 1].astype(np.int32)
        averaged = colour.reshape(self._height, n, self._width, n, 3).mean((1, 3), dtype=np.float32)
        return Rendering(
            rgb=np.rint(averaged).astype(np.uint8),
            depth=np.ascontiguousarray(picked[..., 0]),
            classes=(labels & 255).astype(np.uint8),
            instances=(labels >> 8).astype(np.uint8),
        )

    def _set_light(self, light: Light) -> None:
        _set(
            self._program,
            sun_to=light.sun_to,
            sun=light.sun,
            sky=light.sky,
            ground=light.ground,
            horizon=light.horizon,
            zenith=light.zenith,
            fog_m=light.fog_m,
            cloud=light.cloud,
            exposure=light.exposure,
        )

    def close(self) -> None:
        """Give the OpenGL context back."""
        self._context.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _context() -> Any:
    try:
        import moderngl  # an optional dependency: only generating needs it
    except ImportError as error:
        raise RenderError("rendering needs the extra `scenes`: pip install 'gcd-node[scenes]'") from error
    try:
        return moderngl.create_standalone_context(backend="egl")  # pyright: ignore[reportArgumentType]
    except Exception as error:
        raise RenderError(
            f"no headless OpenGL ({error}); on Debian or Ubuntu: apt-get install libegl1 libgl1-mesa-dri"
        ) from error


def _set(program: Any, **uniforms: Any) -> None:
    """Set what the compiler kept; matrices are given row by row, OpenGL wants columns."""
    for name, value in uniforms.items():
        if name not in program:
            continue
        array = np.asarray(value)
        program[name].value = value if array.ndim == 0 else tuple(array.astype(float).T.flatten().tolist())


def _clip_from_camera(hfov_deg: float, aspect: float) -> NDArray[np.float64]:
    """From camera axes (x right, y down, z ahead) to OpenGL's clip space."""
    focal = 1 / math.tan(math.radians(hfov_deg) / 2)
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[1, 1] = focal, -focal * aspect
    matrix[2, 2] = (_FAR_M + _NEAR_M) / (_FAR_M - _NEAR_M)
    matrix[2, 3] = -2 * _FAR_M * _NEAR_M / (_FAR_M - _NEAR_M)
    matrix[3, 2] = 1
    return matrix


def _sun_matrix(sun_to: NDArray[np.float64], focus: NDArray[np.float64]) -> NDArray[np.float64]:
    """Orthographic view along the sunlight around `focus`, snapped to whole shadow pixels against flicker."""
    aside = [0.0, 0.0, 1.0] if abs(sun_to[2]) < 0.99 else [1.0, 0.0, 0.0]  # any axis that is not the sun's
    right = np.cross(aside, sun_to)
    right /= np.linalg.norm(right)
    up = np.cross(sun_to, right)
    turn = np.stack([right, up, sun_to])
    pixel = 2 * _SHADOW_RADIUS_M / _SHADOW_PIXELS
    centre = np.round(turn @ focus / pixel) * pixel
    matrix = np.eye(4)
    matrix[:2, :3] = turn[:2] / _SHADOW_RADIUS_M
    matrix[:2, 3] = -centre[:2] / _SHADOW_RADIUS_M
    matrix[2, :3] = -turn[2] / 150.0
    matrix[2, 3] = centre[2] / 150.0
    return matrix
