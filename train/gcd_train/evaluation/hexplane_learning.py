"""HexPlane as a baseline: learnt from one clip's own videos, drawn from the target's cameras."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.geometry import Intrinsics
from gcd_train.errors import DataError
from gcd_train.evaluation.hexplane import HexField, HexPlaneSettings, Rays, SceneBounds, render
from gcd_train.evaluation.predictors import Prediction, SourceClip, to_pictures
from gcd_train.scene_view import SceneView


@dataclass(frozen=True, kw_only=True, slots=True)
class Camera:
    """Where and when a picture is taken.

    world_from_camera: float [4, 4], metres. time: -1 for the first frame of the clip, 1 for the last.
    """

    lens: Intrinsics
    world_from_camera: Tensor
    time: float

    def rays(self) -> Rays:
        """Through the middle of every pixel, row by row, float32."""
        u = (torch.arange(self.lens.width) + 0.5 - self.lens.cx) / self.lens.fx
        v = (torch.arange(self.lens.height) + 0.5 - self.lens.cy) / self.lens.fy
        down, right = torch.meshgrid(v, u, indexing="ij")
        ahead = F.normalize(torch.stack([right, down, torch.ones_like(right)], dim=-1).view(-1, 3), dim=-1)
        pose = self.world_from_camera.float()
        return Rays(
            origins=pose[:3, 3].expand(len(ahead), 3),
            directions=ahead @ pose[:3, :3].T,
            times=ahead.new_full((len(ahead),), self.time),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class PosedPicture:
    """One picture. colours: float32 [3, H, W], RGB in [0, 1]; the camera's lens is in its pixels."""

    colours: Tensor
    camera: Camera

    def narrowed(self, width: int) -> "PosedPicture":
        """The same at most this wide, by averages over pixels, so that learning costs less."""
        lens = narrowed(self.camera.lens, width)
        if lens == self.camera.lens:
            return self
        colours = F.interpolate(self.colours[None], size=(lens.height, lens.width), mode="area")[0]
        camera = Camera(lens=lens, world_from_camera=self.camera.world_from_camera, time=self.camera.time)
        return PosedPicture(colours=colours, camera=camera)


def narrowed(lens: Intrinsics, width: int) -> Intrinsics:
    """The lens of the same picture at most this wide."""
    if lens.width <= width:
        return lens
    return lens.resized(width, max(1, round(lens.height * width / lens.width)))


@dataclass(frozen=True, kw_only=True, slots=True)
class RayTable:
    """All pixels of some pictures. rays: N of them. colours: [N, 3], what they should show."""

    rays: Rays
    colours: Tensor

    @classmethod
    def of(cls, pictures: Sequence[PosedPicture], device: torch.device) -> "RayTable":
        """Every pixel of every picture, of any sizes."""
        rays = [picture.camera.rays() for picture in pictures]
        return cls(
            rays=Rays(
                origins=torch.cat([each.origins for each in rays]),
                directions=torch.cat([each.directions for each in rays]),
                times=torch.cat([each.times for each in rays]),
            ).to(device),
            colours=torch.cat([picture.colours.flatten(1).T for picture in pictures]).to(device),
        )

    def drawn(self, count: int, generator: torch.Generator) -> "RayTable":
        """So many pixels, any of them equally likely, and more than once if it happens."""
        chosen = torch.randint(len(self.colours), (count,), generator=generator).to(self.colours.device)
        return RayTable(rays=taken(self.rays, chosen), colours=self.colours[chosen])


def taken(rays: Rays, chosen: Tensor | slice) -> Rays:
    """Some of the rays."""
    return Rays(origins=rays.origins[chosen], directions=rays.directions[chosen], times=rays.times[chosen])


_RAYS_AT_ONCE = 4096
"""Rays drawn together without gradients: 4096 rays of 48 samples with 48 features are 38 MB."""


def learn(
    pictures: Sequence[PosedPicture],
    bounds: SceneBounds,
    settings: HexPlaneSettings,
    *,
    frames: int,
    seed: int = 0,
    device: str = "auto",
    progress: Callable[[int, float], None] | None = None,
) -> HexField:
    """The field that shows the pictures again.

    Args:
        pictures: of one scene, with their cameras. frames: T of the clip. seed: of weights, rays and samples.
        device: "auto" (CUDA where there is one), or as torch names it; the field stays there.
        progress: called after each update with its number and the mean squared error of its rays.
    Returns:
        On the CPU the same field for the same pictures, settings, seed and number of threads.
    Raises:
        DataError: there is no picture.
    """
    if not pictures:
        raise DataError("HexPlane learns from pictures, got none; give at least the source clip")
    place, generator = _device(device), torch.Generator().manual_seed(seed)
    table = RayTable.of([picture.narrowed(settings.picture_width) for picture in pictures], place)
    field = HexField(bounds, frames, settings, generator).to(place)
    done = 0
    for stage, side in enumerate(settings.sides, start=1):
        field.planes.refine(side)
        optimiser = _optimiser(field, settings)
        end = settings.updates * stage // len(settings.sides)
        for number in range(done, end):
            _set_rates(optimiser, settings, number)
            error = _update(field, optimiser, table.drawn(settings.rays, generator), settings, generator)
            if progress is not None:
                progress(number, error)
        done = end
    return field.eval()


