"""The 25-step guided sampler against a float64 reference written from the formulas alone."""

import math
from dataclasses import dataclass
from itertools import pairwise

import msgspec
import torch
from plain_unet import plain_unet
from published import released_unet
from small_models import TINY, draw, random_clip, relative_error, tiny_synthesizer
from torch import Tensor

from gcd_model.conditioning import SourceFeatures
from gcd_model.config import SamplingConfig
from gcd_model.diffusion import RenderOptions
from gcd_model.geometry import SphericalDelta

FRAMES, STEPS = 14, 25
CONFIG = msgspec.structs.replace(
    TINY,
    frames=FRAMES,
    height=16,
    width=32,
    unet=msgspec.structs.replace(TINY.unet, width=32, norm_groups=32),
    sampling=SamplingConfig(),
)
DELTA = (30.0, 10.0, 1.5)  # azimuth and elevation in degrees, radius in metres, destination minus source


@dataclass(frozen=True, kw_only=True, slots=True)
class Reference:
    """Everything the formulas need, in float64."""

    weights: dict[str, Tensor]
    camera_weight: Tensor
    camera_bias: Tensor
    features: SourceFeatures
    noise: Tensor

    def sample(self) -> Tensor:
        """x0 of 25 Euler steps: [T, C, h, w]."""
        x = self.noise.double() * math.sqrt(1 + 700.0**2)
        sigmas = self._sigmas()
        scale = torch.tensor([1.0 + 0.5 * t / (FRAMES - 1) for t in range(FRAMES)], dtype=torch.float64)
        for sigma, following in pairwise(sigmas):
            unconditional, conditional = self._denoised(x, sigma)
            denoised = unconditional + scale[:, None, None, None] * (conditional - unconditional)
            x = x + (following - sigma) * (x - denoised) / sigma
        return x

    def _sigmas(self) -> list[float]:
        high, low = 700 ** (1 / 7), 0.002 ** (1 / 7)
        return [(high + i / (STEPS - 1) * (low - high)) ** 7 for i in range(STEPS)] + [0.0]

    def _denoised(self, x: Tensor, sigma: float) -> tuple[Tensor, Tensor]:
        """D(x, sigma) without and with the image token and the source latents; all else is the same in both."""
        c_skip, c_out = 1 / (sigma**2 + 1), -sigma / math.sqrt(sigma**2 + 1)
        c_in, c_noise = 1 / math.sqrt(sigma**2 + 1), 0.25 * math.log(sigma)
        assert self.features.tokens is not None
        source, tokens, vector = self.features.latents.double(), self.features.tokens.double(), self._vector()
        raw = plain_unet(
            self.weights,
            torch.cat([(c_in * x).repeat(2, 1, 1, 1), torch.cat([torch.zeros_like(source), source])], dim=1),
            noise_label=torch.full((2 * FRAMES,), c_noise, dtype=torch.float64),
            vector=torch.cat([vector, vector]),
            tokens=torch.cat([torch.zeros_like(tokens), tokens]),
            frames=FRAMES,
            head_width=CONFIG.unet.head_width,
        )
        return c_skip * x + c_out * raw[:FRAMES], c_skip * x + c_out * raw[FRAMES:]

    def _vector(self) -> Tensor:
        """[T, 24 + 8]: frame rate, motion and augmentation strength, then the embedded camera."""
        motion = round(255 * math.hypot(DELTA[0], DELTA[1]) / math.hypot(90, 30))
        micro = [number for value in (12.0, motion, 0.02) for number in _sinusoid(value, 8)]
        rows = []
        for t in range(FRAMES):
            azimuth, elevation = (math.radians(angle) * t / (FRAMES - 1) for angle in DELTA[:2])
            fourier = [f(m * angle) for angle in (azimuth, elevation) for m in (1, 2, 4) for f in (math.cos, math.sin)]
            features = torch.tensor([*fourier, DELTA[2] * t / (FRAMES - 1)], dtype=torch.float64)
            camera = self.camera_weight @ features + self.camera_bias
            rows.append(torch.cat([torch.tensor(micro, dtype=torch.float64), camera]))
        return torch.stack(rows)


def _sinusoid(value: float, width: int) -> list[float]:
    angles = [value * 10000 ** (-i / (width // 2)) for i in range(width // 2)]
    return [math.cos(angle) for angle in angles] + [math.sin(angle) for angle in angles]


def test_25_guided_steps_equal_the_reference() -> None:
    synthesizer = tiny_synthesizer(CONFIG)
    features, camera = synthesizer.encode(random_clip(CONFIG)), synthesizer.networks.camera
    noise = draw(FRAMES, 4, *features.latents.shape[2:], seed=5)
    delta = SphericalDelta(azimuth_deg=DELTA[0], elevation_deg=DELTA[1], radius_m=DELTA[2])
    path = synthesizer.traits.plan_view(delta)
    (view,) = synthesizer.render(features, [path], RenderOptions(initial_noise=noise))
    assert camera is not None
    reference = Reference(
        weights={name: weight.double() for name, weight in released_unet(synthesizer.networks.unet).items()},
        camera_weight=camera.proj.weight.double(),
        camera_bias=camera.proj.bias.double(),
        features=features,
        noise=noise,
    )
    with torch.inference_mode():
        assert relative_error(view.latents[0], reference.sample()) < 1e-4
