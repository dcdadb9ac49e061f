"""All networks of one checkpoint, built from its config."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import overload

import torch
from torch import Tensor, nn

from gcd_model.conditioning import CameraEmbedder, ImageEncoder
from gcd_model.config import ModelConfig
from gcd_model.errors import CheckpointError
from gcd_model.live.config import LiveConfig
from gcd_model.live.depth_net import DepthNet, Familiarity
from gcd_model.live.paint_net import PaintNet
from gcd_model.unet import VideoUNet
from gcd_model.vae import Encoder, TemporalDecoder
from gcd_model.weights.card import NO_DIFFUSION, Card, Layout


class Networks(nn.Module):
    """U-Net, camera embedder, image tower and autoencoders.

    Attribute names are ours; `weights/names.py` knows the published ones. With a shared VAE the target encoder is
    also the condition encoder.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.unet = VideoUNet(config.unet, config.frames)
        self.camera = None if config.camera == "none" else CameraEmbedder(config.camera, config.unet.camera_width)
        self.image_encoder = None if config.image_encoder is None else ImageEncoder(config.image_encoder)
        self.target_encoder = Encoder(config.vae, quant=config.vae.shared)
        self.own_condition_encoder = None if config.vae.shared else Encoder(config.vae, quant=True)
        self.decoder = TemporalDecoder(config.vae)
        if config.is_ours:
            self.unet.start_apart()

    @property
    def condition_encoder(self) -> Encoder:
        """The encoder the source frames go through."""
        return self.target_encoder if self.own_condition_encoder is None else self.own_condition_encoder


class LiveNetworks(nn.Module):
    """All weights of the live model."""

    def __init__(self, config: LiveConfig) -> None:
        super().__init__()
        self.config = config
        self.depth = DepthNet(config.depth, len(config.classes))
        self.paint = PaintNet(config.paint, len(config.classes))
        self.familiarity = Familiarity(config.depth.widths[0])


@dataclass(frozen=True, kw_only=True, slots=True)
class LoadedWeights:
    """Networks with their weights, still in the mapped file, in the stored precision, on the CPU.

    card: what a file made of them says about itself; its origin names these weights.
    layout: of the file they came from. carried: leftovers of a published file that its next owner may want, by
    published name; see `CARRIED`.
    """

    card: Card
    networks: Networks | LiveNetworks
    layout: Layout = "gcd-node"
    carried: Mapping[str, Tensor] = field(default_factory=dict[str, Tensor])

    @property
    def diffusion(self) -> Networks:
        """The networks of a diffusion model. Raises CheckpointError for the live model."""
        if isinstance(self.networks, LiveNetworks):
            raise CheckpointError(f"{self.card.name} {NO_DIFFUSION}")
        return self.networks


@overload
def empty_networks(config: ModelConfig) -> Networks: ...
@overload
def empty_networks(config: LiveConfig) -> LiveNetworks: ...
def empty_networks(config: ModelConfig | LiveConfig) -> Networks | LiveNetworks:
    """Networks without storage, on the meta device, to be filled from a checkpoint."""
    with torch.device("meta"):
        return Networks(config) if isinstance(config, ModelConfig) else LiveNetworks(config)


@overload
def random_networks(config: ModelConfig, seed: int) -> Networks: ...
@overload
def random_networks(config: LiveConfig, seed: int) -> LiveNetworks: ...
def random_networks(config: ModelConfig | LiveConfig, seed: int) -> Networks | LiveNetworks:
    """Freshly initialised networks; layers that start at zero get random values too, so that every path is live."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        networks = Networks(config) if isinstance(config, ModelConfig) else LiveNetworks(config)
        for parameter in networks.parameters():
            if not parameter.any():
                nn.init.normal_(parameter, std=0.02)
    return networks


def weights_digest(weights: Mapping[str, Tensor]) -> str:
    """Twelve digits that name weights: of SHA-256 over names and bytes, in the order of the names."""
    total = hashlib.sha256()
    for name, tensor in sorted(weights.items()):
        total.update(name.encode())
        total.update(tensor.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().data)
    return total.hexdigest()[:12]