@torch.no_grad()
def draw(field: HexField, camera: Camera, settings: HexPlaneSettings) -> Tensor:
    """The picture of a camera, float32 [3, H, W] on the CPU, in [0, 1], in the size of its lens."""
    lens = narrowed(camera.lens, settings.picture_width)
    rays = Camera(lens=lens, world_from_camera=camera.world_from_camera, time=camera.time).rays()
    rows: list[Tensor] = []
    for start in range(0, lens.width * lens.height, _RAYS_AT_ONCE):
        some = taken(rays, slice(start, start + _RAYS_AT_ONCE)).to(field.planes.space.device)
        rows.append(render(field, some, coarse=settings.coarse, fine=settings.fine).cpu())
    picture = torch.cat(rows).T.reshape(3, lens.height, lens.width)
    size = (camera.lens.height, camera.lens.width)
    if picture.shape[1:] == size:
        return picture
    return F.interpolate(picture[None], size=size, mode="bicubic", align_corners=False)[0].clamp(0.0, 1.0)


def _device(name: str) -> torch.device:
    if name != "auto":
        return torch.device(name)
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def _update(
    field: HexField,
    optimiser: torch.optim.Optimizer,
    batch: RayTable,
    settings: HexPlaneSettings,
    generator: torch.Generator,
) -> float:
    shown = render(field, batch.rays, coarse=settings.coarse, fine=settings.fine, generator=generator)
    error = F.mse_loss(shown, batch.colours)
    optimiser.zero_grad(set_to_none=True)
    (error + settings.smoothness * field.planes.roughness()).backward()
    optimiser.step()
    return float(error.detach())


def _optimiser(field: HexField, settings: HexPlaneSettings) -> torch.optim.Adam:
    planes = list(field.planes.parameters())
    heads = [weight for name, weight in field.named_parameters() if not name.startswith("planes.")]
    return torch.optim.Adam(
        [{"params": planes, "lr": settings.plane_rate}, {"params": heads, "lr": settings.head_rate}],
        betas=(0.9, 0.99),
    )


def _set_rates(optimiser: torch.optim.Optimizer, settings: HexPlaneSettings, number: int) -> None:
    """Both rates fall evenly on a logarithmic scale, to a tenth at the end."""
    share = 0.1 ** (number / settings.updates)
    for group, rate in zip(optimiser.param_groups, (settings.plane_rate, settings.head_rate), strict=True):
        group["lr"] = rate * share


DEFAULT = HexPlaneSettings()
"""What is learnt of a clip where nobody says otherwise."""


@dataclass(frozen=True, kw_only=True, slots=True)
class HexPlane:
    """HexPlane with so many input views: the source clip, and further cameras of the scene from two on.

    views: K. settings: what is learnt of each clip, and how long. seed, device: of the learning, see `learn`.
    With two views or more it is told more than the others, so `privileged`. It makes no class maps.
    Source: Cao and Johnson 2023 (HexPlane); as a baseline, Van Hoorick et al. 2024 (GCD), section 5.
    """

    views: int = 1
    settings: HexPlaneSettings = DEFAULT
    seed: int = 0
    device: str = "auto"

    def __post_init__(self) -> None:
        if self.views < 1:
            raise DataError(f"HexPlane learns from 1 view or more, got {self.views}")

    @property
    def name(self) -> str:
        """`hexplane_K`."""
        return f"hexplane_{self.views}"

    @property
    def privileged(self) -> bool:
        """True from two views on."""
        return self.views > 1

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. Raises DataError where the clip's scene has fewer cameras."""
        cameras, frames = clip.cameras, len(clip.source)
        world_from_target = cameras.ground_from_source @ cameras.source_from_target  # [T, 4, 4]
        pictures = [*_of_source(clip), *self._of_others(clip)]
        known = torch.stack([picture.camera.world_from_camera for picture in pictures])
        bounds = SceneBounds.around(torch.cat([known, world_from_target]))
        field = learn(pictures, bounds, self.settings, frames=frames, seed=self.seed, device=self.device)
        wanted = [
            Camera(lens=cameras.target, world_from_camera=pose, time=_time(number, frames))
            for number, pose in enumerate(world_from_target)
        ]
        return Prediction(video=torch.stack([draw(field, camera, self.settings) for camera in wanted]))

    def _of_others(self, clip: SourceClip) -> list[PosedPicture]:
        """Pictures of the further cameras; their world is the one the source's pose is told in."""
        if self.views == 1:
            return []
        if clip.others is None:
            raise DataError(
                f"{self.name} wants {self.views} cameras of a scene, but clip {clip.key or 'without a key'} has one; "
                "give a 4D data set, or ask for hexplane_1"
            )
        frames = len(clip.source)
        return [
            _of_view(view, _time(number, frames))
            for video in clip.others(self.views - 1)
            for number, view in enumerate(_whole(video, frames))
        ]


def _whole(video: Sequence[SceneView], frames: int) -> Sequence[SceneView]:
    if len(video) != frames:
        raise DataError(f"each camera of a scene must show {frames} frames as the source does, got {len(video)}")
    return video


def _of_source(clip: SourceClip) -> list[PosedPicture]:
    frames = len(clip.source)
    return [_posed(colours, clip, _time(number, frames)) for number, colours in enumerate(to_pictures(clip.source))]


def _posed(colours: Tensor, clip: SourceClip, time: float) -> PosedPicture:
    camera = Camera(lens=clip.cameras.source, world_from_camera=clip.cameras.ground_from_source, time=time)
    return PosedPicture(colours=colours, camera=camera)


def _of_view(view: SceneView, time: float) -> PosedPicture:
    camera = Camera(lens=view.lens, world_from_camera=torch.from_numpy(view.world_from_camera), time=time)
    return PosedPicture(colours=to_pictures(view.rgb[None])[0], camera=camera)


def _time(number: int, frames: int) -> float:
    """-1 for the first frame, 1 for the last."""
    return 2.0 * number / max(frames - 1, 1) - 1.0
