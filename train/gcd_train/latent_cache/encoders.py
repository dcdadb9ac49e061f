"""The frozen networks of a checkpoint: what training would run on every picture, every time."""

from dataclasses import dataclass
from functools import lru_cache

import msgspec
import torch
from torch import Tensor, nn

from gcd_model import ModelConfig
from gcd_model.engines.cpu import arrange
from gcd_model.image_encoder import ImageEncoder, clip_pixels
from gcd_model.loading import random_weights, weights_path
from gcd_model.networks import Networks, weights_digest
from gcd_model.vae import Encoder, Posterior
from gcd_model.weights.card import precision
from gcd_model.weights.load import load_weights
from gcd_train.errors import RecipeError


class EncoderChoice(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """weights: a path, package:NAME or random:FAMILY. device: auto, cpu or cuda[:N]. dtype: the networks' precision.

    family: where the file does not tell. batch: pictures a call; it does not change the result.
    """

    weights: str
    family: str | None = None
    device: str = "auto"
    dtype: str = "float32"
    batch: int = 2


@dataclass(frozen=True, slots=True)
class Encoders:
    """Encoders on their device. digest: names their weights, whatever checkpoint they came in."""

    config: ModelConfig
    target: Encoder
    condition: Encoder
    image: ImageEncoder | None
    digest: str
    choice: EncoderChoice
    device: torch.device

    def posterior(self, frames: Tensor) -> Posterior:
        """Target latents of frames [N, 3, H, W] in [-1, 1], not scaled: float32 moments on the CPU."""
        parts = [self.target(rows) for rows in self._batches(frames)]
        mean, log_variance = (torch.cat([getattr(p, name) for p in parts]) for name in ("mean", "log_variance"))
        return Posterior(mean.float().cpu(), log_variance.float().cpu())

    def condition_mean(self, frames: Tensor) -> Tensor:
        """Condition latents [N, C, h, w] of frames with their noise, not scaled; float32 on the CPU."""
        return torch.cat([self.condition(rows).mean for rows in self._batches(frames)]).float().cpu()

    def tokens(self, frames: Tensor) -> Tensor | None:
        """Image tokens [N, D] of clean frames; None for a model without an image tower."""
        tower = self.image
        if tower is None:
            return None
        size = tower.config.image_size
        rows = [tower(clip_pixels(rows.float(), size).to(rows.dtype)) for rows in self._batches(frames)]
        return torch.cat(rows).float().cpu()

    def _batches(self, frames: Tensor) -> tuple[Tensor, ...]:
        return frames.to(self.device, precision(self.choice.dtype)).split(self.choice.batch)


@lru_cache(maxsize=1)
def load_encoders(choice: EncoderChoice) -> Encoders:
    """Load, freeze and place the encoders; a process does it once.

    Raises: CheckpointError, OptionError as `load_weights`; RecipeError where the device is not there.
    """
    networks = _networks(choice)
    device, digest = _device(choice.device), encoders_digest(networks)
    for module in _parts(networks).values():
        module.to(device, precision(choice.dtype)).requires_grad_(False).eval()
        if device.type == "cpu":
            arrange(module)
    return Encoders(
        config=networks.config,
        target=networks.target_encoder,
        condition=networks.condition_encoder,
        image=networks.image_encoder,
        digest=digest,
        choice=choice,
        device=device,
    )


def encoders_digest(networks: Networks) -> str:
    """Names the weights of the frozen encoders, whatever type they are kept in."""
    states = {part: module.state_dict() for part, module in _parts(networks).items()}
    return weights_digest({f"{part}.{name}": value.float() for part in states for name, value in states[part].items()})


def _parts(networks: Networks) -> dict[str, nn.Module]:
    parts: dict[str, nn.Module] = {"target": networks.target_encoder, "condition": networks.condition_encoder}
    return parts if networks.image_encoder is None else {**parts, "image": networks.image_encoder}


def _networks(choice: EncoderChoice) -> Networks:
    kind, _, name = choice.weights.partition(":")
    if kind == "random":
        return random_weights(name).diffusion
    return load_weights(weights_path(choice.weights), family=choice.family).diffusion


def _device(name: str) -> torch.device:
    there = torch.cuda.is_available()
    if name.startswith("cuda") and not there:
        raise RecipeError(f"device {name} was asked for and this machine has no CUDA device; use auto or cpu")
    return torch.device(("cuda" if there else "cpu") if name == "auto" else name)
