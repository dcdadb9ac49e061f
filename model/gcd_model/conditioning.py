"""Clip, relative camera, frame rate, motion and noise strength become everything the U-Net takes, once a window."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Self

import torch
import torch.nn.functional as F
from kornia.enhance import normalize
from kornia.geometry.transform import resize
from torch import Tensor, nn

from gcd_model.config import CAMERA_FEATURES, CameraControl, ImageEncoderConfig
from gcd_model.errors import ShapeError
from gcd_model.geometry import CameraMount, Intrinsics, Trajectory
from gcd_model.layers import sinusoid
from gcd_model.live.splat import splat, unproject

CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)


@dataclass(frozen=True, kw_only=True, slots=True)
class SourceFeatures:
    """What the network needs to know of the source; every row belongs to one frame alone.

    So several views, samples and overlapping windows can share it.

    tokens: [T, D] from the image tower, or None without one. latents: [T, C, h, w], not scaled; C is 0 for the live
    model, which has none.
    fps: what the network is told. augmentation: strength of the noise the VAE saw.
    The rest is what the points of the live model, or of a splat, are made of, None for others. video: float32
    [T, 3, H, W] in [-1, 1]. metres: float32 [T, H, W], 0 for a hole. stated: bool [T], whether a frame came with depth.
    odometry: float64 [T, 4, 4], world_from_camera, or None.
    """

    tokens: Tensor | None
    latents: Tensor
    fps: float
    augmentation: float
    mount: CameraMount | None = None
    lens: Intrinsics | None = None
    video: Tensor | None = None
    metres: Tensor | None = None
    stated: Tensor | None = None
    odometry: Tensor | None = None

    @property
    def frames(self) -> int:
        """T."""
        return self.latents.shape[0]

    def _tensors(self) -> dict[str, Tensor]:
        named = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in named.items() if isinstance(value, Tensor)}

    def rows(self, start: int, stop: int) -> Self:
        """The features of frames start..stop-1."""
        return replace(self, **{name: each[start:stop] for name, each in self._tensors().items()})

    def followed_by(self, *later: Self) -> Self:
        """These frames and then the later ones, in the order given. Raises ShapeError unless all were encoded alike."""
        parts = [(each, each._tensors()) for each in (self, *later)]
        if len({(each.fps, each.augmentation, each.mount, each.lens, *tensors) for each, tensors in parts}) > 1:
            raise ShapeError(
                "features of another frame rate, augmentation, mount, lens or model cannot be joined; encode them alike"
            )
        return replace(self, **{name: torch.cat([tensors[name] for _, tensors in parts]) for name in parts[0][1]})


@dataclass(frozen=True, kw_only=True, slots=True)
class Conditioning:
    """One batch of K views, as the U-Net takes it.

    vector: [K*T, V]. camera: [K*T, W] or None: the same for both guidance branches.
    tokens: [R*K*T, D] or None; latents: [R*K*T, C', h, w]; R = 2 with an unconditional branch, which comes first.
    """

    vector: Tensor
    camera: Tensor | None
    tokens: Tensor | None
    latents: Tensor


def micro_conditioning(fps: float, motion_bucket: float, augmentation: float, width: int) -> Tensor:
    """The vector of frame rate, motion and augmentation strength: [width], width/3 numbers each.

    Source: Blattmann et al. 2023 (SVD), micro-conditioning. The frame rate is the clip's own, nothing subtracted.
    """
    return sinusoid(torch.tensor([fps, motion_bucket, augmentation]), width // 3).flatten()


def spherical_features(delta: Tensor) -> Tensor:
    """Camera features from differences of angles and radius, destination minus source.

    Args:
        delta: [T, 3] azimuth and elevation in degrees, radius in metres.
    Returns:
        [T, 13]: cosine and sine of 1, 2 and 4 times the azimuth, the same of the elevation, the radius as it is.
    Source: the released Kubric-4D configuration of GCD.
    """
    angles = torch.deg2rad(delta[:, :2].double())[..., None] * torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)
    fourier = torch.stack([angles.cos(), angles.sin()], dim=-1).flatten(1)  # [T, 12]
    return torch.cat([fourier, delta[:, 2:].double()], dim=1).float()


def relative_pose_features(source_from_target: Tensor) -> Tensor:
    """Camera features from rigid transforms: [T, 4, 4] -> [T, 12], the top three rows, row by row, metres.

    Source: Van Hoorick et al. 2024 (GCD), section 3.2.
    """
    return source_from_target[:, :3, :].flatten(1).float()


def camera_features(control: CameraControl, trajectory: Trajectory) -> Tensor:
    """What a camera path is to the network, float32 [T, F]; F as in `CAMERA_FEATURES`.

    Raises: ShapeError for a network steered by angles and a path that has none.
    """
    if control == "relative_pose":
        return relative_pose_features(trajectory.source_from_target)
    if trajectory.delta is None:
        raise ShapeError("this checkpoint is steered by angles and radius; plan the path with `plan_view`")
    return spherical_features(trajectory.delta)


class CameraEmbedder(nn.Module):
    """One linear map of the camera features; the U-Net's own MLP follows."""

    def __init__(self, control: CameraControl, width: int) -> None:
        super().__init__()
        self.control: CameraControl = control
        self.proj = nn.Linear(CAMERA_FEATURES[control], width)

    def forward(self, trajectory: Trajectory) -> Tensor:
        """The path's camera vectors, [T, W]."""
        return self.proj(camera_features(self.control, trajectory).to(self.proj.weight))


def with_unconditional(rows: Tensor, views: int, unconditional: bool) -> Tensor:
    """Image tokens or latents of a clip for K views: [R*K*T, ...]; the unconditional branch sees zeros, as released."""
    repeated = rows.repeat(views, *[1] * (rows.ndim - 1))
    return torch.cat([torch.zeros_like(repeated), repeated]) if unconditional else repeated


def splatted(video: Tensor, metres: Tensor, lens: Intrinsics, path: Trajectory) -> Tensor:
    """What a camera on the path sees of the source's pixels, each put where its depth says, frame by frame.

    Args:
        video: [T, 3, H, W] in [-1, 1]. metres: [T, H, W] along the axis; 0, negative or not finite: no point.
        lens: of the source, and of the view.
    Returns:
        float32 [T, 4, H, W]: colour in [-1, 1], before black, and the share of a pixel that points cover, 0 to 1.
    Source: a depth warp as a condition of video diffusion, Ren et al. 2025 (GEN3C), Yu et al. 2025 (TrajectoryCrafter).
    """
    here, labels = torch.eye(4, dtype=torch.float64), torch.zeros_like(metres[0], dtype=torch.uint8)
    frames = zip(video, metres, path.source_from_target, strict=True)
    seen = [
        splat(unproject(depth, picture, labels, lens, here, 0.0), pose, lens, 1, 0.0) for picture, depth, pose in frames
    ]
    return torch.stack([torch.cat([s.coverage * (s.colour + 1) - 1, s.coverage[None]]) for s in seen])


def splat_channels(splats: Tensor, encode: Callable[[Tensor], Tensor]) -> Tensor:
    """A splat as the U-Net takes it, [T, C + 1, h, w]: latents of its colour as of the source, and the mean coverage.

    splats: see `splatted`. encode: pictures [T, 3, H, W] to unscaled condition latents [T, C, h, w].
    """
    latents = encode(splats[:, :3])
    coverage = F.interpolate(splats[:, 3:].to(latents), size=latents.shape[-2:], mode="area")
    return torch.cat([latents, coverage], dim=1)


# --- the CLIP image tower: one token per frame that says what is in it -----------------------------------------------


def clip_pixels(frames: Tensor, size: int) -> Tensor:
    """Frames as the image tower expects them: [N, 3, H, W] in [-1, 1] -> [N, 3, size, size], normalised.

    The picture is squeezed to a square, not cropped. Bicubic with corners aligned, after kornia's Gaussian
    antialiasing, before the range changes: torch's own antialiasing is another filter.
    Source: the conditioner of Stable Video Diffusion; mean and deviation of CLIP (Radford et al. 2021).
    """
    squeezed = resize(frames, (size, size), interpolation="bicubic", align_corners=True, antialias=True)
    return normalize((squeezed + 1) / 2, frames.new_tensor(CLIP_MEAN), frames.new_tensor(CLIP_STD))


class ImageTransformerLayer(nn.Module):
    """Pre-norm self-attention and feed-forward; query, key and value come from one matrix, as published."""

    def __init__(self, config: ImageEncoderConfig) -> None:
        super().__init__()
        self.heads = config.heads
        self.norm_attention = nn.LayerNorm(config.width)
        self.query_key_value = nn.Linear(config.width, 3 * config.width)
        self.out = nn.Linear(config.width, config.width)
        self.norm_feed = nn.LayerNorm(config.width)
        self.expand = nn.Linear(config.width, config.hidden_width)
        self.contract = nn.Linear(config.hidden_width, config.width)

    def forward(self, x: Tensor) -> Tensor:
        """x: [N, L, C] -> the same shape."""
        joint = self.query_key_value(self.norm_attention(x)).unflatten(-1, (3, self.heads, -1))
        query, key, value = joint.permute(2, 0, 3, 1, 4)  # [N, heads, L, C/heads] each
        mixed = F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)
        x = x + self.out(mixed)
        return x + self.contract(F.gelu(self.expand(self.norm_feed(x))))


