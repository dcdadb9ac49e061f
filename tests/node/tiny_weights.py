"""A real weight file of a tiny driving model at random: paints class colours, and takes no time."""

from pathlib import Path

from msgspec.structs import replace

from gcd_model.config import DRIVING_CLASSES, PLAIN_SMALL
from gcd_model.networks import random_networks
from gcd_model.weights.card import Card
from gcd_model.weights.load import save_weights

HEIGHT, WIDTH = 64, 96
UNET = replace(PLAIN_SMALL.unet, width=16, head_width=16, embedding_width=32)
VAE = replace(PLAIN_SMALL.vae, width=8)
TINY = replace(PLAIN_SMALL, height=HEIGHT, width=WIDTH, unet=UNET, vae=VAE, semantic_classes=DRIVING_CLASSES)


def write_tiny(folder: Path) -> Path:
    """`tiny.safetensors` in a folder."""
    path = folder / "tiny.safetensors"
    card = Card(name="tiny", config=TINY, family="driving-semantic", move_time=13, trained=False)
    save_weights(random_networks(TINY, seed=0), path, card)
    return path
