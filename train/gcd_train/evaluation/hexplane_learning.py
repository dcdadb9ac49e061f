"""HexPlane as a baseline: learnt from one clip's own videos, drawn from the target's cameras."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.geometry import Intrinsics
from gcd_train.data.sample import SceneView
from gcd_train.errors import DataError
from gcd_train.evaluation.hexplane import HexField, HexPlaneSettings, Rays, SceneBounds, render
from gcd_train.evaluation.predictors import Prediction, SourceClip, to_pictures

_RAYS_AT_ONCE = 4096
"""Rays drawn together without gradients: 4096 rays of 48 samples with 48 features are 38 MB."""
_DEFAULT = HexPlaneSettings()


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

    def narrowed(self, width: int) -> "Camera":
        """The camera of the same picture at most this wide."""
        if self.lens.width <= width:
            return self
        height = max(1, round(self.lens.height * width / self.lens.width))
        return replace(self, lens=self.lens.resized(width, height))


@dataclass(frozen=True, kw_only=True, slots=True)
class PosedPicture:
    """One picture. colours: float32 [3, H, W], RGB in [0, 1]; the camera's lens is in its pixels."""

    colours: Tensor
    camera: Camera

    def narrowed(self, width: int) -> "PosedPicture":
        """The same at most this wide, by averages over pixels, so that learning costs less."""
        camera = self.camera.narrowed(width)
        if camera is self.camera:
            return self
        size = (camera.lens.height, camera.lens.width)
        return PosedPicture(colours=F.interpolate(self.colours[None], size=size, mode="area")[0], camera=camera)


def learn(
    pictures: Sequence[PosedPicture],
    bounds: SceneBounds,
    settings: HexPlaneSettings,
    *,
    frames: int,
    seed: int = 0,
    device: str = "auto",
) -> HexField:
    """The field that shows the pictures again.

    Args:
        pictures: of one scene, with their cameras. frames: T of the clip. seed: of weights, rays and samples.
        device: "auto" (CUDA where there is one), or as torch names it; the field stays there.
    Returns:
        On the CPU the same field for the same pictures, settings, seed and number of threads.
    """
    auto = "cuda" if torch.cuda.is_available() else "cpu"
    place, generator = torch.device(auto if device == "auto" else device), torch.Generator().manual_seed(seed)
    narrow = [picture.narrowed(settings.picture_width) for picture in pictures]
    rays = Rays.together([picture.camera.rays() for picture in narrow]).to(place)
    colours = torch.cat([picture.colours.flatten(1).T for picture in narrow]).to(place)
    field = HexField(bounds, frames, settings, generator).to(place)
    heads = [weight for name, weight in field.named_parameters() if not name.startswith("planes.")]
    done = 0
    for stage, side in enumerate(settings.sides, start=1):
        field.planes.refine(side)
        rates = (settings.plane_rate, settings.head_rate)
        groups = [{"params": list(field.planes.parameters())}, {"params": heads}]
        optimiser = torch.optim.Adam(groups, betas=(0.9, 0.99))
        end = settings.updates * stage // len(settings.sides)
        for number in range(done, end):
            for group, rate in zip(optimiser.param_groups, rates, strict=True):
                group["lr"] = rate * 0.1 ** (number / settings.updates)  # to a tenth at the end
            chosen = torch.randint(len(colours), (settings.rays,), generator=generator).to(place)
            shown = render(field, rays[chosen], coarse=settings.coarse, fine=settings.fine, generator=generator)
            error = F.mse_loss(shown, colours[chosen])
            optimiser.zero_grad(set_to_none=True)
            (error + settings.smoothness * field.planes.roughness()).backward()
            optimiser.step()
        done = end
    return field.eval()


@torch.no_grad()
def draw(field: HexField, camera: Camera, settings: HexPlaneSettings) -> Tensor:
    """The picture of a camera, float32 [3, H, W] on the CPU, in [0, 1], in the size of its lens."""
    narrow = camera.narrowed(settings.picture_width)
    rays, rows = narrow.rays(), list[Tensor]()
    for start in range(0, len(rays.times), _RAYS_AT_ONCE):
        some = rays[slice(start, start + _RAYS_AT_ONCE)].to(field.planes.space.device)
        rows.append(render(field, some, coarse=settings.coarse, fine=settings.fine).cpu())
    picture = torch.cat(rows).T.reshape(3, narrow.lens.height, narrow.lens.width)
    if narrow is camera:
        return picture
    size = (camera.lens.height, camera.lens.width)
    return F.interpolate(picture[None], size=size, mode="bicubic", align_corners=False)[0].clamp(0.0, 1.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class HexPlane:
    """HexPlane with so many input views: the source clip, and further cameras of the scene from two on.

    views: K. settings: what is learnt of each clip, and how long. seed, device: of the learning, see `learn`.
    With two views or more it is given more than the others, so `privileged`. It makes no class maps.
    Source: Cao and Johnson 2023 (HexPlane); as a baseline, Van Hoorick et al. 2024 (GCD), section 5.
    """

    views: int = 1
    settings: HexPlaneSettings = _DEFAULT
    seed: int = 0
    device: str = "auto"

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
        times = [2.0 * number / max(frames - 1, 1) - 1.0 for number in range(frames)]
        pictures = [
            _posed(colours, cameras.source, cameras.ground_from_source, time)
            for colours, time in zip(to_pictures(clip.source), times, strict=True)
        ]
        for video in self._others(clip):
            pictures += [
                _posed(to_pictures(view.rgb[None])[0], view.lens, torch.from_numpy(view.world_from_camera), time)
                for view, time in zip(video, times, strict=True)
            ]
        world_from_target = cameras.ground_from_source @ cameras.source_from_target  # [T, 4, 4]
        known = torch.stack([picture.camera.world_from_camera for picture in pictures])
        bounds = SceneBounds.around(torch.cat([known, world_from_target]))
        field = learn(pictures, bounds, self.settings, frames=frames, seed=self.seed, device=self.device)
        drawn = [
            draw(field, Camera(lens=cameras.target, world_from_camera=pose, time=time), self.settings)
            for pose, time in zip(world_from_target, times, strict=True)
        ]
        return Prediction(video=torch.stack(drawn))

    def _others(self, clip: SourceClip) -> Sequence[Sequence[SceneView]]:
        """Videos of the further cameras, in the world that the source's pose is in."""
        if self.views == 1:
            return ()
        if clip.others is None:
            raise DataError(
                f"{self.name} wants {self.views} cameras of a scene, but clip {clip.key or 'without a key'} has one; "
                "give a 4D data set, or ask for hexplane_1"
            )
        return clip.others(self.views - 1)


def _posed(colours: Tensor, lens: Intrinsics, world_from_camera: Tensor, time: float) -> PosedPicture:
    return PosedPicture(colours=colours, camera=Camera(lens=lens, world_from_camera=world_from_camera, time=time))
