"""Clip, relative camera, frame rate, motion and noise strength become everything the U-Net takes, once a window."""

from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor, nn

from gcd_model.config import CAMERA_FEATURES, CameraControl
from gcd_model.errors import ShapeError
from gcd_model.geometry import CameraMount, Trajectory
from gcd_model.layers import sinusoid


@dataclass(frozen=True, kw_only=True, slots=True)
class SourceFeatures:
    """What the network needs to know of the source; every row belongs to one frame alone.

    So several views, samples and overlapping windows can share it.

    tokens: [T, D] from the image tower, or None without one. latents: [T, C, h, w], not scaled.
    extra: [T, C', h, w], further condition channels, or None. fps: what the network is told.
    augmentation: strength of the noise the VAE saw.
    video: float32 [T, 3, H, W] in [-1, 1] and mount: what plane warps are made of; None for models without.
    """

    tokens: Tensor | None
    latents: Tensor
    extra: Tensor | None
    fps: float
    augmentation: float
    video: Tensor | None = None
    mount: CameraMount | None = None

    @property
    def frames(self) -> int:
        """T."""
        return self.latents.shape[0]

    def _kind(self) -> tuple[float, float, bool, bool, bool, CameraMount | None]:
        absent = (self.tokens is None, self.extra is None, self.video is None)
        return self.fps, self.augmentation, *absent, self.mount

    def rows(self, start: int, stop: int) -> Self:
        """The features of frames start..stop-1."""
        return replace(
            self,
            tokens=None if self.tokens is None else self.tokens[start:stop],
            latents=self.latents[start:stop],
            extra=None if self.extra is None else self.extra[start:stop],
            video=None if self.video is None else self.video[start:stop],
        )

    def followed_by(self, *later: Self) -> Self:
        """These frames and then the later ones, in the order given. Raises ShapeError unless all were encoded alike."""
        if any(self._kind() != each._kind() for each in later):
            raise ShapeError(
                "features of another frame rate, augmentation, mount or model cannot be joined; encode them alike"
            )
        return replace(
            self,
            tokens=_joined([self.tokens, *(each.tokens for each in later)]),
            latents=torch.cat([self.latents, *(each.latents for each in later)]),
            extra=_joined([self.extra, *(each.extra for each in later)]),
            video=_joined([self.video, *(each.video for each in later)]),
        )


def _joined(parts: list[Tensor | None]) -> Tensor | None:
    there = [part for part in parts if part is not None]
    return torch.cat(there) if there else None


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
    branches: int


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


def condition_latents(
    features: SourceFeatures, views: int, warped: Tensor | None = None, *, unconditional: bool
) -> Tensor:
    """Condition channels of K views, [R*K*T, C', h, w]; the unconditional branch sees zeros, as released.

    warped: [K*T, C'', h, w], channels that differ between the views, or None.
    """
    rows = features.latents if features.extra is None else torch.cat([features.latents, features.extra], dim=1)
    if warped is None:
        return _with_unconditional(rows, views, unconditional)
    return _with_unconditional(torch.cat([rows.repeat(views, 1, 1, 1), warped.to(rows)], dim=1), 1, unconditional)


def condition_tokens(features: SourceFeatures, views: int, *, unconditional: bool) -> Tensor | None:
    """Image tokens of K views, [R*K*T, D]; the unconditional branch sees zeros, as released."""
    return None if features.tokens is None else _with_unconditional(features.tokens, views, unconditional)


def _with_unconditional(rows: Tensor, views: int, unconditional: bool) -> Tensor:
    repeated = rows.repeat(views, *[1] * (rows.ndim - 1))
    return torch.cat([torch.zeros_like(repeated), repeated]) if unconditional else repeated
