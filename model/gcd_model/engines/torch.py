"""What computes the networks of a checkpoint, behind one interface: plain torch here, faster ones beside it."""

from typing import Protocol

from torch import Tensor

from gcd_model.clip import RenderOptions
from gcd_model.conditioning import Conditioning
from gcd_model.diffusion import Schedule, TorchBackbone, planned_denoiser, sample
from gcd_model.geometry import Trajectory
from gcd_model.image_encoder import clip_pixels
from gcd_model.networks import Networks


class Engine(Protocol):
    """Computes networks; what they are given and what becomes of it is the synthesizer's.

    Tensors may come from any device and are float32 unless `like` says otherwise; results lie where `like` does.
    """

    @property
    def like(self) -> Tensor:
        """A tensor of the device and precision that conditioning is wanted in."""
        ...

    def tokens(self, frames: Tensor) -> Tensor | None:
        """Image tokens of frames [N, 3, H, W] in [-1, 1]: [N, D]; None without an image tower."""
        ...

    def condition_mean(self, frames: Tensor) -> Tensor:
        """Unscaled latents of frames [N, 3, H, W] in [-1, 1]: [N, C, h, w]."""
        ...

    def camera(self, path: Trajectory) -> Tensor | None:
        """What the U-Net is told of a camera path, [T, W]; None for a model without camera control."""
        ...

    def sample(self, start: Tensor, given: Conditioning, schedule: Schedule, options: RenderOptions) -> Tensor:
        """From noise [K, T, C, h, w] to clean latents; reports to `options.progress`, stops for `options.cancel`.

        Raises Cancelled.
        """
        ...

    def decode(self, latents: Tensor) -> Tensor:
        """Unscaled latents of one clip [T, C, h, w] -> pictures float32 [T, 3, H, W], about [-1, 1]."""
        ...


class TorchEngine:
    """The networks as torch runs them."""

    def __init__(self, networks: Networks) -> None:
        self._networks = networks
        self._backbone = TorchBackbone(networks.unet)

    @property
    def like(self) -> Tensor:
        return self._networks.unet.stem.weight

    def tokens(self, frames: Tensor) -> Tensor | None:
        tower = self._networks.image_encoder
        if tower is None:
            return None
        return tower(clip_pixels(frames.to(self.like.device), tower.config.image_size).to(self.like))

    def condition_mean(self, frames: Tensor) -> Tensor:
        return self._networks.condition_encoder(frames.to(self.like)).mean

    def camera(self, path: Trajectory) -> Tensor | None:
        embedder = self._networks.camera
        return None if embedder is None else embedder(path)

    def sample(self, start: Tensor, given: Conditioning, schedule: Schedule, options: RenderOptions) -> Tensor:
        denoiser = planned_denoiser(self._backbone, given, schedule)
        start = start.to(self.like.device)
        return sample(denoiser, start, schedule.steps, progress=options.progress, cancel=options.cancel)

    def decode(self, latents: Tensor) -> Tensor:
        decoder = self._networks.decoder
        return decoder(latents.to(decoder.stem.weight), len(latents))
