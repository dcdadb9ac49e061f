"""What is learnt anew for each clip: the views of its scene that a method is given, and the space that they show."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import ClassVar, TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.geometry import Intrinsics
from gcd_train.evaluation.predictors import Prediction, SourceClip, require_one_lens, to_pictures

_INNER = 0.5  # half a side of the box drawn to scale, as a share of the farthest camera's distance from its middle
# Where rays begin, as a share of the nearest camera's distance from the middle: pictures painted on the air in front of
# each camera explain all inputs and no other view.
_BEGIN = 0.3
# Where rays end, in halves of the cube beyond the middle as the farthest camera sees it: what lies farther off is seen
# by one camera only, and each would paint its whole picture there.
_END = 0.5
_NEAR_M = 0.4  # to the middle, for cameras that turn in place: their axes meet in themselves
_PULL, _GUESS_M = 1e-3, 10.0  # for cameras with parallel axes: weight of a guess, and how far ahead it lies


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneBounds:
    """A cube that is drawn to scale; all of space around it is squeezed into a shell of its own thickness.

    centre: float32 [3], world, metres. half_m: half a side of the cube. begin, reach: distances along a ray, in halves,
    between which there is something to see; beyond there is a background.
    """

    centre: Tensor
    half_m: float
    begin: float
    reach: float

    @classmethod
    def around(cls, world_from_camera: Tensor) -> "SceneBounds":
        """The cube about the point with the least summed squared distance to the cameras' optical axes.

        Where all axes are parallel, that is the point on them 10 m ahead.

        Args:
            world_from_camera: float [M, 4, 4], input and wanted cameras, metres.
        """
        poses = world_from_camera.double()
        position, ahead = poses[:, :3, 3], poses[:, :3, 2]
        across = torch.eye(3, dtype=torch.float64) - ahead[:, :, None] * ahead[:, None, :]  # [M, 3, 3]
        guess = (position + _GUESS_M * ahead).mean(dim=0)
        left = across.sum(dim=0) + _PULL * torch.eye(3, dtype=torch.float64)
        centre = torch.linalg.solve(left, torch.einsum("mij,mj->i", across, position) + _PULL * guess)
        distances = (position - centre).norm(dim=-1).clamp(min=_NEAR_M)
        half_m = float(distances.max()) * _INNER
        nearest, farthest = (float(distance) / half_m for distance in (distances.min(), distances.max()))
        return cls(centre=centre.float(), half_m=half_m, begin=nearest * _BEGIN, reach=farthest + _END)

    def to_planes(self, points: Tensor) -> Tensor:
        """World points [..., 3], metres, in the planes' coordinates, within [-1, 1].

            x within the cube, (2 - 1 / |x|) x / |x| outside, |x| the largest coordinate; then halved

        Source: Barron et al. 2022 (Mip-NeRF 360), equation 10, with the largest norm so that the result fills a cube.
        """
        scaled = (points - self.centre.to(points.device)) / self.half_m
        size = scaled.abs().amax(dim=-1, keepdim=True).clamp(min=1.0)
        return scaled * (2.0 - 1.0 / size) / size / 2.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Camera:
    """Where and when a picture is taken.

    world_from_camera: float [4, 4], metres. time: -1 for the first frame of the clip, 1 for the last.
    """

    lens: Intrinsics
    world_from_camera: Tensor
    time: float

    def rays(self) -> Tensor:
        """Through the middle of every pixel, row by row: float32 [H * W, 7].

        Origin and direction of length 1 in the world, metres; time.
        """
        u = (torch.arange(self.lens.width) + 0.5 - self.lens.cx) / self.lens.fx
        v = (torch.arange(self.lens.height) + 0.5 - self.lens.cy) / self.lens.fy
        down, right = torch.meshgrid(v, u, indexing="ij")
        ahead = F.normalize(torch.stack([right, down, torch.ones_like(right)], dim=-1).view(-1, 3), dim=-1)
        pose = self.world_from_camera.float()
        time = ahead.new_full((len(ahead), 1), self.time)
        return torch.cat([pose[:3, 3].expand(len(ahead), 3), ahead @ pose[:3, :3].T, time], dim=1)

    def narrowed(self, width: int) -> "Camera":
        """The camera of the same picture at most this wide."""
        if self.lens.width <= width:
            return self
        height = max(1, round(self.lens.height * width / self.lens.width))
        return replace(self, lens=self.lens.resized(width, height))


def linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """A layer whose first weights depend on the generator alone."""
    layer = nn.Linear(inputs, outputs)
    with torch.no_grad():
        nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
        layer.bias.zero_()
    return layer


def head(inputs: int, width: int, outputs: int, generator: torch.Generator) -> nn.Sequential:
    """Two layers, as `linear` makes them."""
    return nn.Sequential(linear(inputs, width, generator), nn.ReLU(), linear(width, outputs, generator))


_HARMONICS = 9
_HEIGHT_WAVES = (2.0, 4.0, 8.0, 16.0)  # over the vertical part of a direction, radians, for a sharp horizon all around
_BACKGROUND_WIDTH = 32


class Background(nn.Module):
    """What lies behind everything: it stands still, and is smooth but for its horizon.

    generator: of the first weights, on the CPU.
    """

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__()
        self.head = head(_HARMONICS + 2 * len(_HEIGHT_WAVES), _BACKGROUND_WIDTH, 3, generator)

    def forward(self, directions: Tensor) -> Tensor:
        """RGB in [0, 1] by the direction [P, 3] of length 1, z up in the world -> [P, 3]."""
        x, y, z = directions.unbind(dim=-1)
        harmonics = [torch.ones_like(x), x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1]
        heights = [wave(rate * z) for rate in _HEIGHT_WAVES for wave in (torch.sin, torch.cos)]
        return self.head(torch.stack([*harmonics, *heights], dim=-1)).sigmoid()


Shown: TypeAlias = tuple[Tensor, Camera]
"""A picture, float32 [3, H, W] in [0, 1], and its camera."""
Drawing: TypeAlias = Callable[[Camera], Tensor]
"""Gives the picture of a camera, float32 [3, H, W] in [0, 1]."""


def narrowed(picture: Tensor, camera: Camera, width: int) -> Shown:
    """The picture at most this wide."""
    narrow = camera.narrowed(width)
    return F.interpolate(picture[None], size=(narrow.lens.height, narrow.lens.width), mode="area")[0], narrow


@dataclass(frozen=True, kw_only=True)
class PerScene(ABC):
    """A method that learns the scene of each clip from K views: the source, and further cameras from two on.

    views: K. seed: of all that is drawn at random. device: "auto" is CUDA where there is one. picture_width: pictures
    are made this narrow, in pixels, before learning and drawing; views are scaled back up.
    With two views or more it is given more than the others, so `privileged`. It makes no class maps.
    """

    stem: ClassVar[str]
    views: int = 1
    seed: int = 0
    device: str = "auto"
    picture_width: int = 192

    @property
    def name(self) -> str:
        return f"{self.stem}_{self.views}"

    @property
    def privileged(self) -> bool:
        return self.views > 1

    @property
    def details(self) -> dict[str, str]:
        """See Predictor: every field of the method."""
        fields = {key: str(value) for key, value in asdict(self).items() if key not in ("views", "device")}
        return {"baseline": self.name, **fields}

    @property
    def place(self) -> torch.device:
        """Where the scene is learnt."""
        auto = "cuda" if torch.cuda.is_available() else "cpu"
        return torch.device(auto if self.device == "auto" else self.device)

    @abstractmethod
    def learn(self, pictures: Sequence[Shown], bounds: SceneBounds, frames: int) -> Drawing:
        """The scene that shows the pictures again; frames: T of the clip.

        On the CPU it is the same for the same pictures, settings, seed and number of threads.
        """

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. Raises DataError where the clip's scene has fewer cameras, or a lens changes."""
        own, frames = clip.cameras, len(clip.source)
        require_one_lens(clip, self.name)
        times = [2.0 * number / max(frames - 1, 1) - 1.0 for number in range(frames)]
        pictures = [
            (colours, Camera(lens=own.source, world_from_camera=pose, time=time))
            for colours, pose, time in zip(
                to_pictures(clip.source), own.ground_from_source.expand(frames, 4, 4), times, strict=True
            )
        ]
        for video in clip.others(self.views - 1) if clip.others is not None and self.views > 1 else ():
            for view, time in zip(video, times, strict=True):
                camera = Camera(lens=view.lens, world_from_camera=torch.from_numpy(view.world_from_camera), time=time)
                pictures.append((to_pictures(view.rgb[None])[0], camera))
        wanted = own.ground_from_source @ own.source_from_target  # [T, 4, 4]
        bounds = SceneBounds.around(torch.stack([*(camera.world_from_camera for _, camera in pictures), *wanted]))
        drawing = self.learn([narrowed(*each, self.picture_width) for each in pictures], bounds, frames)
        cameras = [
            Camera(lens=own.target, world_from_camera=pose, time=time).narrowed(self.picture_width)
            for pose, time in zip(wanted, times, strict=True)
        ]
        with torch.no_grad():
            video, size = torch.stack([drawing(each).cpu() for each in cameras]), (own.target.height, own.target.width)
        if video.shape[2:] != size:
            video = F.interpolate(video, size=size, mode="bicubic", align_corners=False).clamp(0.0, 1.0)
        return Prediction(video=video)
