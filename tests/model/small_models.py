"""Small networks with the published layout and random weights, for tests that compare numbers."""

from dataclasses import replace

import torch
from torch import Tensor, nn

from gcd_model.clip import Clip, View
from gcd_model.config import ImageEncoderConfig, ModelConfig, SamplingConfig, SemanticClass, UNetConfig, VAEConfig
from gcd_model.diffusion import RenderOptions
from gcd_model.geometry import Trajectory
from gcd_model.networks import LoadedWeights, Networks
from gcd_model.synthesizer import Synthesizer
from gcd_model.traits import Traits
from gcd_model.weights.card import DRIVING_SEMANTIC, KUBRIC90, Card

UNET = UNetConfig(
    width=64,
    multipliers=(1, 1, 2, 2),
    attention=(True, True, True, False),
    embedding_width=256,
    head_width=16,
    context_width=48,
    vector_width=48,
    camera_width=24,
    norm_groups=32,
)
"""Levels, blocks, attention and norm groups as published; only the widths are small (but two channels a group)."""

TINY = ModelConfig(
    frames=3,
    height=32,
    width=64,
    unet=UNetConfig(
        width=16,
        multipliers=(1, 2),
        attention=(False, True),
        blocks_per_level=1,
        embedding_width=32,
        head_width=16,
        context_width=24,
        vector_width=24,
        camera_width=8,
        norm_groups=8,
    ),
    vae=VAEConfig(width=8, multipliers=(1, 1, 2), blocks_per_level=1, norm_groups=4),
    image_encoder=ImageEncoderConfig(
        image_size=28, patch=14, width=16, layers=1, heads=2, hidden_width=32, output_width=24
    ),
    sampling=SamplingConfig(steps=3),
)
"""As little network as shows every behaviour of the synthesizer."""

TINY_CLASSES = (
    SemanticClass(name="road", colour=(90, 90, 90)),
    SemanticClass(name="car", colour=(0, 0, 200)),
    SemanticClass(name="sky", colour=(120, 180, 230)),
)

TINY_DRIVING = ModelConfig(
    frames=3,
    height=32,
    width=48,
    camera="none",
    unet=UNetConfig(
        latent_channels=4,
        condition_channels=4,
        width=16,
        multipliers=(1, 2),
        attention=(False, True),
        blocks_per_level=1,
        embedding_width=32,
        head_width=16,
        context_width=None,
        vector_width=24,
        camera_width=0,
        norm_groups=8,
    ),
    vae=VAEConfig(width=8, multipliers=(1, 2), blocks_per_level=1, norm_groups=4, scale=1.0, shared=True, patch=2),
    image_encoder=None,
    sampling=SamplingConfig(
        steps=1, sigma_max=80.0, sigma_min=0.6, guidance=(1.0, 1.0), shared_noise=True, augmentation=0.0
    ),
    prediction="x0",
    semantic_classes=TINY_CLASSES,
)
"""The same with every switch that is ours; it paints its classes."""


def draw(*shape: int, seed: int = 0) -> Tensor:
    """Standard normal float32, the same in every run."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def randomise(module: nn.Module, seed: int = 0) -> None:
    """Give every parameter its own random value, also norms, blends and what starts at zero or one."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in module.parameters():
            values = torch.randn(parameter.shape, generator=generator)
            if parameter.ndim > 1:
                parameter.copy_(values * parameter[0].numel() ** -0.5)
            else:
                parameter.copy_(_constant(parameter) + 0.3 * values)


def _constant(parameter: Tensor) -> float:
    """Where norms and blends start; zero for what was drawn, so that no earlier draw shows through."""
    first = parameter[0].item()
    return first if torch.equal(parameter, torch.full_like(parameter, first)) else 0.0


def give_published_epsilon(diffusers_unet: nn.Module) -> int:
    """Set 1e-5 where diffusers 0.42 has 1e-6: the residual norms of its attention down and all its up blocks. How many.

    The published network has 1e-5 in every residual norm.
    """
    changed = 0
    for name, module in diffusers_unet.named_modules():
        in_residual = name.startswith(("down_blocks.", "up_blocks.")) and ".resnets." in name
        if in_residual and isinstance(module, nn.GroupNorm) and module.eps == 1e-6:
            module.eps, changed = 1e-5, changed + 1
    return changed


def tiny_traits(config: ModelConfig = TINY, *, precision: str = "float32", device: str = "cpu") -> Traits:
    """Traits of a gradual Kubric-4D checkpoint with limits of 90 and 30 degrees."""
    return Traits(
        name="tiny",
        config=config,
        family=KUBRIC90,
        move_time=config.frames - 1,
        sha256_12="0" * 12,
        precision=precision,
        device=device,
        trained=False,
    )


def tiny_synthesizer(config: ModelConfig = TINY, *, family_known: bool = True, seed: int = 0) -> Synthesizer:
    """A random checkpoint, ready to run."""
    networks = Networks(config)
    randomise(networks, seed)
    traits = tiny_traits(config)
    return Synthesizer(networks, traits if family_known else replace(traits, family=None))


def tiny_driving(config: ModelConfig = TINY_DRIVING, seed: int = 0) -> Synthesizer:
    """A random driving checkpoint with every switch of ours, which paints its classes, ready to run."""
    networks = Networks(config)
    randomise(networks, seed)
    return Synthesizer(networks, replace(tiny_traits(config), name="tiny-driving", family=DRIVING_SEMANTIC))


def synthesize(synthesizer: Synthesizer, clip: Clip, path: Trajectory, options: RenderOptions | None = None) -> View:
    """One clip, one view."""
    return synthesizer.render(synthesizer.encode(clip), [path], options)[0]


def as_loaded(synthesizer: Synthesizer) -> LoadedWeights:
    """What a file of a synthesizer's networks would give."""
    networks, traits = synthesizer.networks, synthesizer.traits
    card = Card(
        name=traits.name, config=networks.config, family=traits.family, move_time=traits.move_time, trained=False
    )
    return LoadedWeights(card=card, networks=networks)


def random_clip(config: ModelConfig = TINY, *, frames: int | None = None, seed: int = 0) -> Clip:
    """Noise in [-1, 1] in the trained size, at 12 frames per second."""
    shape = (config.frames if frames is None else frames, 3, config.height, config.width)
    return Clip(video=torch.rand(shape, generator=torch.Generator().manual_seed(seed)) * 2 - 1, fps=12.0)


def relative_error(ours: Tensor, theirs: Tensor) -> float:
    """Largest absolute difference over the largest absolute value."""
    assert ours.shape == theirs.shape, f"{list(ours.shape)} against {list(theirs.shape)}"
    return ((ours.double() - theirs.double()).abs().max() / theirs.double().abs().max()).item()
