"""An untrained small driving model, for tiny pictures."""

from pathlib import Path

import msgspec

from gcd_model.config import PLAIN_SMALL, ModelConfig
from gcd_model.networks import random_networks
from gcd_model.weights.card import FAMILIES, Card
from gcd_model.weights.load import save_weights

FRAMES, HEIGHT, WIDTH = 4, 32, 64


def write_untrained(folder: Path) -> Path:
    """`untrained.safetensors`: four frames of 64 x 32."""
    config = msgspec.structs.replace(
        PLAIN_SMALL,
        frames=FRAMES,
        height=HEIGHT,
        width=WIDTH,
        unet=msgspec.structs.replace(PLAIN_SMALL.unet, width=16, embedding_width=32, head_width=16),
        vae=msgspec.structs.replace(PLAIN_SMALL.vae, width=16),
        sampling=msgspec.structs.replace(PLAIN_SMALL.sampling, steps=1),
    )
    path = folder / "untrained.safetensors"
    card = Card(name="untrained", config=config, family=FAMILIES["driving"], move_time=FRAMES - 1, trained=False)
    save_weights(random_networks(config, seed=0), path, card)
    return path


def smaller(frames: int, height: int, width: int) -> ModelConfig:
    """A still smaller one."""
    change = msgspec.structs.replace
    unet = change(
        PLAIN_SMALL.unet,
        width=8,
        multipliers=(1, 2),
        attention=(False, True),
        embedding_width=16,
        head_width=8,
    )
    return change(
        PLAIN_SMALL,
        frames=frames,
        height=height,
        width=width,
        unet=unet,
        vae=change(PLAIN_SMALL.vae, width=8, multipliers=(1, 1, 2)),
    )
