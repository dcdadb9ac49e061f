"""An untrained driving model with every switch of ours, for tiny pictures, as a file."""

from pathlib import Path

import msgspec

from gcd_model import DRIVING_SMALL
from gcd_model.checkpoints import save_weights
from gcd_model.config import DRIVING_CLASSES, ClassHeadConfig, ModelConfig
from gcd_model.networks import random_networks
from gcd_model.own_format import Card

FRAMES, HEIGHT, WIDTH = 4, 32, 64


def write_untrained(folder: Path) -> Path:
    """`untrained.safetensors`: four frames of 64 x 32."""
    config = msgspec.structs.replace(
        DRIVING_SMALL,
        frames=FRAMES,
        height=HEIGHT,
        width=WIDTH,
        unet=msgspec.structs.replace(DRIVING_SMALL.unet, width=16, embedding_width=32, head_width=16),
        vae=msgspec.structs.replace(DRIVING_SMALL.vae, width=16),
    )
    path = folder / "untrained.safetensors"
    card = Card(name="untrained", config=config, family="driving", move_time=FRAMES - 1, trained=False)
    save_weights(random_networks(config, seed=0), path, card)
    return path


def without_warps(frames: int, height: int, width: int) -> ModelConfig:
    """A still smaller one with a class head, and neither plane warps nor a plane mix."""
    change = msgspec.structs.replace
    unet = change(
        DRIVING_SMALL.unet,
        condition_channels=12,
        width=8,
        multipliers=(1, 2),
        attention=(False, True),
        embedding_width=16,
        head_width=8,
    )
    return change(
        DRIVING_SMALL,
        frames=frames,
        height=height,
        width=width,
        plane_warp=None,
        plane_mix=None,
        class_head=ClassHeadConfig(classes=DRIVING_CLASSES),
        unet=unet,
        vae=change(DRIVING_SMALL.vae, width=8, multipliers=(1, 1, 2)),
    )
