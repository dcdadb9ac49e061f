"""A headless OpenGL renderer: one pass gives colour, depth, instance and class of a view.

The shadow map of a time step is drawn once and shared by its cameras. A scene is one vertex buffer; it is drawn with
one call per way of painting (`shaders`), which is a handful. Works on software OpenGL (Mesa's llvmpipe) as on a GPU.
"""

import math
from collections.abc import Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_train.errors import RenderError
from gcd_train.scenes.description import Doubles, Extent, Floats
from gcd_train.scenes.shaders import SHADOW_FRAGMENT, SHADOW_VERTEX, fragment
from gcd_train.scenes.shaders import VERTEX as VERTEX_SHADER
from gcd_train.scenes.triangles import FrozenScene, Run, indexed, runs_of


def clip_from_camera(hfov_deg: float, aspect: float, extent: Extent) -> Doubles:
    """From camera axes (x right, y down, z ahead) to OpenGL's clip space: [4, 4]. aspect: width over height."""
    near, far = extent.near_m, extent.far_m
    focal = 1 / math.tan(math.radians(hfov_deg) / 2)
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[1, 1] = focal, -focal * aspect
    matrix[2, 2] = (far + near) / (far - near)
    matrix[2, 3] = -2 * far * near / (far - near)
    matrix[3, 2] = 1
    return matrix


def sunlight_from_world(sun_to: Doubles, focus: Doubles, extent: Extent) -> Doubles:
    """Orthographic view along the sunlight around `focus`, snapped to whole shadow pixels against flicker: [4, 4].

    sun_to: [3], unit vector. focus: [3], metres.
    """
    aside = [0.0, 0.0, 1.0] if abs(sun_to[2]) < 0.99 else [1.0, 0.0, 0.0]  # any axis that is not the sun's
    right = np.cross(aside, sun_to)
    right /= np.linalg.norm(right)
    up = np.cross(sun_to, right)
    turn = np.stack([right, up, sun_to])
    radius = extent.shadow_radius_m
    pixel = 2 * radius / extent.shadow_pixels
    centre = np.round(turn @ focus / pixel) * pixel
    matrix = np.eye(4)
    matrix[:2, :3] = turn[:2] / radius
    matrix[:2, 3] = -centre[:2] / radius
    matrix[2, :3] = -turn[2] / extent.shadow_depth_m
    matrix[2, 3] = centre[2] / extent.shadow_depth_m
    return matrix