class ImageEncoder(nn.Module):
    """Vision transformer; gives the projected class token, not normalised to unit length.

    Source: Radford et al. 2021; ViT-H/14 of OpenCLIP in the published configuration.
    """

    def __init__(self, config: ImageEncoderConfig) -> None:
        super().__init__()
        self.config = config
        self.patches = nn.Conv2d(3, config.width, config.patch, stride=config.patch, bias=False)
        self.class_token = nn.Parameter(torch.randn(config.width) * config.width**-0.5)
        self.positions = nn.Parameter(torch.randn(config.tokens, config.width) * config.width**-0.5)
        self.norm_in = nn.LayerNorm(config.width)
        self.layers = nn.Sequential(*(ImageTransformerLayer(config) for _ in range(config.layers)))
        self.norm_out = nn.LayerNorm(config.width)
        self.projection = nn.Parameter(torch.randn(config.width, config.output_width) * config.width**-0.5)

    def forward(self, pixels: Tensor) -> Tensor:
        """pixels: [N, 3, size, size] from `clip_pixels` -> [N, D]."""
        patches = self.patches(pixels).flatten(2).transpose(1, 2)  # [N, L-1, C]
        tokens = torch.cat([self.class_token.expand(patches.shape[0], 1, -1), patches], dim=1) + self.positions
        tokens = self.layers(self.norm_in(tokens))
        return self.norm_out(tokens[:, 0]) @ self.projection
