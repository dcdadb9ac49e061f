"""A model without networks: shows what a function makes of what it was given, and keeps what it was asked."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from gcd_model import Augmentation, Clip, RenderOptions, SourceFeatures, Traits, Trajectory, View
from gcd_model.config import ModelConfig
from gcd_model.weights.card import FAMILIES, FamilyName

Shows = Callable[[SourceFeatures, RenderOptions], Tensor]


def darker(features: SourceFeatures, options: RenderOptions) -> Tensor:
    """The source again, each draw darker than the one before: [S, T, 3, H, W]."""
    return torch.stack([(features.latents + 1) / 2 * (1 - draw / 10) for draw in range(options.samples)])


@dataclass
class FakeModel:
    """See ViewSynthesizer. classes: it says that road is everywhere."""

    traits: Any
    shows: Shows = darker
    classes: bool = False
    clips: list[Clip] = field(default_factory=list)
    noise: list[Augmentation | None] = field(default_factory=list)
    features: list[SourceFeatures] = field(default_factory=list)
    paths: list[Trajectory] = field(default_factory=list)
    options: list[RenderOptions] = field(default_factory=list)

    def encode(self, clip: Clip, augmentation: Augmentation | None = None) -> SourceFeatures:
        self.clips.append(clip)
        self.noise.append(augmentation)
        return SourceFeatures(tokens=None, latents=clip.video, fps=clip.fps, augmentation=0.0)

    def render(
        self, features: SourceFeatures, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        assert options is not None
        self.features.append(features)
        self.paths += trajectories
        self.options.append(options)
        made, scale = self.shows(features, options), getattr(self.traits, "uncertainty_scale", None)
        road = torch.ones(*made.shape[:2], *made.shape[-2:], dtype=torch.uint8) if self.classes else None
        given = {"samples": made, "latents": made, "classes": road, "uncertainty_scale": scale}
        return [View(**given, trajectory=path, motion_bucket=0.0) for path in trajectories]


def traits_of(config: ModelConfig, family: FamilyName, **more: Any) -> Traits:
    """Of a model that is at its goal in the last frame."""
    usual = {"name": "fake", "move_time": config.frames - 1, "sha256_12": "0" * 12, "precision": "float32"}
    return Traits(**{**usual, "device": "cpu", "config": config, "family": FAMILIES[family], **more})
