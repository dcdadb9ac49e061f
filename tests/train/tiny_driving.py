"""An untrained driving model with every switch of ours, for tiny pictures, as a file."""

from pathlib import Path

import msgspec

from gcd_model import DRIVING_SMALL
from gcd_model.checkpoints import save_weights
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