_FIELDS = "3f4 3f4 4f1 4f1 4u1", "position", "normal", "colour", "accent", "tags"
"""A vertex buffer as programs read it; those that do not use a field step over it."""
_BODIES = 256
_LIFT = 0.06 / 55.0
"""Shadows are looked up this far off the surface, as a share of the shadow map's radius: half a shadow pixel."""
_LIGHTS = ("sun_to", "sun", "sky", "ground", "horizon", "zenith")
_NUMBERS = ("fog_m", "cloud", "exposure")
_Frame = np.dtype(
    [
        *((name, "16f4") for name in ("clip_from_world", "light_from_world")),  # column by column, as OpenGL wants them
        *((name, "4f4") for name in ("eye", "ahead", *_LIGHTS)),
        *((name, "f4") for name in (*_NUMBERS, "shadow_lift")),
    ]
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Rendering:
    """One view of one time step.

    rgb: u8 [H, W, 3]. depth: f32 [H, W], metres along the optical axis, 0 where there is only sky.
    classes, instances, bodies: u8 [H, W]; bodies index `Scene.poses`. Of several time steps all are [T, ...].
    """

    rgb: NDArray[np.uint8]
    depth: Floats
    classes: NDArray[np.uint8]
    instances: NDArray[np.uint8]
    bodies: NDArray[np.uint8]


class Renderer:
    """Draws scenes at one size. Not thread-safe, and one scene at a time; each has an OpenGL context of its own.

    oversample: pixels drawn per output pixel along each side; colours are averaged, depth and labels are picked.
    Raises RenderError without a headless OpenGL.
    """

    def __init__(self, width: int, height: int, *, oversample: int = 2) -> None:
        self._oversample, self._size = oversample, (width * oversample, height * oversample)
        self._context = _context()
        self._shadow_program = self._program(SHADOW_VERTEX, SHADOW_FRAGMENT)
        self._programs: dict[tuple[int, bool], Any] = {}
        colour = self._context.renderbuffer(self._size, 4)
        facts = self._context.renderbuffer(self._size, 2, dtype="f4")
        self._target = self._context.framebuffer([colour, facts], self._context.depth_renderbuffer(self._size))
        self._shadow: Any = None
        self._bodies = self._context.texture((3, _BODIES), 4, dtype="f4")
        self._bodies.filter = (self._context.NEAREST, self._context.NEAREST)
        self._frame = np.zeros((), _Frame)
        self._frame_block = self._context.buffer(reserve=_Frame.itemsize, dynamic=True)

    def views(
        self, scene: FrozenScene, cameras: Mapping[str, Doubles], hfov_deg: Mapping[str, float] | None = None
    ) -> Generator[tuple[int, str, Rendering], None, None]:
        """Time step, camera and view, one after the other, so that a long scene needs no memory for all.

        cameras: name -> world_from_camera [T, 4, 4]. All cameras of a time step follow each other.
        hfov_deg: name -> horizontal field of view; by default every camera has the scene's.
        Raises: RenderError if there are more bodies than the renderer can move.
        """
        bodies = scene.poses.shape[1]
        if bodies > _BODIES:
            raise RenderError(f"a scene may have {_BODIES} bodies, got {bodies}; split it")
        context, pixels = self._context, (scene.extent.shadow_pixels, scene.extent.shadow_pixels)
        with context:  # the one in use may be another renderer's
            corners, indices = indexed(scene.vertices)
            buffer, index = context.buffer(corners.tobytes()), context.buffer(indices.tobytes())
            drawn = [(run, self._array(buffer, index, run)) for run in runs_of(scene.vertices)]
            casting = context.vertex_array(self._shadow_program, [(buffer, *_FIELDS)], index, skip_errors=True)
            for name in _LIGHTS:
                self._frame[name] = (*getattr(scene.light, name), 0.0)
            for name in _NUMBERS:
                self._frame[name] = getattr(scene.light, name)
            self._frame["shadow_lift"] = _LIFT * scene.extent.shadow_radius_m
            if self._shadow is None or self._shadow.size != pixels:
                self._shadow = context.depth_texture(pixels)
                self._shadow.compare_func = "<="
                self._shadow_target = context.framebuffer(depth_attachment=self._shadow)
        try:
            for step in range(scene.frames):
                with context:
                    self._move(scene, step, casting)
                for name, poses in cameras.items():
                    lens_deg = scene.hfov_deg if hfov_deg is None else hfov_deg[name]
                    with context:
                        view = self._view(poses[step], lens_deg, scene.extent, drawn)
                    yield step, name, view
        finally:
            with context:
                for resource in (*(array for _, array in drawn), casting, buffer, index):
                    resource.release()

    def render(
        self, scene: FrozenScene, cameras: Mapping[str, Doubles], hfov_deg: Mapping[str, float] | None = None
    ) -> dict[str, Rendering]:
        """Every camera's views of all time steps, [T, ...]; see `views`."""
        return stacked(self.views(scene, cameras, hfov_deg))

    def _program(self, vertex: str, fragment: str) -> Any:
        program = self._context.program(vertex_shader=vertex, fragment_shader=fragment)
        program["Frame"].binding = 0
        for name, unit in (("bodies", 0), ("shadow", 1)):
            if name in program:  # the compiler drops what a pattern does not use
                program[name].value = unit
        return program

    def _array(self, buffer: Any, index: Any, run: Run) -> Any:
        """The buffer as the program of a run reads it; programs are made when first needed."""
        key = run.pattern, run.glossy
        if key not in self._programs:
            self._programs[key] = self._program(VERTEX_SHADER, fragment(run.pattern, glossy=run.glossy))
        return self._context.vertex_array(self._programs[key], [(buffer, *_FIELDS)], index, skip_errors=True)

    def _move(self, scene: FrozenScene, step: int, casting: Any) -> None:
        """Put bodies where they are at a time step, and draw the shadow map."""
        rows = np.zeros((_BODIES, 3, 4), np.float32)
        rows[: scene.poses.shape[1]] = scene.poses[step]
        self._bodies.write(rows.tobytes())
        self._bodies.use(0)
        sun_to, focus = np.asarray(scene.light.sun_to), scene.focus[step].astype(np.float64)
        self._frame["light_from_world"] = sunlight_from_world(sun_to, focus, scene.extent).T.ravel()
        self._use_frame()
        self._shadow_target.use()
        self._context.enable_only(self._context.DEPTH_TEST)
        self._shadow_target.clear(depth=1.0)
        casting.render()

    def _use_frame(self) -> None:
        self._frame_block.write(self._frame.tobytes())
        self._frame_block.bind_to_uniform_block(0)

    def _view(
        self, world_from_camera: Doubles, hfov_deg: float, extent: Extent, drawn: Sequence[tuple[Run, Any]]
    ) -> Rendering:
        self._target.use()
        self._context.enable_only(self._context.DEPTH_TEST | self._context.CULL_FACE)
        self._target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
        self._shadow.use(1)
        n, (wide, high) = self._oversample, self._size
        lens = clip_from_camera(hfov_deg, wide / high, extent)
        self._frame["clip_from_world"] = (lens @ np.linalg.inv(world_from_camera)).T.ravel()
        self._frame["eye"][:3] = world_from_camera[:3, 3]
        self._frame["ahead"][:3] = world_from_camera[:3, 2]
        self._use_frame()
        for run, array in drawn:
            array.render(vertices=run.count, first=run.first)
        # four components and whole pixels are copied as they are; any other choice is converted one by one
        colour = np.frombuffer(self._target.read(components=4, attachment=0), np.uint8).reshape(high, wide, 4)
        facts = np.frombuffer(self._target.read(components=2, attachment=1, dtype="f4"), np.uint64)
        picked = facts.reshape(high, wide)[::-1][n // 2 :: n, n // 2 :: n].copy().view(np.float32)
        labels = picked[:, 1::2].astype(np.uint32)  # below 2^24, exact in float32
        rgb = np.asarray(cv2.flip(cv2.cvtColor(colour, cv2.COLOR_RGBA2RGB), 0), np.uint8)
        if n > 1:
            mean = cv2.resize(rgb.astype(np.float32), (wide // n, high // n), interpolation=cv2.INTER_AREA)
            rgb = np.rint(mean).astype(np.uint8)
        return Rendering(
            rgb=rgb,
            depth=np.ascontiguousarray(picked[:, ::2]),
            classes=(labels & 255).astype(np.uint8),
            instances=(labels >> 8 & 255).astype(np.uint8),
            bodies=(labels >> 16).astype(np.uint8),
        )

    def close(self) -> None:
        """Give the OpenGL context back."""
        self._context.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def stacked(views: Iterable[tuple[int, str, Rendering]]) -> dict[str, Rendering]:
    """Each camera's views in their order as one, [T, ...], of what `Renderer.views` gives."""
    each: dict[str, list[Rendering]] = {}
    for _, name, view in views:
        each.setdefault(name, []).append(view)
    names = [field.name for field in fields(Rendering)]
    return {
        camera: Rendering(**{name: np.stack([getattr(view, name) for view in some]) for name in names})
        for camera, some in each.items()
    }


@cache
def require_drawing() -> None:
    """Raises RenderError where nothing can be drawn; once it could, it is not asked again."""
    _context().release()


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
