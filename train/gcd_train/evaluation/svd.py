"""Stable Video Diffusion as published: a video out of the first frame, without camera control."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model import (
    Augmentation,
    Clip,
    RenderOptions,
    SourceFeatures,
    ViewSynthesizer,
    inspect_weights,
    load_synthesizer,
    pose_trajectory,
    weights_path,
)
from gcd_model.diffusion import unit_noise
from gcd_train.data.sample import to_network
from gcd_train.errors import DataError
from gcd_train.evaluation.predictors import Prediction, SourceClip

VANILLA_SVD = "vanilla_svd"
MOTION_BUCKET = 127.0
"""What the network is told of the motion: the middle of its range."""


@dataclass(frozen=True, kw_only=True, slots=True)
class VanillaSVD:
    """A video out of the first frame, for each draw from noise of its own.

    The frame is stretched to the size the network was trained at, and what comes out is stretched back: nothing is
    cropped, so that all of the target is measured.

    synthesizer: without camera control. size: height and width it works at, None for the weights' own (576 x 1024 of
        the published). steps: None as the weights say. samples: draws of each clip. seed: all noise comes from it and
        the clip's key.
    Source: Blattmann et al. 2023 (SVD); Van Hoorick et al. 2024 (GCD), section 5, "Vanilla SVD". Stretching is ours.
    """

    synthesizer: ViewSynthesizer
    size: tuple[int, int] | None = None
    steps: int | None = None
    samples: int = 1
    seed: int = 0
    name: str = VANILLA_SVD
    privileged: bool = False

    @classmethod
    def open(cls, weights: str | Path, *, device: str = "auto", dtype: str | None = None) -> Self:
        """The published file `svd.safetensors`, its diffusers folder, or our own weights of the same task.

        Args: see `gcd_model.load_synthesizer`; a published file is taken to be SVD, whatever it is called.
        Raises:
            CheckpointError: the file is missing, damaged or of another architecture.
            DataError: it is steered: that is another task.
        """
        of_ours = isinstance(weights, str) and weights.startswith(("package:", "random:"))
        family = None if of_ours or inspect_weights(weights).family else "svd"
        return cls(synthesizer=load_synthesizer(weights, family=family, device=device, dtype=dtype))

    def __post_init__(self) -> None:
        traits = self.synthesizer.traits
        if traits.config.camera != "none":
            raise DataError(
                f"{self.name} wants weights that make a video out of a picture, {traits.name} is told a camera path; "
                "give svd.safetensors"
            )

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. No class map. Raises DataError for a clip that is longer than what the network makes."""
        traits, frames = self.synthesizer.traits, len(clip.source)
        if frames > traits.config.frames:
            raise DataError(
                f"{traits.name} makes {traits.config.frames} frames, {clip.key or 'a clip'} has {frames}; evaluate on "
                "shorter clips"
            )
        height, width = clip.cameras.target.height, clip.cameras.target.width
        features = self._features(clip)
        draws = [
            Prediction(video=_stretched(self._draw(features, clip.key, number), height, width)[:frames])
            for number in range(self.samples)
        ]
        return replace(draws[0], more=tuple(draws[1:]))

    def _features(self, clip: SourceClip) -> SourceFeatures:
        """Of the first frame, encoded once, for all frames."""
        config = self.synthesizer.traits.config
        height, width = self.size or (config.height, config.width)
        first = _stretched(to_network(clip.source[:1]), height, width, low=-1.0)
        noise = Augmentation(noise=unit_noise(tuple(first.shape), self._seed(clip.key)))
        told = self.synthesizer.encode(Clip(video=first, fps=clip.fps), noise)
        tokens = None if told.tokens is None else told.tokens.repeat(config.frames, 1)
        return replace(told, tokens=tokens, latents=told.latents.repeat(config.frames, 1, 1, 1))

    def _draw(self, features: SourceFeatures, key: str, number: int) -> Tensor:
        """One video, [T, 3, H, W] in [0, 1]: draws go one by one, as full size leaves no room for two."""
        still = torch.eye(4, dtype=torch.float64).repeat(features.frames, 1, 1)
        seed = self._seed(f"{key}#{number}")
        options = RenderOptions(steps=self.steps, seed=seed, motion_bucket=MOTION_BUCKET)
        (view,) = self.synthesizer.render(features, [pose_trajectory(still)], options)
        return view.video

    def _seed(self, name: str) -> int:
        return int.from_bytes(hashlib.sha256(f"{self.seed}:{name}".encode()).digest()[:6])


def weights_named(weights: str) -> str:
    """What names weights in a record: 12 digits of their digest, or `random:...` as it is. Raises CheckpointError."""
    if weights.startswith("random:"):
        return weights
    return inspect_weights(weights_path(weights)).digest[:12]


def _stretched(pictures: Tensor, height: int, width: int, *, low: float = 0.0) -> Tensor:
    """[T, 3, ...] at another size, within low..1."""
    if pictures.shape[-2:] == (height, width):
        return pictures
    resized = F.interpolate(pictures, size=(height, width), mode="bicubic", align_corners=False, antialias=True)
    return resized.clamp(low, 1.0)
